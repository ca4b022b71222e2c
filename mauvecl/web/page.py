"""The page of one visitor: controls on the left, alerts on top, a tab for each kind of answer."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import panel as pn
from bokeh.models.widgets import Div

from mauvecl.detect_study import DetectAnswer, detect
from mauvecl.detection import Detection
from mauvecl.host.errors import InputError
from mauvecl.labels import told
from mauvecl.limits import LimitResult, limiting_magnitude
from mauvecl.maps import MapResult, detection_map
from mauvecl.program import DeviceError
from mauvecl.scene import prepare
from mauvecl.snr_study import SnrAnswer, snr
from mauvecl.study import Study
from mauvecl.web.controls import controls
from mauvecl.web.downloads import as_file, study_file
from mauvecl.web.frame import tabs
from mauvecl.web.question import Question
from mauvecl.web.views import Distributions, InputSpectrum, NoiseBudget, Observation, Roc, SignalToNoise, Smooth
from mauvecl.web.work import Cancelled, Job

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.pool import Pool

#: Milliseconds between two looks at a simulation, and from a change to a drawn spectrum.
LOOK_MS, DRAW_MS = 250, 500
#: The map of the page: cells along each axis, and realisations of each.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000


class Page:
    """Controls, answers and downloads of one visitor."""

    def __init__(self) -> None:
        self.question = Question()
        self.job: Job | None = None
        self._drawing: Job | None = None
        self.quiet: Expectation | None = None
        self.flare: Expectation | None = None
        self.theory: Detection | None = None
        self.found: dict[str, Any] = {}
        self._folder = tempfile.TemporaryDirectory(prefix="mauvecl-page-")
        self._asked = 0
        self._document = pn.state.curdoc
        self._link_fault = ""
        self._told: list[tuple[str, str]] = []
        self.alerts = pn.Column(sizing_mode="stretch_width")
        # A plain model: its text changes without a look at the whole page.
        self.summary = Div(sizing_mode="stretch_width", styles={"font-size": "110%"})
        self.status = pn.pane.Markdown("", sizing_mode="stretch_width")
        self.bar = pn.indicators.Progress(name="Progress", value=0, max=100, sizing_mode="stretch_width", visible=False)
        self.spectrum = InputSpectrum()
        self.views = Observation(), SignalToNoise(), NoiseBudget(), Distributions(), Roc()
        self.table = pn.pane.DataFrame(None, index=False, sizing_mode="stretch_width", escape=True)
        self.limit = pn.Column(sizing_mode="stretch_width")
        self.map = pn.Column(sizing_mode="stretch_width")
        if self._document is not None:
            pn.state.on_session_destroyed(lambda context: self._left())
        self._make_buttons()
        self.controls = controls(self.question, lambda text: self._alert(text, "danger"))
        self.tabs = tabs(self)
        self.tabs.param.watch(self._show_tab, "active")
        self._stale: set[int] = set()
        if pn.state.location is not None:
            pn.state.location.sync(self.question, list(self._shared()), on_error=self._bad_link)
        self.question.param.watch(self._changed, list(self._shared()))
        self.refresh()

    @staticmethod
    def _shared() -> dict[str, str]:
        """What a link holds."""
        return {name: name for name in Question.param if name != "name"}

    def _bad_link(self, bad: dict[str, Any]) -> None:
        self._link_fault = (
            f"The link holds {', '.join(sorted(map(str, bad)))} that cannot be; the usual values stand there."
        )

    def _left(self) -> None:
        """The visitor is gone: nothing more is computed for them."""
        for job in (self.job, self._drawing):
            if job is not None:
                job.cancel()
        self._folder.cleanup()

    def _make_buttons(self) -> None:
        self.run = pn.widgets.Button(name="Simulate", button_type="primary", width=240)
        self.cancel = pn.widgets.Button(name="Cancel", disabled=True, width=120)
        self.run_limit = pn.widgets.Button(name="Find the limiting magnitude", button_type="primary")
        self.run_map = pn.widgets.Button(name="Draw the map", button_type="primary")
        self.run.on_click(partial(self._simulate, "detection", _refined, self._show_refined))
        self.run_limit.on_click(partial(self._simulate, "limit", limiting_magnitude, self._show_limit))
        self.run_map.on_click(partial(self._simulate, "map", _map, self._show_map))
        self.cancel.on_click(lambda event: self.job.cancel() if self.job is not None else None)

    # Closed forms

    def _changed(self, *_: Any) -> None:
        if self.job is not None:
            self.job.cancel()
        self.refresh()

    def refresh(self) -> None:
        """Everything that has a closed form."""
        self._asked += 1
        self._forget()
        # One message for all changes.
        with pn.io.hold():
            try:
                study = self.study()
                self._show_closed(study)
            except InputError as error:
                self.quiet = None
                self._tell([(str(error), "danger")])
                self.summary.text = ""
                self.run.disabled = True
                return
        self.run.disabled = self.job is not None
        if self._document is not None:
            # Not before the closed forms are shown, and not while a value is still being chosen.
            self._document.add_timeout_callback(partial(self._draw_one, self._asked, study), DRAW_MS)

    def _forget(self) -> None:
        """Answers of an earlier question go."""
        if self.found:
            self.found = {}
            self.table.object = None
            self.limit.clear()
            self.map.clear()

    def _show_closed(self, study: Study) -> None:
        q = self.question
        source = study.star[0].source()
        self._light = source, study.flaring(source, study.flare.amplitudes[0])
        quiet, flare = self.quiet, self.flare = study.expect(list(self._light))
        scene = prepare([quiet, flare], comparison=study.run.comparison())
        self.theory = Detection(
            quiet, (flare,), study.run.statistics, scene, study.run.realisations, seed=study.run.seed
        )
        self._cut = self.theory.closed_form(q.statistic).isf(q.fap)
        self.summary.text = self._closed_summary()
        fault = [(self._link_fault, "warning")] if self._link_fault else []
        kinds = [(m, "danger" if m.startswith("SATURATED") else "info") for m in told([quiet, flare])]
        self._tell([*fault, *kinds])
        self._stale = set(range(len(self.tabs)))
        self._show_tab()

    def _show_tab(self, *_: Any) -> None:
        """Closed forms of the tab in front, once after a change; the others follow when they come to the front."""
        if self.quiet is None or self.flare is None or self.theory is None or self.tabs.active not in self._stale:
            return
        self._stale.discard(self.tabs.active)
        q, theory = self.question, self.theory
        observation, snr, budget, distributions, roc = self.views
        if self.tabs.active == 0:
            observation.show(self.quiet, self.flare)
            self.spectrum.show(*self._light)
        elif self.tabs.active == 1:
            snr.show(self.quiet)
            if "snr" in self.found:
                snr.add(self.found["snr"].element)
        elif self.tabs.active == 2:
            budget.show(self.quiet)
        elif self.tabs.active == 3:
            null, with_flare = (Smooth(theory.closed_form(q.statistic, k)) for k in (None, 0))
            distributions.show(null, with_flare, self._cut, q.statistic, q.fap)
            roc.show(null, with_flare)
            if "detection" in self.found:
                (star,) = self.found["detection"].stars
                distributions.add(star, q.statistic, q.fap)
                roc.add(star, q.statistic)

    def _closed_summary(self) -> str:
        assert self.theory is not None
        assert self.quiet is not None
        q, theory = self.question, self.theory
        chance = float("nan") if theory.blinding else theory.closed_form(q.statistic, 0).sf(self._cut)
        return (
            f"<b>{_percent(chance)}</b> of such flares are detected by {q.statistic} at a false-alarm probability of "
            f"{q.fap:g} per test: threshold {self._cut:.5g}, closed form for Gaussian noise. Best S/N "
            f"{self.quiet.snr().max():.3g} a pixel, {self.quiet.snr_per_element().max():.3g} an element; exposure "
            f"{self.quiet.exposure_s:g} s in {self.quiet.n_frames} frames."
        )

    def _draw_one(self, asked: int, study: Study) -> None:
        """One raw spectrum with the flare, drawn in the background."""
        quiet, flare = self.quiet, self.flare
        if asked != self._asked or quiet is None or flare is None:
            return

        def show(raw: Any) -> None:
            if asked == self._asked and 0 not in self._stale:
                self.views[0].add(quiet, raw)

        def came(future: Future[Any]) -> None:
            if not future.cancelled() and future.exception() is None:
                self._later(partial(show, future.result()))

        if self._drawing is not None:
            self._drawing.cancel()
        how = study.drawing | {"seed": study.run.seed}
        self._drawing = Job(lambda pool: pool.realise(flare, count=1, **how)[0])
        self._drawing.future.add_done_callback(came)

    def _later(self, work: Callable[[], None]) -> None:
        """Change the page from another thread, when it is its turn."""
        if self._document is not None:
            self._document.add_next_tick_callback(work)

    # Simulations

    def _simulate(self, kind: str, ask: Callable[[Study, Pool], Any], show: Callable[[Any], None], event: Any) -> None:
        if self.job is not None or self.quiet is None:
            return
        asked, study = self._asked, self.study()
        job = self.job = Job(partial(ask, study))
        self._busy(True)
        looker = pn.state.add_periodic_callback(partial(self._look, job), LOOK_MS)

        def ended() -> None:
            looker.stop()
            self.job = None
            self._busy(False)
            try:
                found = job.future.result()
            except (Cancelled, CancelledError):
                self.status.object = "Cancelled."
            except (InputError, DeviceError) as error:
                self.status.object = ""
                self._alert(str(error), "danger")
            else:
                self.status.object = f"Done: {job.told}."
                if asked == self._asked:
                    self.found[kind] = found
                    show(found)

        job.future.add_done_callback(lambda future: self._later(ended))

    def _busy(self, busy: bool) -> None:
        self.cancel.disabled = not busy
        for button in (self.run, self.run_limit, self.run_map):
            button.disabled = busy
        self.bar.visible = busy
        self.bar.value = 0

    def _look(self, job: Job) -> None:
        self.status.object = job.told
        standing = job.standing
        if standing is not None and standing.total:
            self.bar.value = min(int(100 * standing.done / standing.total), 100)

    def _show_refined(self, answers: tuple[DetectAnswer, SnrAnswer]) -> None:
        answer, _ = self.found["detection"], self.found["snr"] = answers
        # S/N and detection are shown anew, the simulation on top.
        self._stale |= {1, 3}
        self._show_tab()
        q = self.question
        frame = answer.table.to_pandas()
        columns = {
            "statistic": "statistic", "mean": "mean with flare", "threshold": "threshold",
            "probability": "detected", "low": "95 % from", "high": "to", "closed_form_probability": "closed form",
        }  # fmt: skip
        self.table.object = frame[list(columns)].rename(columns=columns)
        (row,) = (r for r in answer.table if r["statistic"] == q.statistic)
        self.summary.text = (
            f"<b>{_percent(row['probability'])}</b> [{_percent(row['low'])}, {_percent(row['high'])}] of "
            f"{q.realisations:,} simulated flares are detected by {q.statistic} at a false-alarm probability of "
            f"{q.fap:g} per test; closed form {_percent(row['closed_form_probability'])}."
        )

    def _show_limit(self, found: LimitResult) -> None:
        rows = [
            f"- `{one.statistic}`: **{one.value.value:.3f}** [{one.value.low:.3f}, {one.value.high:.3f}], closed form "
            f"{one.closed_form:.3f}; simulated again there: {_percent(one.check.probability.value)}"
            for one in found.limits
        ]
        power, fap = found.study.limit.power, found.study.run.fap
        title = f"Magnitude at which {100 * power:g} % of such flares are detected, false-alarm probability {fap:g}:"
        self.limit.objects = [pn.pane.Markdown("\n".join([title, "", *rows])), _picture(found, "Limiting magnitude")]

    def _show_map(self, found: MapResult) -> None:
        self.map.objects = [_picture(found, "Detection probability over magnitude and flare amplitude")]

    # Alerts

    def _tell(self, alerts: list[tuple[str, str]]) -> None:
        """Alerts on top; the same ones stay as they are."""
        if alerts != self._told:
            self._told = alerts
            self.alerts.objects = [
                pn.pane.Alert(text.replace("<", "&lt;"), alert_type=kind, sizing_mode="stretch_width")
                for text, kind in alerts
            ]

    def _alert(self, text: str, kind: str) -> None:
        self._tell([(text, kind), *self._told])

    # Downloads

    def study(self) -> Study:
        """The question as it stands."""
        return self.question.study(Path(self._folder.name))

    def file(self, name: str, ending: str) -> io.BytesIO:
        """An answer as a table or picture."""
        if self.quiet is None:
            raise InputError("there is no answer to download, expected a question that has one")
        return as_file(name, ending, self.study(), self.quiet, self.found)

    def study_of(self, name: str | None = None) -> io.BytesIO:
        """The study of an answer that has its own, or of the question."""
        if name is None:
            return study_file(self.question, self.study())
        if name not in self.found:
            raise InputError(f"no {name} is computed yet, expected a simulation first")
        return study_file(self.question, self.found[name].study)

    def safely(self, make: Callable[[], io.BytesIO]) -> io.BytesIO:
        """What is made, or the sentence of why not, on the page and in the file."""
        try:
            return make()
        except InputError as error:
            self._alert(str(error), "warning")
            return io.BytesIO(f"{error}\n".encode())


def _percent(value: float) -> str:
    # Without a number where every pixel that counts is saturated.
    return f"{100 * float(value):.2f} %" if value == value else "(saturated)"


def _refined(study: Study, pool: Pool) -> tuple[DetectAnswer, SnrAnswer]:
    """Everything that *Simulate* refines."""
    pool.expect(2 * study.run.realisations)
    return detect(study, pool), snr(study, pool)


def _map(study: Study, pool: Pool) -> MapResult:
    """A coarse map around the question's own star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # A statistic alone, and as few realisations as the false-alarm probability allows.
    fewest = int(np.ceil(100 / study.run.fap))
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    run = {"realisations": n, "statistics": [study.run.statistics[-1]]}
    data = study.model_dump()
    data["map"] |= {"x": x, "y": y}
    data["run"] |= run
    return detection_map(Study.build(data, "page"), pool)


def _picture(found: LimitResult | MapResult, alternative: str) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        found.plot(path)
        return pn.pane.PNG(path.read_bytes(), alt_text=alternative, sizing_mode="scale_width", max_width=900)
