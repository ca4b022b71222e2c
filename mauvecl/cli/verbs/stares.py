"""The verbs that look at a star for hours."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from mauvecl.cli.flags import DRAWS, FLARE, SIZE, STARE, SWEEP, DeviceFlag
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.answers.stares.stare import StareAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study(FLARE, STARE, SIZE, {"seed": DRAWS["seed"]}, SWEEP, without="exposure", draws=False, resumes=True)
def stare(
    study: Study,
    session: Session,
    given: dict[str, Any],
    device: DeviceFlag = None,
) -> None:
    """One simulated stare: light curves, spectra, flares, a search.

    Without arguments: the paper's two stars over one orbit, four flares each. The FITS files are read by lightkurve.

    Examples: mauvecl stare --star M3V --magnitude 9 --amplitude 0.5 --half-width 60 --thermal 0.5

    mauvecl stare --star G2V --magnitude 7.4 --distance 14.1 --energy 1e33 --energy 1e34 --orbit-gap 2100
    """
    from mauvecl.answers.stares.stare import stare as compute
    from mauvecl.device.stares import Stares
    from mauvecl.schema.errors import InputError

    if given["energy"] and (given["amplitude"] or given["flares"]):
        raise InputError("--energy is given beside --amplitude or --flares, expected one of them")

    stares = Stares(device)
    session.opened = stares.open_device
    with session.checkpoint() as checkpoint:
        answer = compute(study, stares, checkpoint=checkpoint)
    session.answer(answer, lambda: _show(answer))


def _show(answer: StareAnswer) -> None:
    from mauvecl.answers.stares.stare import Searched
    from mauvecl.cli.console import short, show_table

    swept = tuple(axis.quantity for axis in answer.study.sweep.axes)
    show_table(
        "One stare each",
        ("star", *swept, "frames", "recorded (s)", "intervals", "light (DN/s)", "noise of a frame", "saturated"),
        [
            (one.label, *map(short, one.at.values()), str(row["frames"]), f"{row['observed'].value:g}",
             str(row["intervals"]), f"{row['flux'].value:.4g}", f"{100 * row['frame_noise']:.3g} %",
             str(row["saturated_frames"]))
            for one, row in zip(answer.stares, answer.table, strict=True)
        ],
    )  # fmt: skip
    events = answer.events
    show_table(
        "Flares in them; S/N of one who knows all but whether the flare is there",
        ("star", *swept, "peak at (s)", "half-width (s)", "peak", "ED (s)", "bolometric (erg)", "S/N"),
        [
            (row["star"], *(short(getattr(row[name], "value", row[name])) for name in swept),
             f"{row['peak_time'].value:.6g}", f"{row['half_width'].value:g}", f"{100 * row['peak']:.3g} %",
             f"{row['equivalent_duration'].value:.4g}", _energy(row["energy_bolometric"].value), f"{row['snr']:.3g}")
            for row in events
        ],
    )  # fmt: skip
    for one in answer.stares:
        if isinstance(one.searched, Searched):
            show_table(
                f"Found at {one.title} above {one.searched.threshold:.2f}, {_rate(answer)}",
                ("peak at (s)", "amplitude", "half-width (s)", "temperature (K)", "bolometric (erg)", "value", "flare"),
                [
                    ("not measured", "", "", "", "", f"{a.rho:.2f}", "none") if not a.measured else
                    (f"{a.recovered.peak_s[0]:.6g}",
                     f"{_with_error(100 * a.recovered.amplitude[0], 100 * a.recovered.amplitude_error[0])} %",
                     _with_error(a.recovered.half_width_s[0], a.recovered.half_width_error_s[0]),
                     _with_error(a.recovered.temperature_k[0], a.recovered.temperature_error_k[0]),
                     _energy(energy), f"{a.rho:.2f}", str(event) if event else "none")
                    for a, energy, event in zip(
                        one.searched.alarms, one.searched.bolometric_erg, one.searched.events, strict=True
                    )
                ],
            )  # fmt: skip


def _rate(answer: StareAnswer) -> str:
    """How many false alarms there are at the threshold, in words."""
    asked = answer.study.search
    alarms = "false alarm" if asked.false_alarms == 1 else "false alarms"
    return f"{asked.false_alarms:g} {alarms} per star-{asked.per}"


def _with_error(value: float, error: float) -> str:
    """To the error's two leading digits: 9979 ± 120, not 1e+02."""
    if not (math.isfinite(error) and error > 0):
        return f"{value:.3g}"
    digits = max(1 - math.floor(math.log10(error)), 0)
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _energy(erg: float) -> str:
    """An energy, or nothing where the star's size is unknown."""
    return f"{erg:.3g}" if erg == erg else ""
