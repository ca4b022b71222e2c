"""The exposure that gives a wanted S/N at a wavelength, and the S/N that an exposure gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from mauvecl.answers.answer import Answer
from mauvecl.answers.progress import reported
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message
from mauvecl.schema.physical import DAY_S, Wavelength
from mauvecl.schema.tables import Column, View, table_of
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import star_column
from mauvecl.study.messages import collect_messages
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from collections.abc import Callable

    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use

Per = Literal["pixel", "element"]
#: Longest time that is considered, s: many exposures, added up.
LONGEST_S = 1e7


@dataclass(frozen=True)
class Exposure:
    """Exposure time, in whole frames, that reaches an S/N."""

    star: str
    wavelength_nm: float
    per: Per
    wanted: float
    exposure_s: float
    frames: int
    snr: float
    snr_one_frame_less: float
    saturated: bool


def _floored(snr: float) -> str:
    """Round an S/N down to three digits, so that an insufficient one does not appear sufficient."""
    return f"{math.floor(1000 * snr) / 1000:.3f}"


#: Columns of the table of exposures.
COLUMNS = (
    star_column(),
    Column("wavelength", "wavelength_nm", "nm", "vacuum wavelength, the middle of the pixel or element"),
    Column("per", description="pixel, or resolution element of 10.5 nm"),
    Column("wanted", description="wanted S/N"),
    Column("exposure", "exposure_s", "s", "the fewest frames whose closed-form S/N reaches the wanted one",
           "exposure (s)", ".10g"),
    Column("frames", description="frames of the exposure", heading="frames"),
    Column("snr", description="closed-form S/N reached", heading="S/N", format=".3f"),
    Column("snr_one_frame_less", description="closed-form S/N of one frame less", heading="a frame less",
           format=_floored),
    Column("saturated", description="whether the pixel, or one of the element, saturates in a single frame",
           heading="saturation", format=lambda saturated: "SATURATED" if saturated else ""),
)  # fmt: skip


@dataclass(frozen=True)
class ExposureAnswer(Answer):
    """The answer of `exposure_for`, one row per star."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky")

    study: Study
    exposures: tuple[Exposure, ...]
    messages: tuple[str, ...]
    expectations: tuple[Expectation, ...]  # each star at its exposure

    @property
    def table(self) -> QTable:
        """One row per star."""
        return table_of(COLUMNS, self.exposures, study=self.study.text())

    @property
    def tables(self) -> dict[str, Table]:
        """The only table."""
        return {"exposure": self.table}

    @property
    def views(self) -> list[View]:
        wanted = self.study.signal
        title = f"Exposure for an S/N of {wanted.snr:g} per {wanted.per} at {wanted.wavelength_nm:g} nm"
        return [View(f"{title} (closed form, whole frames)", COLUMNS, self.table)]

    @property
    def inputs(self) -> list[Expectation]:
        return list(self.expectations)


def snr_at(x: Expectation, wavelength_nm: float, per: Per = "element") -> float:
    """Return the closed-form S/N of the pixel or 10.5 nm element at a wavelength; see `place_of`."""
    return float((x.snr_per_element() if per == "element" else x.snr())[place_of(x, wavelength_nm, per)])


def place_of(x: Expectation, wavelength_nm: float, per: Per) -> int:
    """Return the index of the pixel or element at a wavelength; raises InputError outside the spectrum."""
    if per not in ("pixel", "element"):
        raise InputError(f"S/N per {per!r}", "pixel or element", key="per", value=per)
    first, last = float(x.wavelength_nm[0]), float(x.wavelength_nm[-1])
    if not first <= wavelength_nm <= last:
        raise InputError.of("wavelength", wavelength_nm, f"{first:.1f} to {last:.1f} nm", unit="nm")
    pixel = int(np.argmin(np.abs(x.wavelength_nm - wavelength_nm)))
    return int(x.element[pixel]) if per == "element" else pixel


@validated
def exposure(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> ExposureAnswer:
    """Compute the fewest frames whose closed-form S/N at a wavelength reaches a wanted one.

    Parameters
    ----------
    study : Study
        Its ``signal`` gives S/N and wavelength; its exposure is not used.
    engine : Engine or Pool, optional
        Not used: nothing is drawn.
    progress : callable, optional
        Called as ``progress(done, total)`` in stars.

    Raises
    ------
    InputError
        For an S/N that no exposure up to 1e7 s reaches, or a wavelength outside the spectrum, if it holds of every
        star; of some it is reported by a message.
    """
    snr, wavelength_nm, per = study.signal.snr, study.signal.wavelength_nm, study.signal.per
    if snr is None or wavelength_nm is None:
        missing = "S/N" if snr is None else "wavelength"
        raise InputError(
            f"no wanted {missing}",
            "`signal.snr` and `signal.wavelength_nm`",
            key="signal.snr" if snr is None else "signal.wavelength_nm",
        )
    answered, failed = [], []
    prepared = cases(study, swept=False)
    for case in reported(prepared, len(prepared), progress):
        try:
            answered.append(_one(case, snr, wavelength_nm, per))
        except InputError as error:
            # The exposures of other stars are still computed.
            failed.append(error)
    if not answered:
        raise failed[0]
    exposures, seen = zip(*answered, strict=True)
    long = [
        Message(
            f"{e.star} needs more than a day: {np.ceil(e.exposure_s / DAY_S):.0f} exposures of a day at most, added "
            "up.",
            "long exposure",
        )
        for e in exposures
        if e.exposure_s > DAY_S
    ]
    messages = [
        *(Message(f"NO ANSWER: {error}.", "no answer") for error in failed),
        *collect_messages(list(seen)),
        *long,
    ]
    return ExposureAnswer(study, exposures, tuple(messages), seen)


@validated
def exposure_for(
    study: Study, snr: float | None = None, wavelength_nm: Wavelength | None = None, *, per: Per | None = None
) -> ExposureAnswer:
    """Compute `exposure` for another S/N or wavelength than the study's.

    Parameters
    ----------
    study : Study
        Its exposure is not used.
    snr : float, optional
    wavelength_nm : Quantity, or float in nm, optional
        In place of those of the study's ``signal``.
    per : {"element", "pixel"}, optional
        A resolution element of 10.5 nm, or one pixel.

    Raises
    ------
    InputError
        As `exposure`.
    """
    study = study.with_changes({"signal": {"snr": snr, "wavelength_nm": wavelength_nm, "per": per}}, None, "exposure")
    return exposure(study)


def _one(case: Case, snr: float, wavelength_nm: float, per: Per) -> tuple[Exposure, Expectation]:
    """Return the fewest frames for an S/N, and the expectation of as many."""
    frame, frame_s = case.one_frame.quiet, case.instrument.frame_s

    def after(frames: int) -> Expectation:
        # The frames may exceed one exposure.
        return replace(frame, n_frames=frames)

    one = snr_at(after(1), wavelength_nm, per)
    if not one > 0 or (snr / one) ** 2 * frame_s > LONGEST_S:
        raise InputError(
            f"{case.one_frame.label} has an S/N of {one:.3g} per {per} at {wavelength_nm:g} nm in one frame",
            f"enough for {snr:g} within {LONGEST_S:g} s{frame.saturation_clause}",
            key="signal.snr",
            value=snr,
        )
    # S/N is proportional to the root of the number of frames, so only rounding has to be corrected.
    frames = max(int(np.ceil((snr / one) ** 2)), 1)
    while frames > 1 and snr_at(after(frames - 1), wavelength_nm, per) >= snr:
        frames -= 1
    while snr_at(after(frames), wavelength_nm, per) < snr:
        frames += 1
    x = after(frames)
    place = place_of(x, wavelength_nm, per)
    here = x.saturated[x.element == place] if per == "element" else x.saturated[[place]]
    answer = Exposure(
        star=case.one_frame.label,
        wavelength_nm=wavelength_nm,
        per=per,
        wanted=snr,
        exposure_s=x.exposure_s,
        frames=x.n_frames,
        snr=snr_at(x, wavelength_nm, per),
        snr_one_frame_less=snr_at(after(frames - 1), wavelength_nm, per) if frames > 1 else 0.0,
        saturated=bool(here.any()),
    )
    return answer, x
