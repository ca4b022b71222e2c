"""The command line: one verb each, from a study file or flags."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mauvecl import __version__, verbs
from mauvecl.cli_limits import detection_map, exposure, limit
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
    TemplateFlag,
    TimeFlag,
    VariancesFlag,
    study_from_flags,
)

if TYPE_CHECKING:
    from astropy.table import QTable

app = typer.Typer(
    name="mauvecl",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Would the Mauve satellite see this stellar flare, and how sure can one be?\n\n"
    "Start with `mauvecl detect`, which answers the question of the MauveSim paper. The throughput is nominal, not a "
    "flight calibration. Exit codes: 0 done, 2 bad input, 130 interrupted.",
)


@app.command()
def library(as_json: JsonFlag = False) -> None:
    """List the embedded spectra.

    Example: mauvecl library
    """
    from mauvecl.host.catalogue import library_table
    from mauvecl.report import rows

    table = library_table()
    if as_json:
        print(json.dumps(rows(table), indent=2))
        return
    from mauvecl.console import show_table

    columns = ("name", "also", "type", "star", "UV at 190-210, 240-260, 290-310 nm", "licence")
    cells = []
    for row in table:
        ratios = ", ".join(part.split()[0] for part in row["uv_quality"].split(": ")[1].split(", "))
        cells.append(tuple(row[n] for n in ("name", "alias", "spectral_type", "star")) + (ratios, row["licence"]))
    show_table("Embedded spectra (UV: mean flux over that at 540-560 nm); origin, citation: --json", columns, cells)


@app.command()
def devices(
    rate: Annotated[bool, typer.Option("--rate/--no-rate", help="Measure each device for a second.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """List the OpenCL devices that the kernels can run on, what each promises, and its rate.

    Rate: pixel-realisations per second of the chi2 statistic, two scenarios. Example: mauvecl devices
    """
    from mauvecl.rate import measured

    found = measured() if rate else measured(measure=False)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    from mauvecl.console import show_table

    cells = [
        (
            str(number),
            f"{record['platform']}: {record['name']}",
            record["driver"],
            record["kind"],
            str(record["compute_units"]),
            f"{record['global_memory'] / 2**30:.1f}",
            record["promise"],
            record["error"] or ("" if record["rate"] is None else f"{record['rate']:.2g} /s"),
            "default" if record["default"] else "",
        )
        for number, record in enumerate(found)
    ]
    columns = ("number", "device", "driver", "kind", "units", "GiB", "promise", "rate", "")
    show_table("OpenCL devices; choose with --device NUMBER or part of a name", columns, cells)


@app.command()
def selftest(
    device: DeviceFlag = None, output: OutputFlag = None, as_json: JsonFlag = False, quiet: QuietFlag = False
) -> None:
    """Known answers, twins, tests of chance and closed forms on your own device, in under a minute.

    Exit code 1 if a check fails. Later run records on the same device carry the outcome. Example: mauvecl selftest
    """
    from dataclasses import asdict

    from mauvecl import report, selftest
    from mauvecl.console import Meter, show_table

    started = time.perf_counter()
    folder = None if output is None else report.make_folder(output)
    with Meter(quiet=quiet or as_json) as meter:
        engine = verbs.engine(device, meter)
        checks = selftest.run(engine)
    seconds = time.perf_counter() - started
    selftest.keep(engine, checks, seconds)
    failed = sum(not check.passed for check in checks)
    if folder is not None:
        report.write_json(selftest.last(engine.device), folder / "selftest.json")
    if as_json:
        print(json.dumps(selftest.last(engine.device) or [asdict(check) for check in checks], indent=2))
    else:
        cells = [("PASS" if check.passed else "FAIL", check.name, check.found) for check in checks]
        show_table(f"Self-test of {engine.device_name}, driver {engine.driver}", ("", "check", "found"), cells)
        outcome = f"{failed} of {len(checks)} checks FAILED" if failed else f"All {len(checks)} checks passed"
        verbs.say([f"{outcome} in {seconds:.0f} s. Promise: {engine.device.promise}."], as_json=as_json)
    if failed:
        raise typer.Exit(1)


@app.command()
def schema() -> None:
    """Print the JSON schema of study files, for editors that check TOML.

    Example: mauvecl schema > study.schema.json, and a first line #:schema study.schema.json in the study
    """
    from mauvecl.study import Study

    print(json.dumps(Study.model_json_schema(), indent=2))


@app.command()
def simulate(
    study_file: StudyFile = None,
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
    seed: SeedFlag = None,
    settings: SetFlag = None,
    realisation: Annotated[int, typer.Option(min=0, help="Which realisation to show.")] = 0,
    output: OutputFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
    pictures: PicturesFlag = True,
) -> None:
    """One observation and what it is made of: star, sky, photon noise, dark, bias, read noise.

    Example: mauvecl simulate --star G2V --magnitude 7.4 --exposure 50 --amplitude 0.24
    """
    from mauvecl import answer, report

    started = time.perf_counter()
    study = study_from_flags(
        study_file, star=star, magnitude=magnitude, band=band, exposure=exposure, instrument=instrument,
        temperature=temperature, sky=sky, target=target, when=when, settings=settings,
        flare={"amplitudes": amplitude, "temperature_k": flare_temperature, "band": flare_band}, run={"seed": seed},
    )  # fmt: skip
    folder = report.make_folder(output or Path("mauvecl-simulate"))
    found = answer.simulate(study, realisation=realisation, flaring=bool(amplitude))
    verbs.say(found.messages, as_json=as_json)
    files, summary = [], []
    draw = verbs.pictures_wanted(pictures, quiet=quiet, as_json=as_json)
    for number, (title, x, table) in enumerate(found.observations, 1):
        stem = f"observation-{number}"
        files += [report.write_table(table, folder / f"{stem}{ending}") for ending in (".ecsv", ".fits")]
        if draw:
            from mauvecl.pictures import observation

            files.append(observation(title, table, folder / f"{stem}.png"))
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
    files.append(report.write_study(study, folder))
    files.append(
        report.write_record(
            "simulate",
            study,
            [x for _, x, _ in found.observations],
            folder,
            engine=None,
            seconds=time.perf_counter() - started,
            messages=found.messages,
        )
    )
    if as_json:
        print(json.dumps({"messages": found.messages, "observations": summary}, indent=2))
        return
    from mauvecl.console import show_table

    show_table(
        "One observation each (closed-form S/N)",
        ("observation", "frames", "peak (nm)", "peak signal (DN)", "best S/N pixel", "best S/N element", "saturated"),
        [
            (s["observation"], str(s["frames"]), f"{s['peak_nm']:.1f}", f"{s['peak_dn']:.0f}", f"{s['snr_pixel']:.2f}",
             f"{s['snr_element']:.1f}", str(s["saturated_pixels"]))
            for s in summary
        ],
    )  # fmt: skip
    verbs.finish(files, started, quiet=quiet, as_json=as_json)


@app.command()
def snr(
    study_file: StudyFile = None,
    star: StarFlag = None,
    magnitude: MagnitudeFlag = None,
    band: BandFlag = None,
    exposure: ExposureFlag = None,
    instrument: InstrumentFlag = None,
    temperature: TemperatureFlag = None,
    sky: SkyFlag = None,
    target: TargetFlag = None,
    when: TimeFlag = None,
    realisations: Annotated[
        int | None, typer.Option("--realisations", "-n", help="Noise realisations [100000].", show_default=False)
    ] = None,
    seed: SeedFlag = None,
    settings: SetFlag = None,
    device: DeviceFlag = None,
    output: OutputFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
    pictures: PicturesFlag = True,
) -> None:
    """Distributions of the signal-to-noise ratio per pixel and per resolution element.

    Example: mauvecl snr --star B2IV --magnitude 3.03 --exposure 5
    """
    from mauvecl import answer, report
    from mauvecl.console import Meter, show_table

    started = time.perf_counter()
    if realisations is None and study_file is None:
        realisations = 100_000
    study = study_from_flags(
        study_file, star=star, magnitude=magnitude, band=band, exposure=exposure, instrument=instrument,
        temperature=temperature, sky=sky, target=target, when=when, settings=settings,
        run={"seed": seed, "realisations": realisations},
    )  # fmt: skip
    folder = report.make_folder(output or Path("mauvecl-snr"))
    with Meter(quiet=quiet or as_json) as meter:
        engine = verbs.engine(device, meter)
        found = answer.snr(study, engine)
    verbs.say(found.messages, as_json=as_json)
    files, cells, data = [], [], []
    for number, (title, result) in enumerate(found.stars, 1):
        for what, table in (("pixel", result.pixel), ("element", result.element)):
            table.meta["study"] = study.toml()
            files.append(report.write_table(table, folder / f"snr-{number}-{what}.ecsv"))
            data.append({"star": title, "per": what, "rows": report.rows(table)})
        budget = result.expectation.noise_budget()
        files.append(report.write_table(budget, folder / f"noise-budget-{number}.ecsv"))
        for row in result.element[::4]:
            cells.append(
                (title, f"{row['wavelength'].value:.1f}", f"{row['expected']:.2f}", f"{row['mean']:.2f}",
                 f"{row['std']:.2f}", f"{row['q2.5']:.2f}", f"{row['q50']:.2f}", f"{row['q97.5']:.2f}")
            )  # fmt: skip
    if verbs.pictures_wanted(pictures, quiet=quiet, as_json=as_json):
        from mauvecl.pictures import signal_to_noise

        files.append(signal_to_noise(found.stars, folder / "snr.png"))
    files.append(report.write_study(study, folder))
    files.append(
        report.write_record(
            "snr",
            study,
            [r.expectation for _, r in found.stars],
            folder,
            engine=engine,
            seconds=time.perf_counter() - started,
            messages=found.messages,
        )
    )
    if as_json:
        print(json.dumps({"messages": found.messages, "stars": data}, indent=2))
        return
    show_table(
        "S/N per 10.5 nm element, every fourth; all in the files",
        ("star", "nm", "closed form", "mean", "std", "2.5 %", "50 %", "97.5 %"),
        cells,
    )
    verbs.finish(files, started, quiet=quiet, as_json=as_json)


@app.command()
def detect(
    study_file: StudyFile = None,
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
    settings: SetFlag = None,
    statistic: StatisticFlag = None,
    fap: FapFlag = None,
    reference: ReferenceFlag = None,
    variances: VariancesFlag = None,
    template: TemplateFlag = None,
    device: DeviceFlag = None,
    output: OutputFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
    pictures: PicturesFlag = True,
) -> None:
    """Would these flares be seen? Thresholds, detection probabilities, distributions.

    Without arguments: the paper's K3V star of V = 3.7 and G2V star of V = 7.4 with flares of 0.76, 2, 8.1 and 24 %,
    50 s, one million realisations.

    Example: mauvecl detect --star K5V --magnitude 6 --amplitude 0.05 --amplitude 0.1 --exposure 30
    """
    from mauvecl import answer, report
    from mauvecl.console import Meter, show_table

    started = time.perf_counter()
    study = study_from_flags(
        study_file, star=star, magnitude=magnitude, band=band, exposure=exposure, instrument=instrument,
        temperature=temperature, sky=sky, target=target, when=when, settings=settings,
        flare={"amplitudes": amplitude, "temperature_k": flare_temperature, "band": flare_band},
        run={"realisations": realisations, "seed": seed, "statistics": statistic, "fap": fap,
             "reference": reference, "variances": variances, "template_temperatures_k": template},
    )  # fmt: skip
    folder = report.make_folder(output or Path("mauvecl-detect"))
    with Meter(quiet=quiet or as_json) as meter:
        engine = verbs.engine(device, meter)
        found = answer.detect(study, engine)
    verbs.say(found.messages, as_json=as_json)
    files = [report.write_table(found.table, folder / "detection.ecsv")]
    files.append(report.write_table(found.departures, folder / "departures.ecsv"))
    for number, entry in enumerate(found.stars, 1):
        files += [report.write_table(table, folder / f"{name}-{number}.ecsv") for name, table in entry.curves().items()]
    if verbs.pictures_wanted(pictures, quiet=quiet, as_json=as_json):
        from mauvecl.pictures import detection, spectra

        amplitudes = study.flare.amplitudes
        files.append(detection(found.stars, amplitudes, study.run.fap, folder / "detection.png"))
        groups = [(s.label, s.found.quiet, s.found.flares) for s in found.stars]
        files.append(spectra(groups, amplitudes, folder / "spectra.png"))
    files.append(report.write_study(study, folder))
    files.append(
        report.write_record(
            "detect",
            study,
            [x for s in found.stars for x in (s.found.quiet, *s.found.flares)],
            folder,
            engine=engine,
            seconds=time.perf_counter() - started,
            messages=[*found.messages, *found.paper],
        )
    )
    if as_json:
        out = {"messages": found.messages, "paper": found.paper, "rows": report.rows(found.table),
               "departures": report.rows(found.departures)}  # fmt: skip
        print(json.dumps(out, indent=2))
        return
    run = study.run
    frames = found.stars[0].found.quiet
    show_table(
        f"Detection at a false-alarm probability of {run.fap:g} per test, {frames.exposure_s:g} s "
        f"({frames.n_frames} frames), {run.realisations:,} realisations; [95 % interval]",
        ("star", "flare", "statistic", "expected", "simulated", "reduced", "threshold", "detected", "", "closed form"),
        [
            (row["star"], f"{100 * row['amplitude']:g} %", row["statistic"], f"{row['expected']:.2f}",
             f"{row['mean']:.2f}", f"{row['reduced']:.3f}", f"{row['threshold']:.2f}", f"{row['probability']:.4f}",
             f"[{row['low']:.4f}, {row['high']:.4f}]", f"{row['closed_form_probability']:.4f}")
            for row in found.table
        ],
    )  # fmt: skip
    _show_departures(found.departures, run.fap)
    verbs.say(found.paper, as_json=as_json)
    verbs.finish(files, started, quiet=quiet, as_json=as_json)


def _show_departures(table: QTable, fap: float) -> None:
    """Where the simulation differs from the closed form, or that it does not."""
    from mauvecl.console import show_table

    differing = table[table["differs"]]
    if len(table) and not len(differing):
        verbs.say(
            [f"At the thresholds for Gaussian noise the simulated false-alarm probability is {fap:g} within 4 standard "
             "errors, for every statistic."], as_json=False,
        )  # fmt: skip
    if len(differing):
        flares = ["" if math.isnan(a) else f"{100 * a:g} %" for a in differing["amplitude"]]
        show_table(
            f"Where the simulation differs from the closed form: false-alarm probability at the threshold that should "
            f"give {fap:g}",
            ("star", "statistic", "flare", "simulated", "", "ratio", "why"),
            [
                (row["star"], row["statistic"], flare, f"{row['fap']:.3g}",
                 f"[{row['fap_low']:.3g}, {row['fap_high']:.3g}]", f"{row['ratio']:.3f}", row["why"])
                for row, flare in zip(differing, flares, strict=True)
            ],
        )  # fmt: skip


app.command()(exposure)
app.command()(limit)
app.command("map")(detection_map)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"mauvecl {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; bad input is one sentence and exit code 2, never a traceback."""
    from mauvecl.host.errors import InputError

    try:
        app()
    except InputError as error:
        print(f"mauvecl: {error}", file=sys.stderr)
        sys.exit(2)
    except RuntimeError as error:
        # Imported late: program is not needed by verbs that draw nothing.
        from mauvecl.program import DeviceError

        if not isinstance(error, DeviceError):
            raise
        print(f"mauvecl: {error}", file=sys.stderr)
        sys.exit(2)
