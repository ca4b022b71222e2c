"""The verbs that search and sweep: limits and maps."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mauvecl import verbs
from mauvecl.flags import (
    AmplitudeFlag,
    BandFlag,
    DeviceFlag,
    ExposureFlag,
    FapFlag,
    FlareBandFlag,
    FlareTemperatureFlag,
    InstrumentFlag,
    JsonFlag,
    MagnitudeFlag,
    OutputFlag,
    PicturesFlag,
    QuietFlag,
    RealisationsFlag,
    ReferenceFlag,
    SeedFlag,
    SetFlag,
    SkyFlag,
    StarFlag,
    StatisticFlag,
    StudyFile,
    TargetFlag,
    TemperatureFlag,
    TimeFlag,
    VariancesFlag,
    study_from_flags,
)

if TYPE_CHECKING:
    from mauvecl.study import Study


def limit(
    study_file: StudyFile = None,
    of: Annotated[
        str | None, typer.Option(help="magnitude, amplitude or exposure [magnitude].", show_default=False)
    ] = None,
    power: Annotated[float | None, typer.Option(help="Wanted detection probability [0.9].", show_default=False)] = None,
    star: StarFlag = None,
    magnitude: MagnitudeFlag = None,
    band: BandFlag = None,
    exposure: ExposureFlag = None,
    instrument: InstrumentFlag = None,
    temperature: TemperatureFlag = None,
    sky: SkyFlag = None,
    target: TargetFlag = None,
    when: TimeFlag = None,
    amplitude: AmplitudeFlag = None,
    flare_temperature: FlareTemperatureFlag = None,
    flare_band: FlareBandFlag = None,
    realisations: RealisationsFlag = None,
    seed: SeedFlag = None,
    statistic: StatisticFlag = None,
    fap: FapFlag = None,
    reference: ReferenceFlag = None,
    variances: VariancesFlag = None,
    assumptions: Annotated[
        bool, typer.Option("--assumptions", help="Also: how far what is assumed of the instrument moves it.")
    ] = False,
    settings: SetFlag = None,
    device: DeviceFlag = None,
    output: OutputFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
    pictures: PicturesFlag = True,
) -> None:
    """The limiting magnitude of a flare, its smallest amplitude, or the shortest exposure that shows it.

    Starts from the closed form, settles it by simulation, and simulates the answer again with a fresh seed.

    Example: mauvecl limit --star G2V --amplitude 0.24 --exposure 50
    """
    from mauvecl import report
    from mauvecl.answer import told
    from mauvecl.console import Meter, show_table
    from mauvecl.limits import limiting_magnitude

    started = time.perf_counter()
    study = study_from_flags(
        study_file, star=star, magnitude=magnitude, band=band, exposure=exposure, instrument=instrument,
        temperature=temperature, sky=sky, target=target, when=when, settings=settings,
        flare={"amplitudes": amplitude, "temperature_k": flare_temperature, "band": flare_band},
        run={"realisations": realisations, "seed": seed, "statistics": statistic, "fap": fap,
             "reference": reference, "variances": variances},
        limit={"of": of, "power": power},
    )  # fmt: skip
    folder = report.make_folder(output or Path("mauvecl-limit"))
    with Meter(quiet=quiet or as_json) as meter:
        engine = verbs.engine(device, meter)
        found = limiting_magnitude(study, engine)
    inputs = [study.expect([entry.source()])[0] for entry in study.star]
    # What is told of a star at its own magnitude need not hold at the limit.
    messages = [m for m in told(inputs) if not m.startswith("SATURATED")]
    verbs.say(messages, as_json=as_json)
    files = found.write(folder)
    moved = None
    if assumptions:
        from mauvecl.assumptions import what_matters

        moved = what_matters(study)
        files.append(report.write_table(moved, folder / "assumptions.ecsv"))
    if verbs.pictures_wanted(pictures, quiet=quiet, as_json=as_json):
        files.append(_drawn(found, folder / "limit.png"))
    files.append(
        report.write_record(
            "limit", study, inputs, folder, engine=engine, seconds=time.perf_counter() - started, messages=messages
        )
    )
    if as_json:
        rows = {"messages": messages, "rows": report.rows(found.table)}
        print(json.dumps(rows if moved is None else rows | {"assumptions": report.rows(moved)}, indent=2))
        return
    asked, run = study.limit, study.run
    cells = []
    digits = ".3f" if asked.of == "magnitude" else ".4g"
    for one in found.limits:
        p, value = one.check.probability, one.value
        flare = "" if asked.of == "amplitude" else f"{100 * one.amplitude:g} %"
        cells.append(
            (one.star, flare, one.statistic, f"{value.value:{digits}}",
             f"[{value.low:{digits}}, {value.high:{digits}}]", f"{one.closed_form:{digits}}",
             f"{p.value:.4f}", f"[{p.low:.4f}, {p.high:.4f}]", "agrees" if one.agrees else "DIFFERS")
        )  # fmt: skip
    show_table(
        f"Limit of {asked.of} at a detection probability of {asked.power:g}, false-alarm probability {run.fap:g} per "
        f"test, {run.realisations:,} realisations; [95 % interval]",
        ("star", "flare", "statistic", asked.of, "", "closed form", "simulated again there", "", ""),
        cells,
    )
    if moved is not None:
        show_table(
            f"What is assumed, and how far it moves the closed-form limit of {asked.of}, the largest first",
            ("star", "flare", "statistic", "assumption", "from", "to", "limit from", "to", "moves by"),
            [
                (m["star"], f"{100 * m['amplitude']:g} %", m["statistic"], m["assumption"], m["low_end"], m["high_end"],
                 f"{m['at_low_end']:.3f}", f"{m['at_high_end']:.3f}", f"{m['span']:.3f}")
                for m in moved
            ],
        )  # fmt: skip
    verbs.finish(files, started, quiet=quiet, as_json=as_json)


def _drawn(found: Any, path: Path) -> Path:
    found.plot(path)
    return path


def _axis(text: str, flag: str) -> dict[str, Any]:
    """An axis as a word: magnitude:4:10:16, amplitude:0.01:1:16:log, or exposure=5,50,600."""
    from mauvecl.host.errors import InputError

    if "=" in text:
        quantity, _, values = text.partition("=")
        words = [word.strip() for word in values.split(",")]
        try:
            return {"quantity": quantity, "values": words if quantity == "star" else [float(word) for word in words]}
        except ValueError as error:
            raise InputError(f"{flag} {text!r}, expected numbers, such as {quantity}=5,50,600") from error
    parts = text.split(":")
    try:
        quantity, start, stop, steps, *rest = parts
        found = {"quantity": quantity, "start": float(start), "stop": float(stop), "steps": int(steps)}
    except ValueError as error:
        raise InputError(
            f"{flag} {text!r}, expected quantity:start:stop:steps, with :log behind it if wanted, or quantity=a,b,c"
        ) from error
    if rest not in ([], ["log"]):
        raise InputError(f"{flag} {text!r} ends in {':'.join(rest)!r}, expected log or nothing")
    return found | {"log": bool(rest)}


def detection_map(
    study_file: StudyFile = None,
    x: Annotated[
        str | None, typer.Option(help="Such as magnitude:4:10:16, or exposure=5,50,600.", show_default=False)
    ] = None,
    y: Annotated[str | None, typer.Option(help="Such as amplitude:0.01:1:16:log.", show_default=False)] = None,
    star: StarFlag = None,
    magnitude: MagnitudeFlag = None,
    band: BandFlag = None,
    exposure: ExposureFlag = None,
    instrument: InstrumentFlag = None,
    temperature: TemperatureFlag = None,
    sky: SkyFlag = None,
    target: TargetFlag = None,
    when: TimeFlag = None,
    amplitude: AmplitudeFlag = None,
    flare_temperature: FlareTemperatureFlag = None,
    flare_band: FlareBandFlag = None,
    realisations: Annotated[
        int | None, typer.Option("--realisations", "-n", help="In each cell [100000].", show_default=False)
    ] = None,
    seed: SeedFlag = None,
    statistic: StatisticFlag = None,
    fap: FapFlag = None,
    reference: ReferenceFlag = None,
    variances: VariancesFlag = None,
    settings: SetFlag = None,
    device: DeviceFlag = None,
    output: OutputFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
    pictures: PicturesFlag = True,
) -> None:
    """Detection probability over two quantities, for one star.

    Quantities: magnitude, amplitude, flare_temperature, exposure, detector_temperature, sky, star. All cells are drawn
    with the same random numbers.

    Example: mauvecl map --star G2V --x magnitude:4:10:16 --y amplitude:0.01:1:16:log
    """
    from mauvecl import report
    from mauvecl.console import Meter
    from mauvecl.maps import detection_map as compute

    started = time.perf_counter()
    if realisations is None and study_file is None:
        realisations = 100_000
    study = study_from_flags(
        study_file, star=star, magnitude=magnitude, band=band, exposure=exposure, instrument=instrument,
        temperature=temperature, sky=sky, target=target, when=when, settings=settings,
        flare={"amplitudes": amplitude, "temperature_k": flare_temperature, "band": flare_band},
        run={"realisations": realisations, "seed": seed, "statistics": statistic, "fap": fap,
             "reference": reference, "variances": variances},
        map={"x": None if x is None else _axis(x, "--x"), "y": None if y is None else _axis(y, "--y")},
    )  # fmt: skip
    folder = report.make_folder(output or Path("mauvecl-map"))
    with Meter(quiet=quiet or as_json, unit="cells") as meter:
        engine = verbs.engine(device, None)
        found = compute(study, engine, progress=meter)
    verbs.say(found.messages, as_json=as_json)
    files = found.write(folder)
    if verbs.pictures_wanted(pictures, quiet=quiet, as_json=as_json):
        files.append(_drawn(found, folder / "map.png"))
    inputs = [found.study.expect([found.study.star[0].source()])[0]]
    files.append(
        report.write_record(
            "map", study, inputs, folder, engine=engine, seconds=time.perf_counter() - started, messages=found.messages
        )
    )
    if as_json:
        print(json.dumps({"messages": found.messages, "rows": report.rows(found.table)}, indent=2))
        return
    _show(found, study)
    verbs.finish(files, started, quiet=quiet, as_json=as_json)


def _show(found: Any, study: Study) -> None:
    """The map as tables of percentages, one per statistic."""
    from mauvecl.console import show_table

    def text(value: float | str) -> str:
        return value if isinstance(value, str) else f"{value:.3g}"

    corner = f"{study.map.y.quantity}, {study.map.x.quantity}"
    for statistic, probability in zip(found.statistics, found.probability, strict=True):
        rows = [(text(y), *(f"{100 * p:.0f}" for p in row)) for y, row in zip(found.y, probability, strict=True)]
        show_table(
            f"{found.star}: detection probability in percent, {statistic}, fap {study.run.fap:g} per test",
            (corner, *(text(x) for x in found.x)),
            rows,
        )


def exposure(
    snr: Annotated[float, typer.Option(help="Wanted signal-to-noise ratio.")],
    at: Annotated[float, typer.Option(help="Wavelength, nm.")],
    study_file: StudyFile = None,
    per: Annotated[str, typer.Option(help="element (10.5 nm) or pixel.")] = "element",
    star: StarFlag = None,
    magnitude: MagnitudeFlag = None,
    band: BandFlag = None,
    instrument: InstrumentFlag = None,
    temperature: TemperatureFlag = None,
    sky: SkyFlag = None,
    target: TargetFlag = None,
    when: TimeFlag = None,
    settings: SetFlag = None,
    output: OutputFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """The shortest exposure with a wanted S/N at a wavelength, by the closed form; `mauvecl snr` goes the other way.

    Example: mauvecl exposure --snr 10 --at 300 --star G2V --magnitude 7.4
    """
    from typing import cast

    from mauvecl import report
    from mauvecl.console import show_table
    from mauvecl.exposures import Per, exposure_for

    started = time.perf_counter()
    study = study_from_flags(
        study_file, star=star, magnitude=magnitude, band=band, exposure=None, instrument=instrument,
        temperature=temperature, sky=sky, target=target, when=when, settings=settings,
    )  # fmt: skip
    found = exposure_for(study, snr, at, per=cast(Per, per))
    folder = report.make_folder(output or Path("mauvecl-exposure"))
    table = found.table
    files = [report.write_table(table, folder / "exposure.ecsv"), report.write_study(study, folder)]
    verbs.say(list(found.messages), as_json=as_json)
    if as_json:
        print(json.dumps({"messages": list(found.messages), "rows": report.rows(table)}, indent=2))
        return
    show_table(
        f"Exposure for an S/N of {snr:g} per {per} at {at:g} nm (closed form, whole frames)",
        ("star", "exposure (s)", "frames", "S/N", "a frame less", ""),
        [
            (e.star, f"{e.exposure_s:g}", str(e.frames), f"{e.snr:.3f}", f"{e.snr_one_frame_less:.3f}",
             "SATURATED" if e.saturated else "")
            for e in found.exposures
        ],
    )  # fmt: skip
    verbs.finish(files, started, quiet=quiet, as_json=as_json)
