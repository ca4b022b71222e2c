"""The page of one visitor: one state, answers to it and to nothing else, simulations and downloads."""

from __future__ import annotations

import io
import logging
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import panel as pn

from mauvecl.answers.limits import LimitResult, limiting_magnitude
from mauvecl.answers.maps import MapResult
from mauvecl.answers.unknown_cost import cost_lines, marginal_lines, unknown_cost
from mauvecl.device.program import DeviceError
from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.noise.scene import prepare
from mauvecl.results.hypotheses import Hypotheses
from mauvecl.study.labels import told
from mauvecl.study.study import Study
from mauvecl.web.asked import detect_and_snr, map_around, picture
from mauvecl.web.bridge import Bridge, attach
from mauvecl.web.controls import Controls
from mauvecl.web.downloads import as_file, study_file
from mauvecl.web.state import State
from mauvecl.web.tabs import Tabs
from mauvecl.web.upload import read_upload, too_large
from mauvecl.web.words import alerts, escaped, line
from mauvecl.web.work import Cancelled, Job, reading

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.runs.pool import Pool

log = logging.getLogger(__name__)

#: Milliseconds between two looks at a simulation, and from a change to a drawn spectrum.
LOOK_MS, DRAW_MS = 250, 500
#: What is told where the page itself is wrong.
OWN_FAULT = "the page has made a mistake of its own, and there is no answer: please report what was entered"


class Page:
    """State, answers and downloads of one visitor."""

    def __init__(self, link: str = "") -> None:
        self.state = State()
        self.state.follow(link)
        self.found: dict[str, Any] = {}
        self.job: Job | None = None
        self.used = time.monotonic()
        self._wanted: list[str] = []
        self._drawing: Job | None = None
        self._document = pn.state.curdoc
        self._folder = tempfile.TemporaryDirectory(prefix="mauvecl-page-")
        self._asked = self._uploads = 0
        self._due = self._following = self._replaces = False
        self._told: list[tuple[str, str]] = []
        self.quiet: Expectation | None = None
        self.flare: Expectation | None = None
        self.theory: Hypotheses | None = None
        self.alerts = line()
        self.summary = line(styles={"font-size": "110%"}, html_attributes={"aria-live": "polite"})
        self.status = line()
        self.bar = pn.indicators.Progress(name="Progress", value=0, max=100, sizing_mode="stretch_width", visible=False)
        self._make_buttons()
        self.controls = Controls(self.state, self.enter, self._upload)
        self.tabs = Tabs(self)
        self.bridge = Bridge(address=self.state.link)
        # It needs a place in the document, and the template's roots are its own.
        self.summary.tags = [self.bridge]
        if self._document is not None:
            attach(self._document, self.bridge)
            self.bridge.on_change("came", lambda attr, old, new: self._came(new[0]))
            self.bridge.on_change("refused", lambda attr, old, new: self._refused(new[0]))
            pn.state.on_session_destroyed(lambda context: self._left())
        self.refresh()
        self._wanted = [kind for kind in self.state.simulated if kind not in self.found]
        self._later(self._next)

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
        for kind, button in (("detection", self.run), ("limit", self.run_limit), ("map", self.run_map)):
            button.on_click(partial(self._simulate, kind))
        self.cancel.on_click(lambda event: self._stop())

    # What is entered

    def enter(self, given: Mapping[str, str]) -> None:
        """A visitor has entered something: fields by name, or a tab."""
        before = self.state.asked
        self.state.enter(given)
        self._entered(before)

    def _entered(self, before: tuple[str, ...] | None, *, replaces: bool = False) -> None:
        """Show the state, and answer it if another question is asked than before."""
        self.used = time.monotonic()
        if self.state.asked != before:
            self.state.enter({"simulated": ""})
            self._stop()
            # Until there is an answer to these fields there is none.
            self.quiet = None
            self._asked += 1
            self._due = True
        self._replaces = replaces
        if self._document is None:
            self._follow()
        elif not self._following:
            # Several changes that wait already are answered once; models change under the document's lock alone.
            self._following = True
            self._document.add_next_tick_callback(self._follow)

    def _follow(self) -> None:
        """The page follows its state."""
        self._following = False
        with pn.io.hold():
            if self._due:
                self.refresh()
            self.controls.show()
            self.tabs.show()
            self._address(replaces=self._replaces)
        self._next()

    def _address(self, *, replaces: bool) -> None:
        self.bridge.update(replaces=replaces, address=self.state.link)

    def _came(self, link: str) -> None:
        """The visitor has gone back or forward."""
        before = self.state.asked
        self.state.follow(link)
        wanted = self.state.simulated
        self._entered(before, replaces=True)
        self._wanted = [kind for kind in wanted if kind not in self.found]

    def _upload(self, name: str, content: bytes) -> None:
        """A file has come; it is read beside the event loop, and there is no star until then."""
        self._uploads += 1
        self._no_star(f"{shortened(name)} is being read")
        future = reading(read_upload, name, content)
        future.add_done_callback(lambda future: self._later(partial(self._uploaded, self._uploads, name, future)))

    def _uploaded(self, number: int, name: str, future: Future[Source]) -> None:
        if number != self._uploads or self.state.entered["star"]:
            # Another star was chosen meanwhile.
            return
        try:
            source = future.result()
        except InputError as error:
            self._no_star(str(error))
        except Exception as error:
            log.exception("an upload failed")
            self._no_star(f"upload {shortened(name)} cannot be read ({type(error).__name__}), expected a spectrum")
        else:
            self.state.take(source)
            self._entered(None)

    def _refused(self, size: float) -> None:
        """The browser has kept a file back."""
        self._uploads += 1
        self._no_star(too_large(size))

    def _no_star(self, why: str) -> None:
        self.state.lack(why)
        self._entered(None)

    # Closed forms

    def refresh(self) -> None:
        """Everything that has a closed form."""
        self._due = False
        self._forget()
        try:
            self._answer()
        except InputError as error:
            self._withdraw(str(error))
        except Exception:
            log.exception("no answer")
            self._withdraw(OWN_FAULT)
        else:
            self.tabs.dim(False)
        self._busy()

    def _forget(self) -> None:
        """Answers of an earlier question go."""
        self.quiet = self.flare = self.theory = None
        self.found = {}

    def _withdraw(self, why: str) -> None:
        """There is no answer to what is entered; pictures of an earlier one are dimmed."""
        self._forget()
        self.summary.text = f"<b>No answer.</b> {escaped(why)}"
        self._tell(self._stray())
        self.tabs.dim(True)

    def _answer(self) -> None:
        q, study = self.state.question(), self.study()
        # What is uploaded need not be read from its file at every change.
        source = study.star[0].source() if q.uploaded is None else q.uploaded.at_magnitude(q.magnitude, q.band)
        self.light = source, study.flaring(source, study.flare.amplitudes[0])
        quiet, flare = study.expect(list(self.light))
        scene = prepare([quiet, flare], comparison=study.run.comparison())
        unknown = study.nuisances.marginalised(quiet)
        self.theory = Hypotheses(quiet, (flare,), study.run.statistics, scene, nuisances=unknown)
        self.cut = self.theory.closed_form(q.statistic).isf(q.fap)
        chance = float("nan") if self.theory.blinding else self.theory.closed_form(q.statistic, 0).sf(self.cut)
        self.quiet, self.flare = quiet, flare
        self.summary.text = (
            f"<b>{_percent(chance)}</b> of such flares are detected by {q.statistic} at a false-alarm probability of "
            f"{q.fap:g} per test: threshold {self.cut:.5g}, closed form for Gaussian noise. Best S/N "
            f"{quiet.snr().max():.3g} a pixel, {quiet.snr_per_element().max():.3g} an element; exposure "
            f"{quiet.exposure_s:g} s in {quiet.n_frames} frames."
        )
        cost = unknown_cost("this flare", quiet, flare, study)
        sentences = [*told([quiet, flare]), *marginal_lines(study), *cost_lines([cost], study)]
        self._tell([*self._stray(), *((m, "danger" if m.startswith("SATURATED") else "info") for m in sentences)])
        self.tabs.renew()

    def draw_soon(self) -> None:
        """One raw spectrum, not before the closed forms are shown, and not while a value is still being chosen."""
        if self._document is not None:
            self._document.add_timeout_callback(partial(self._draw_one, self._asked), DRAW_MS)

    def _draw_one(self, asked: int) -> None:
        """One raw spectrum with the flare, drawn in the background."""
        flare = self.flare
        if asked != self._asked or flare is None or not self.tabs.fresh("observation"):
            return

        def show(raw: Any) -> None:
            if asked == self._asked:
                self.tabs.draw(raw)

        def came(future: Future[Any]) -> None:
            if not future.cancelled() and future.exception() is None:
                self._later(partial(show, future.result()))

        if self._drawing is not None:
            self._drawing.cancel()
        study = self.study()
        how = study.drawing | {"seed": study.run.seed}
        self._drawing = Job(lambda pool: pool.realise(flare, count=1, **how)[0])
        self._drawing.future.add_done_callback(came)

    def _later(self, work: Callable[[], None]) -> None:
        """Change the page from another thread, or after this change, when it is its turn."""
        if self._document is None:
            work()
        else:
            self._document.add_next_tick_callback(work)

    # Simulations

    def _simulate(self, kind: str, event: Any) -> None:
        self.used = time.monotonic()
        self._wanted.append(kind)
        self._next()

    def _next(self) -> None:
        """The next simulation that is asked for, if none is on its way."""
        if self.job is not None or not self._wanted or self._due:
            return
        if self.quiet is None:
            self._wanted.clear()
            return
        kind, asked, study = self._wanted.pop(0), self._asked, self.study()
        asks: dict[str, Callable[[Study, Pool], Any]] = {
            "detection": detect_and_snr,
            "limit": limiting_magnitude,
            "map": map_around,
        }
        job = self.job = Job(partial(asks[kind], study))
        self._busy()
        looker = pn.state.add_periodic_callback(partial(self._look, job), LOOK_MS)

        def ended() -> None:
            looker.stop()
            self.job = None
            try:
                found = job.future.result()
            except (Cancelled, CancelledError):
                self.status.text = "Cancelled."
            except (InputError, DeviceError) as error:
                self.status.text = ""
                self._alert(str(error), "danger")
            except Exception:
                log.exception("a simulation failed")
                self.status.text = ""
                self._alert(OWN_FAULT, "danger")
            else:
                self.status.text = f"Done: {escaped(job.told)}."
                if asked == self._asked:
                    self._show_found(kind, found)
            self._busy()
            self._next()

        job.future.add_done_callback(lambda future: self._later(ended))

    def _show_found(self, kind: str, found: Any) -> None:
        if kind == "detection":
            self.found["detection"], self.found["snr"] = found
            self._show_refined()
            self.tabs.renew("snr", "detection")
        else:
            self.found[kind] = found
            self.tabs.renew("limit")
        self.state.enter({"simulated": ",".join(name for name in self.found if name != "snr")})
        self._address(replaces=True)

    def _stop(self) -> None:
        self._wanted.clear()
        if self.job is not None:
            self.job.cancel()

    def _busy(self) -> None:
        """What can be asked for now."""
        busy = self.job is not None
        self.cancel.disabled = not busy
        for button in (self.run, self.run_limit, self.run_map):
            button.disabled = busy or self.quiet is None
        if self.bar.visible != busy:
            self.bar.param.update(visible=busy, value=0)

    def _look(self, job: Job) -> None:
        self.status.text = escaped(job.told)
        standing = job.standing
        if standing is not None and standing.total:
            self.bar.value = min(int(100 * standing.done / standing.total), 100)

    def _show_refined(self) -> None:
        q = self.state.question()
        (row,) = (r for r in self.found["detection"].table if r["statistic"] == q.statistic)
        self.summary.text = (
            f"<b>{_percent(row['probability'])}</b> [{_percent(row['low'])}, {_percent(row['high'])}] of "
            f"{q.realisations:,} simulated flares are detected by {q.statistic} at a false-alarm probability of "
            f"{q.fap:g} per test; closed form {_percent(row['closed_form_probability'])}."
        )

    def shown_limit(self) -> list[Any]:
        """The limiting magnitudes and their picture, if they are found."""
        found: LimitResult | None = self.found.get("limit")
        if found is None:
            return []
        rows = [
            f"<li>{escaped(one.statistic)}: <b>{one.value.value:.3f}</b> [{one.value.low:.3f}, {one.value.high:.3f}], "
            f"closed form {one.closed_form:.3f}; simulated again there: {_percent(one.check.probability.value)}</li>"
            for one in found.limits
        ]
        power, fap = found.study.limit.power, found.study.run.fap
        title = f"Magnitude at which {100 * power:g} % of such flares are detected, false-alarm probability {fap:g}:"
        return [line(f"{title}<ul>{''.join(rows)}</ul>"), picture(found, "Limiting magnitude")]

    def shown_map(self) -> list[Any]:
        """The map, if it is found."""
        found: MapResult | None = self.found.get("map")
        return [] if found is None else [picture(found, "Detection probability over magnitude and flare amplitude")]

    # Alerts

    def _stray(self) -> list[tuple[str, str]]:
        """What a link held that is no field."""
        return [(self.state.stray, "warning")] if self.state.stray else []

    def _tell(self, sentences: list[tuple[str, str]]) -> None:
        """Alerts on top; the same ones stay as they are."""
        if sentences != self._told:
            self._told = sentences
            self.alerts.text = alerts(sentences)

    def _alert(self, text: str, kind: str) -> None:
        """One more, when it is the page's turn."""
        if (text, kind) not in self._told:
            self._later(lambda: self._tell([(text, kind), *self._told]))

    # Downloads

    @property
    def uploaded(self) -> bool:
        """Whether the star is a visitor's own."""
        return self.state.uploaded is not None and not self.state.faults and self.state.question().uploaded is not None

    def study(self) -> Study:
        """The question as it stands."""
        return self.state.question().study(Path(self._folder.name))

    def file(self, name: str, ending: str) -> io.BytesIO:
        """An answer as a table or picture."""
        if self.quiet is None:
            raise InputError("there is no answer to download, expected a question that has one")
        return as_file(name, ending, self.study(), self.quiet, self.found)

    def study_of(self, name: str | None = None) -> io.BytesIO:
        """The study of an answer that has its own, or of the question."""
        if name is None:
            return study_file(self.study())
        if name not in self.found:
            raise InputError(f"no {name} is computed yet, expected a simulation first")
        return study_file(self.found[name].study)

    def safely(self, make: Callable[[], io.BytesIO]) -> io.BytesIO:
        """What is made, or the sentence of why not, on the page and in the file."""
        self.used = time.monotonic()
        try:
            return make()
        except InputError as error:
            why = str(error)
        except Exception:
            log.exception("a download failed")
            why = OWN_FAULT
        self._alert(why, "warning")
        return io.BytesIO(f"{why}\n".encode())


def _percent(value: float) -> str:
    # Without a number where every pixel that counts is saturated.
    return f"{100 * float(value):.2f} %" if value == value else "(saturated)"
