"""The verbs that look at a star: one observation, its signal to noise, the exposure for a wanted one."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mauvecl.cli.console import short
from mauvecl.cli.flags import DRAWS, FLARE, SIGNAL, SWEEP, takes_study

if TYPE_CHECKING:
    from mauvecl.answers.snr import SnrAnswer
    from mauvecl.cli.session import Session
    from mauvecl.study.study import Study


@takes_study(FLARE, {"seed": DRAWS["seed"]}, draws=False)
def simulate(
    study: Study,
    session: Session,
    given: dict[str, Any],
    realisation: Annotated[int, typer.Option(min=0, max=2**63 - 1, help="Which realisation to show.")] = 0,
) -> None:
    """One observation and what it is made of: star, sky, photon noise, dark, bias, read noise.

    Example: mauvecl simulate --star G2V --magnitude 7.4 --exposure 50 --amplitude 0.24
    """
    from mauvecl.answers.simulate import simulate as compute

    found = compute(study, realisation=realisation, flaring=bool(given["amplitude"]))
    session.say(found.messages)
    summary = []
    for number, (title, x, table) in enumerate(found.observations, 1):
        stem = f"observation-{number}"
        for ending in (".ecsv", ".fits"):
            session.write(table, f"{stem}{ending}")
        if session.draws_pictures:
            from mauvecl.pictures.answers import observation

            session.leave(partial(observation, title, table, session.folder / f"{stem}.png"))
        peak = int(x.signal_dn.argmax())
        summary.append(
            {
                "observation": title,
                "frames": x.n_frames,
                "peak_nm": float(x.wavelength_nm[peak]),
                "peak_dn": float(x.signal_dn[peak]),
                "snr_pixel": float(x.snr().max()),
                "snr_element": float(x.snr_per_element().max()),
                "saturated_pixels": int(x.saturated.sum()),
            }
        )
    session.record(study, [x for _, x, _ in found.observations], found.messages)
    if session.as_json:
        session.print_json({"messages": found.messages, "observations": summary})
        return
    from mauvecl.cli.console import show_table

    show_table(
        "One observation each (closed-form S/N)",
        ("observation", "frames", "peak (nm)", "peak signal (DN)", "best S/N pixel", "best S/N element", "saturated"),
        [
            (s["observation"], str(s["frames"]), f"{s['peak_nm']:.1f}", f"{s['peak_dn']:.0f}", f"{s['snr_pixel']:.2f}",
             f"{s['snr_element']:.1f}", str(s["saturated_pixels"]))
            for s in summary
        ],
    )  # fmt: skip
    session.finish()


def _budgets_or_star(given: dict[str, Any]) -> Study:
    """The paper's noise budgets where nothing is named, else the paper's stars."""
    from mauvecl.study.study import PAPER_BUDGETS, Study

    named = any(given[name] for name in ("star", "magnitude", "exposure", "sweep"))
    return Study() if named else PAPER_BUDGETS


@takes_study(DRAWS, SWEEP, fewer=True, default=_budgets_or_star)
def snr(
    study: Study,
    session: Session,
) -> None:
    """Distributions of the signal-to-noise ratio per pixel and per resolution element, and noise budgets.

    Without arguments: the three stars of the paper's noise budgets, 50 s and 600 s.

    Examples: mauvecl snr --star B2IV --magnitude 3.03 --exposure 5

    mauvecl snr --star G2V --sweep magnitude=4,6,8,10 --sweep exposure=5,50,600
    """
    from mauvecl.answers import report
    from mauvecl.answers.snr import snr as compute

    with session.pool() as engine:
        found = compute(study, engine)
    session.say(found.messages)
    tables = {"snr-pixel": found.pixel, "snr-element": found.element, "noise-budget": found.noise_budget}
    for name, table in tables.items():
        session.write(table, f"{name}.ecsv")
    if session.draws_pictures:
        session.leave(lambda: _snr_pictures(found, session.folder))
    session.record(study, [star.result.expectation for star in found.stars], found.messages)
    if session.as_json:
        out = {name: report.rows(tables[name]) for name in ("snr-element", "noise-budget")}
        session.print_json({"messages": found.messages} | out)
        return
    _show_snr(found)
    session.finish()


def _snr_pictures(found: SnrAnswer, folder: Path) -> list[Path]:
    from mauvecl.pictures.answers import signal_to_noise
    from mauvecl.pictures.plans import noise_budgets, snr_sweep

    files = [noise_budgets(found, folder / "noise-budget.png")]
    if len(found.stars) <= 6:
        files.append(signal_to_noise([(s.title, s.result) for s in found.stars], folder / "snr.png"))
    if found.study.sweep.axes:
        files.append(snr_sweep(found, folder / "snr-sweep.png"))
    return files


def _show_snr(found: SnrAnswer) -> None:
    """S/N and noise at some wavelengths; all of them are in the files."""
    from mauvecl.answers.exposures import place_of
    from mauvecl.cli.console import show_table

    cells, budgets = [], []
    for star in found.stars:
        x, table = star.result.expectation, star.result.element
        budget = x.noise_budget()
        name = (star.label, *map(short, star.at.values()))
        for wavelength in star.shown_nm:
            row, noise = table[place_of(x, wavelength, "element")], budget[place_of(x, wavelength, "pixel")]
            cells.append(
                (*name, f"{row['wavelength'].value:.1f}", f"{row['expected']:.2f}", f"{row['mean']:.2f}",
                 f"{row['std']:.2f}", f"{row['q2.5']:.2f}", f"{row['q50']:.2f}", f"{row['q97.5']:.2f}")
            )  # fmt: skip
            parts = ("source_photon", "zodiacal_photon", "dark", "read", "total")
            budgets.append((*name, f"{wavelength:g}", *(f"{noise[part].value:.2f}" for part in parts)))
    swept = tuple(axis.quantity for axis in found.study.sweep.axes)
    show_table(
        "S/N per 10.5 nm element; all of them in the files",
        ("star", *swept, "nm", "closed form", "mean", "std", "2.5 %", "50 %", "97.5 %"),
        cells,
    )
    show_table(
        "Noise of a pixel by origin, DN rms",
        ("star", *swept, "nm", "source photons", "zodiacal photons", "dark", "read", "total"),
        budgets,
    )


@takes_study(SIGNAL, without="exposure", draws=False)
def exposure(
    study: Study,
    session: Session,
) -> None:
    """The shortest exposure with a wanted S/N at a wavelength, by the closed form; `mauvecl snr` goes the other way.

    Example: mauvecl exposure --snr 10 --at 300 --star G2V --magnitude 7.4
    """
    from mauvecl.answers import report
    from mauvecl.answers.exposures import exposure_for
    from mauvecl.cli.console import show_table
    from mauvecl.cli.limits import drawn

    found, wanted = exposure_for(study), study.signal
    session.leave(lambda: found.write(session.folder))
    if session.draws_pictures:
        session.leave(lambda: drawn(found, session.folder / "exposure.png"))
    session.say(list(found.messages))
    if session.as_json:
        session.print_json({"messages": list(found.messages), "rows": report.rows(found.table)})
        return
    show_table(
        f"Exposure for an S/N of {wanted.snr:g} per {wanted.per} at {wanted.wavelength_nm:g} nm "
        "(closed form, whole frames)",
        ("star", "exposure (s)", "frames", "S/N", "a frame less", ""),
        [
            (e.star, f"{e.exposure_s:g}", str(e.frames), f"{e.snr:.3f}", f"{e.snr_one_frame_less:.3f}",
             "SATURATED" if e.saturated else "")
            for e in found.exposures
        ],
    )  # fmt: skip
    session.finish()
