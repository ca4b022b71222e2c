"""Pictures of answers, with matplotlib (the extra ``plot``). Nothing is computed here."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.labels import titled

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.detect_study import StarDetection
    from mauvecl.exposures import ExposureResult
    from mauvecl.gaussian import GaussianReport
    from mauvecl.limits import LimitResult
    from mauvecl.maps import MapResult
    from mauvecl.roc import Roc
    from mauvecl.snr import SnrResult
    from mauvecl.snr_study import SnrAnswer

#: Okabe and Ito's colours, which colour-blind readers can tell apart (jfly.uni-koeln.de/color).
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7", "#000000")
NULL = "#777777"
#: Panels side by side.
MOST_COLUMNS = 3

STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 160,
    "lines.linewidth": 1.2,
}

NAMES = {
    "chi2": "chi2 over pixels",
    "chi2_element": "chi2 over 10.5 nm elements",
    "chi2_pair": "chi2 against a noisy exposure",
    "matched": "matched filter (standard deviations)",
    "uv_excess": "UV excess (standard deviations)",
    "paper": "the paper's sum on smoothed spectra",
}
AXES = {
    "magnitude": "magnitude",
    "amplitude": "flare amplitude",
    "flare_temperature": "flare temperature (K)",
    "exposure": "exposure (s)",
    "detector_temperature": "detector temperature (deg C)",
    "sky": "sky brightness (V mag / arcsec²)",
    "star": "star",
}


def available() -> bool:
    """Whether matplotlib is installed."""
    from importlib.util import find_spec

    return find_spec("matplotlib") is not None


def pyplot() -> Any:
    """Matplotlib's pyplot, without windows unless a notebook or the user has chosen how figures are shown."""
    import os

    import matplotlib as mpl

    if "MPLBACKEND" not in os.environ:
        mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def finished(figure: Any, path: Path | None) -> Any:
    """Save a figure under a path, in the form of its ending (.png, .pdf, .svg), or hand it out; pyplot forgets it."""
    pyplot().close(figure)
    if path is None:
        return figure
    figure.savefig(path)
    return path


def detection(stars: Sequence[StarDetection], fap: float, path: Path | None = None) -> Any:
    """Null and flare distributions: a row per star, a column per statistic."""
    plt = pyplot()
    statistics = stars[0].found.statistics
    columns = min(len(statistics), MOST_COLUMNS)
    rows = -(-len(statistics) // columns)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            rows * len(stars), columns, figsize=(3.6 * columns, 2.6 * rows * len(stars) + 0.4), squeeze=False
        )
        for k, star in enumerate(stars):
            panels = axes[k * rows : (k + 1) * rows]
            for axis, statistic in zip(panels.ravel(), statistics, strict=False):
                _distributions(axis, star, statistic, fap)
            for axis in panels.ravel()[len(statistics) :]:
                axis.set_visible(False)
            for axis in panels[:, 0]:
                axis.set_ylabel(f"{star.title}\nrealisations, each peak = 1")
        handles, names = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(names))
        exposures = " and ".join(sorted({f"{star.found.quiet.exposure_s:g} s" for star in stars}))
        figure.suptitle(
            f"Detection statistics without a flare and with one, {exposures}, "
            f"{stars[0].found.realisations:,} realisations each; nominal throughput",
            fontsize=10,
        )
        return finished(figure, path)


def _distributions(axis: Any, star: StarDetection, statistic: str, fap: float) -> None:
    found, amplitudes = star.found, star.amplitudes
    linear = found.weights(statistic) is not None
    shapes: list[tuple[int | None, str, str]] = [(None, NULL, "no flare")]
    shapes += [(k, COLOURS[k % len(COLOURS)], f"flare {100 * a:g} %") for k, a in enumerate(amplitudes)]
    for flare, colour, name in shapes:
        edges, counts = found.histogram(statistic, flare, bins=120)
        middle, height = (edges[1:] + edges[:-1]) / 2, counts / counts.max()
        axis.fill_between(middle, height, step="mid", color=colour, alpha=0.3, linewidth=0)
        axis.step(middle, height, where="mid", color=colour, label=name)
    # Where a statistic is scaled by the flare, each has a threshold of its own.
    own = range(len(amplitudes)) if statistic == "paper" else range(1)
    for k in own:
        cut = found.threshold(fap, statistic, template=k).value
        colour = COLOURS[k % len(COLOURS)] if len(own) > 1 else "black"
        name = f"threshold, fap {fap:g} per test"
        axis.axvline(cut, color=colour, linewidth=0.9, linestyle="--", label=None if len(own) > 1 else name)
    # Means lie decades apart.
    if linear:
        axis.set_xscale("function", functions=(lambda x: np.arcsinh(x / 2), lambda y: 2 * np.sinh(y)))
        low, high = axis.get_xlim()
        ticks: list[float] = [t for t in (-4, 0, 4, 10, 30, 100, 1000, 10000) if low <= t <= high]
        axis.set_xticks(ticks, [str(t) for t in ticks])
    else:
        axis.set_xscale("log")
        low, high = axis.get_xlim()
        # Under two decades a power of ten alone says too little.
        digits = (
            (1,)
            if high / low > 100
            else (1, 2, 5)
            if high / low > 3
            else (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 4, 5, 6, 8)
        )
        ticks = [d * 10.0**e for e in range(9) for d in digits]
        ticks = [t for t in ticks if low <= t <= high]
        axis.set_xticks(ticks, [f"{t:g}" if t < 1e5 else f"$10^{{{np.log10(t):.0f}}}$" for t in ticks])
        axis.tick_params(axis="x", which="minor", labelbottom=False)
    axis.set_ylim(bottom=0)
    axis.set_xlabel(NAMES.get(statistic, statistic))


def roc(curves: Sequence[tuple[str, Roc]], path: Path | None = None) -> Any:
    """Receiver operating characteristics with their areas."""
    plt = pyplot()
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(3.6, 2.9))
        for colour, (name, curve) in zip(COLOURS, curves, strict=False):
            table = curve.table()
            seen = np.asarray(table["fap"]) > 0
            text = f"{name}: area {curve.area.value:.4f}"
            axis.semilogx(table["fap"][seen], table["probability"][seen], color=colour, label=text)
            axis.fill_between(
                table["fap"][seen], table["probability_low"][seen], table["probability_high"][seen], color=colour,
                alpha=0.3, linewidth=0,
            )  # fmt: skip
        axis.set(xlabel="false-alarm probability per test", ylabel="detection probability", ylim=(0, 1.02))
        axis.legend(loc="lower right")
        return finished(figure, path)


def spectra(stars: Sequence[StarDetection], path: Path | None = None) -> Any:
    """Quiescent and flare spectra per second, with one standard deviation of a pixel's noise."""
    plt = pyplot()
    groups = [(star.title, star.amplitudes, star.found.quiet, star.found.flares) for star in stars]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(len(groups), 1, figsize=(7.2, 2.9 * len(groups) + 0.3), squeeze=False, sharex=True)
        for axis, (title, amplitudes, quiet, flares) in zip(axes[:, 0], groups, strict=True):
            for k in reversed(range(len(flares))):
                x = flares[k]
                axis.plot(
                    x.wavelength_nm,
                    x.signal_dn / x.exposure_s,
                    color=COLOURS[k % len(COLOURS)],
                    label=f"flare {100 * amplitudes[k]:g} %",
                )
            mean, noise = quiet.signal_dn / quiet.exposure_s, np.sqrt(quiet.variance_dn2) / quiet.exposure_s
            axis.fill_between(
                quiet.wavelength_nm, mean - noise, mean + noise, color=NULL, alpha=0.35, linewidth=0,
                label="1 sigma noise of a pixel",
            )  # fmt: skip
            axis.plot(quiet.wavelength_nm, mean, color="black", linestyle="--", label="no flare")
            axis.set_title(f"{title}, {quiet.exposure_s:g} s")
            axis.set_ylabel("net signal (DN s$^{-1}$ pixel$^{-1}$)")
            axis.set_xlim(200, 700)
        axes[0][0].legend(ncols=2)
        axes[-1][0].set_xlabel("wavelength (nm)")
        figure.suptitle(
            "Mean spectra as Mauve would see them; nominal throughput, not a flight calibration", fontsize=10
        )
        return finished(figure, path)


def observation(title: str, table: QTable, path: Path | None = None) -> Any:
    """One raw spectrum and what it is made of, as the paper's figure of components."""
    plt = pyplot()
    panels = (
        ("raw", "raw spectrum"),
        ("source", "star"),
        ("sky", "zodiacal light"),
        ("photon_noise", "photon noise"),
        ("dark", "dark"),
        ("bias", "bias"),
        ("read_noise", "read noise"),
    )
    wavelength = table["wavelength"].to_value("nm")
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(len(panels), 1, figsize=(7.2, 9.5), sharex=True)
        for i, (axis, (name, text)) in enumerate(zip(axes, panels, strict=True)):
            axis.plot(wavelength, table[name].value, color=COLOURS[i % len(COLOURS)], linewidth=0.7)
            axis.set_title(f"({'abcdefg'[i]}) {text}")
            axis.set_ylabel("DN")
        axes[-1].set_xlabel("wavelength (nm)")
        axes[-1].set_xlim(200, 700)
        figure.suptitle(f"{title}: one observation of {table.meta['exposure_s']:g} s; nominal throughput", fontsize=10)
        return finished(figure, path)


def signal_to_noise(stars: Sequence[tuple[str, SnrResult]], path: Path | None = None) -> Any:
    """S/N per pixel and per resolution element: closed form, and the spread of the realisations."""
    plt = pyplot()
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(len(stars), 2, figsize=(7.6, 2.6 * len(stars) + 0.4), squeeze=False, sharex=True)
        for row, (title, result) in zip(axes, stars, strict=True):
            for axis, table, what in (
                (row[0], result.pixel, "per pixel"),
                (row[1], result.element, "per 10.5 nm element"),
            ):
                wavelength = table["wavelength"].to_value("nm")
                for low, high, alpha, text in (("q2.5", "q97.5", 0.25, "95 %"), ("q16", "q84", 0.45, "68 %")):
                    axis.fill_between(
                        wavelength, table[low], table[high], color=COLOURS[0], alpha=alpha, linewidth=0,
                        label=f"{text} of realisations",
                    )  # fmt: skip
                axis.plot(wavelength, table["expected"], color="black", linewidth=0.9, label="closed form")
                axis.set_ylabel(f"S/N {what}")
                axis.set_title(title)
                axis.set_xlim(200, 700)
        axes[0][0].legend()
        for axis in axes[-1]:
            axis.set_xlabel("wavelength (nm)")
        return finished(figure, path)


def detection_map(found: MapResult, path: Path | None) -> Any:
    """Detection probability over two quantities, one panel per statistic; the figure where no path is given."""
    plt = pyplot()
    question = found.study.map
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            1, len(found.statistics), figsize=(3.6 * len(found.statistics) + 0.8, 3.4), squeeze=False, sharey=True
        )
        x, y = (
            np.arange(len(values)) if isinstance(values[0], str) else np.array(values, float)
            for values in (found.x, found.y)
        )
        for axis, statistic, probability in zip(axes[0], found.statistics, found.probability, strict=True):
            mesh = axis.pcolormesh(x, y, probability, cmap="cividis", vmin=0, vmax=1, shading="nearest")
            if min(probability.shape) > 1:
                lines = axis.contour(x, y, probability, levels=sorted(question.contours), colors="white", linewidths=1)
                axis.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize=7)
            for which, values, place in (("x", found.x, x), ("y", found.y, y)):
                described = getattr(question, which)
                if isinstance(values[0], str):
                    getattr(axis, f"set_{which}ticks")(place, values)
                elif described.log:
                    getattr(axis, f"set_{which}scale")("log")
            axis.set_xlabel(AXES[question.x.quantity])
            axis.set_title(NAMES.get(statistic, statistic))
        axes[0][0].set_ylabel(AXES[question.y.quantity])
        figure.colorbar(mesh, ax=list(axes[0]), label="detection probability")
        figure.suptitle(
            f"{found.star}, false-alarm probability {found.study.run.fap:g} per test; nominal throughput", fontsize=9
        )
        return finished(figure, path)


def limits(found: LimitResult, path: Path | None) -> Any:
    """Detection probability at every simulated value, and the limits; the figure where no path is given."""
    plt = pyplot()
    of, power = found.study.limit.of, found.study.limit.power
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(6.4, 3.6))
        for k, limit in enumerate(found.limits):
            colour, marker = COLOURS[k % len(COLOURS)], "osD^vPX"[k // len(COLOURS) % 7]
            points = sorted((*limit.points, limit.check), key=lambda p: p.value)
            p = [point.probability for point in points]
            error = [[q.value - q.low for q in p], [q.high - q.value for q in p]]
            flare = "" if np.isnan(limit.amplitude) else f", {100 * limit.amplitude:g} %"
            text = f"{limit.star}{flare}, {limit.statistic}: {limit.value.value:.4g}"
            axis.errorbar(
                [point.value for point in points],
                [q.value for q in p],
                error,
                fmt=marker,
                ms=4,
                color=colour,
                label=text,
            )
            axis.plot(*zip(*sorted(limit.curve), strict=True), color=colour, linewidth=0.9)
            axis.axvspan(limit.value.low, limit.value.high, color=colour, alpha=0.25, linewidth=0)
        axis.axhline(power, color="black", linewidth=0.8, linestyle="--")
        if of != "magnitude":
            axis.set_xscale("log")
        axis.set(xlabel=AXES[of], ylabel="detection probability", ylim=(-0.02, 1.02))
        axis.set_title(
            f"Limits at a power of {power:g}, false-alarm probability {found.study.run.fap:g} per test\n"
            "points: simulated, 95 %; lines: Gaussian noise; nominal throughput"
        )
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return finished(figure, path)


#: Noise by origin, in the colours of the paper's figure as far as colour-blind readers can tell them apart.
ORIGINS = {
    "source_photon": ("source photons", "#009E73"),
    "dark": ("dark current", "#CC79A7"),
    "read": ("read noise", "#E69F00"),
    "zodiacal_photon": ("zodiacal photons", "#0072B2"),
    "total": ("total", "#000000"),
}


def noise_budgets(found: SnrAnswer, path: Path | None = None) -> Any:
    """Noise of a pixel by origin against wavelength, one panel per star and cell, as the paper's figure has it."""
    plt = pyplot()
    each = len(found.study.cells())
    stars = len(found.stars) // each
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            stars, each, figsize=(3.4 * min(each, 6) + 0.6, 2.3 * stars + 0.5), squeeze=False, sharex=True, sharey="col"
        )
        for k, star in enumerate(found.stars):
            axis, budget = axes[k % stars][k // stars], star.result.expectation.noise_budget()
            for name, (text, colour) in ORIGINS.items():
                axis.plot(budget["wavelength"].value, budget[name].value, color=colour, label=text, linewidth=1.0)
            axis.set_title(star.title if star.at else f"{star.title}, {star.result.expectation.exposure_s:g} s")
            axis.set_yscale("log")
            axis.set_xlim(200, 700)
        # Zodiacal light can be far below everything else.
        for axis in axes.ravel():
            axis.set_ylim(bottom=max(axis.get_ylim()[0], axis.get_ylim()[1] * 1e-4))
        for axis in axes[:, 0]:
            axis.set_ylabel("noise (DN rms per pixel)")
        for axis in axes[-1]:
            axis.set_xlabel("wavelength (nm)")
        handles, names = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=len(names))
        figure.suptitle("Noise budgets; nominal throughput, not a flight calibration", fontsize=10)
        return finished(figure, path)


def snr_sweep(found: SnrAnswer, path: Path | None = None) -> Any:
    """S/N of some elements against what is swept first, a line for each value of the rest."""
    from mauvecl.exposures import place_of

    plt = pyplot()
    first = found.study.sweep.axes[0].quantity
    shown = found.stars[0].shown_nm
    tables = [star.result.element for star in found.stars]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, len(shown), figsize=(3.0 * len(shown) + 0.4, 3.2), squeeze=False, sharey=True)
        for axis, wavelength in zip(axes[0], shown, strict=True):
            lines: dict[str, list[tuple[Any, Any]]] = {}
            for star, table in zip(found.stars, tables, strict=True):
                name = star.label if first != "magnitude" else star.label.split(" V = ")[0]
                rest = titled(name, {k: v for k, v in star.at.items() if k != first})
                row = table[place_of(star.result.expectation, wavelength, "element")]
                lines.setdefault(rest, []).append((star.at[first], row))
            for k, (name, points) in enumerate(lines.items()):
                x = [value for value, _ in points]
                low, high = ([max(row[q], 1e-3) for _, row in points] for q in ("q2.5", "q97.5"))
                colour = COLOURS[k % len(COLOURS)]
                axis.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)
                axis.plot(x, [row["expected"] for _, row in points], "o-", color=colour, ms=3, label=name)
            axis.set_yscale("log")
            axis.set_ylim(bottom=0.1)
            if first == "exposure":
                axis.set_xscale("log")
            axis.set_title(f"{wavelength:g} nm")
            axis.set_xlabel(AXES[first])
        axes[0][0].set_ylabel("S/N per 10.5 nm element")
        handles, names = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=min(len(names), 4))
        figure.suptitle("S/N: closed form, and 95 % of realisations; nominal throughput", fontsize=10)
        return finished(figure, path)


def gaussian(found: GaussianReport, path: Path | None) -> Any:
    """How far each promise of the usual formula holds in every cell; the figure where no path is given."""
    plt = pyplot()
    cells = found.cells
    # Column, what it is, what is promised, and the least that an axis shows to either side of it.
    panels = (
        ("snr_off_by", "mean S/N less formula", 0.0, 0.1),
        ("coverage_low", "share of 1-sigma intervals right", 0.6827, 0.03),
        ("five_sigma", "5-sigma pixels over normal", 1.0, 0.5),
        ("fap_ratio", "false alarms over promised", 1.0, 0.2),
    )
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, len(panels), figsize=(11.0, 0.28 * len(cells) + 1.4), sharey=True)
        rows = np.arange(len(cells))
        for axis, (column, text, promised, least) in zip(axes, panels, strict=True):
            if column == "coverage_low":
                axis.hlines(rows, cells["coverage_low"], cells["coverage_high"], color=COLOURS[0], linewidth=3)
            else:
                axis.plot(cells[column], rows, "o", color=COLOURS[0], ms=4)
            axis.axvline(promised, color=NULL, linewidth=1)
            low, high = axis.get_xlim()
            axis.set_xlim(min(low, promised - least), max(high, promised + least))
            axis.set_xlabel(text)
            axis.grid(axis="y", linewidth=0.3)
        axes[0].set_yticks(rows, [titled(s.label, s.at) for s in found.signal.stars])
        axes[0].invert_yaxis()
        figure.suptitle("The root-of-N formula beside the simulation; grey: as promised", fontsize=10)
        return finished(figure, path)


def exposures(found: ExposureResult, path: Path | None) -> Any:
    """S/N against exposure for each star, which grows with the root of it; the figure where no path is given."""
    plt = pyplot()
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(5.2, 3.4))
        for k, e in enumerate(found.exposures):
            colour = COLOURS[k % len(COLOURS)]
            x = np.geomspace(e.exposure_s / e.frames, 4 * e.exposure_s, 50)
            axis.plot(x, e.snr * np.sqrt(x / e.exposure_s), color=colour, label=f"{e.star}: {e.exposure_s:g} s")
            axis.plot([e.exposure_s], [e.snr], "o", color=colour, ms=5)
        first = found.exposures[0]
        axis.axhline(first.wanted, color=NULL, linestyle="--", linewidth=1)
        axis.set(xscale="log", yscale="log", xlabel="exposure (s)", ylabel=f"S/N per {first.per}")
        axis.set_title(f"S/N at {first.wavelength_nm:g} nm; dashed: the one wanted; nominal throughput")
        axis.legend()
        return finished(figure, path)
