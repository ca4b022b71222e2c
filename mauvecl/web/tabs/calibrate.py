"""Calibration of the instrument from a visitor's frames of standard stars."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.stars.source import Source
from mauvecl.schema.errors import InputError
from mauvecl.web.figures import Canvas, curves, target_names
from mauvecl.web.sandboxed_reader import read_limited
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab
from mauvecl.web.upload import MOST_VALUES, VisitorFile, read_frames_of, reported_for

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question
    from mauvecl.web.standards import Observations

#: Pixels that are averaged for a point of the residuals, and values for one of the photon transfer.
BIN, GROUPS = 16, 60
NO_FILES = "Choose an archive of observations; Calibrate then fits the instrument."


class Throughput(Picture):
    """Fitted throughput with its 95 % band, and the nominal one."""

    name, title = "throughput", "Throughput: fitted and nominal"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", "electrons per photon (%)", logs, wavelength=True)
        canvas.band("band", "95 %", "star", alpha=0.35)
        fitted = canvas.line("fitted", "fitted", "star", line_width=2)
        canvas.line("nominal", "nominal", "drawn", line_dash="dashed")
        canvas.tooltips(fitted, ("nm", "x"), ("fitted (%)", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        sources: dict[str, Any] = {name: {"x": [], "y": []} for name in ("fitted", "nominal")}
        sources["band"] = {"x": [], "low": [], "high": []}
        if "calibrate" not in answers:
            return PictureData(NO_FILES, sources)
        table = answers["calibrate"].throughput_table
        nm = table["wavelength"].value
        fitted, nominal = (100 * np.asarray(table[name]) for name in ("throughput", "nominal"))
        wide = np.exp(1.96 * np.asarray(table["relative_error"]))
        sources["band"] = {"x": nm, "low": fitted / wide, "high": fitted * wide}
        sources |= {"fitted": {"x": nm, "y": fitted}, "nominal": {"x": nm, "y": nominal}}
        ratio = fitted / nominal
        text = f"{answers['calibrate'].notice} It is {ratio.min():.3g} to {ratio.max():.3g} times the nominal one."
        return PictureData(text, sources)


class Residuals(Picture):
    """Residuals of each star."""

    name, title = "residuals", "Observed less fitted spectra"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", f"residual of {BIN} pixels (sigma)", logs, wavelength=True)
        canvas.targets("residual", "residual (sigma)")
        canvas.rule("above", "2 sigma", "y")
        canvas.rule("below", "2 sigma", "y")
        canvas.legend.pop()
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        props = {"above": {"location": 2.0}, "below": {"location": -2.0}}
        if "calibrate" not in answers:
            return PictureData(NO_FILES, curves("residual", []), props)
        answer = answers["calibrate"]
        nm, each = answer.throughput.binned_residuals(BIN)
        found = [(nm[kept], row[kept]) for row in each for kept in [np.isfinite(row)]]
        names = target_names([one.name for one in answer.stars])
        words = "; ".join(
            f"{one.name} {np.sqrt(np.nanmean(row**2)):.2f}" for one, row in zip(answer.stars, each, strict=True)
        )
        text = f"Root mean square, 1 for noise alone: {words}; p = {answer.throughput.p_value:.2g}."
        return PictureData(text, curves("residual", found), props, names)


class PhotonTransfer(Picture):
    """Measured over fitted variance."""

    name, title = "transfer", "Photon transfer: variance of frames against their mean"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "fitted variance (DN²)", "measured variance (DN²)", logs | {"x", "y"})
        canvas.line("fitted", "fitted", "drawn")
        dots = canvas.dots("measured", "measured", "star", size=6)
        canvas.tooltips(dots, ("fitted", "x"), ("measured", "y"), mode="mouse")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        sources: dict[str, Any] = {name: {"x": [], "y": []} for name in ("fitted", "measured")}
        if "calibrate" not in answers:
            return PictureData(NO_FILES, sources)
        t = answers["calibrate"].transfer
        groups = np.array_split(np.argsort(t.model), GROUPS)
        model, measured = (np.array([values[group].mean() for group in groups]) for values in (t.model, t.variance))
        sources = {"fitted": {"x": model, "y": model}, "measured": {"x": model, "y": measured}}
        text = f"Gain {t.noise.gain:.4g} +- {t.gain_error:.1g} DN per electron, read noise {t.read_noise_dn:.3g} DN."
        if "gain" in t.assumed:
            text = "The frames do not determine the gain: it is nominal."
        return PictureData(text, sources)


class Calibrate(Tab):
    """Instrument fitted to observations of standard stars."""

    verb = "calibrate"
    about = (
        "The instrument from frames of standard stars and of no light: throughput with its errors, dark current, gain "
        "and line width, next to the nominal values."
    )
    headline = False
    pictures = (Throughput(), Residuals(), PhotonTransfer())
    files = dict.fromkeys(("calibrate", "fits", "throughput", "dark"), "calibrate")
    documents = {"instrument.zip": "calibrate"}  # noqa: RUF012

    def given(self, question: Question) -> dict[str, Any]:
        """Read frames and spectra; raises InputError if a file cannot be read."""
        if "observations" not in question.uploads:
            return {}
        archive: Observations = question.uploads["observations"]
        files = {name: VisitorFile(name, content) for name, content in archive.files.items()}
        frames, stars = [], []
        for one in archive.rows:
            mapping = files[str(one.mapping)] if one.mapping else None
            frames.append(read_frames_of(files[str(one.frames)], mapping, "observations"))
            if sum(some.flux.size for some in frames) > MOST_VALUES:
                raise InputError(
                    "the archive holds more raw values than are read here", f"{MOST_VALUES}, or the command line",
                    key="observations", value=archive.name,
                )  # fmt: skip
            if one.spectrum is None:
                stars.append(one.source())
                continue
            with reported_for("observations", str(one.spectrum)):
                star = read_limited(files[str(one.spectrum)].content, Source)
            stars.append(star if one.magnitude is None else star.at_magnitude(one.magnitude, one.band))
        return {"frames": tuple(frames), "stars": tuple(stars)}

    def words(self, question: Question) -> str:
        """Return the name of the archive."""
        return question.uploads["observations"].name if "observations" in question.uploads else "no observations yet"
