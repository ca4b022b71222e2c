"""Figures of the page: made once for each visitor, their data replaced after a change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool
from bokeh.models.annotations import Title
from bokeh.plotting import figure
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.pictures.style import COLOURS, NULL

if TYPE_CHECKING:
    from astropy.table import QTable
    from numpy.typing import ArrayLike, NDArray

    from mauvecl.answers.detect import StarDetection
    from mauvecl.host.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.statistics.distributions import Form

HEIGHT = 430


def _figure(title: str, x: str, y: str, **how: Any) -> Any:
    plot = figure(
        title=Title(text=title, text_font_style="normal"),
        x_axis_label=x,
        y_axis_label=y,
        height=HEIGHT,
        sizing_mode="stretch_width",
        tools="pan,wheel_zoom,box_zoom,reset,save",
        toolbar_location="above",
        **how,
    )
    plot.toolbar.logo = None
    return plot


def _legend_below(plot: Any) -> None:
    """The legend where it hides no line, narrow enough for a phone; a click on a name hides its own."""
    (legend,) = plot.legend
    plot.center.remove(legend)
    plot.add_layout(legend, "below")
    legend.update(orientation="horizontal", ncols=2, click_policy="hide", border_line_color=None)


class Lines:
    """Some named lines over one axis.

    Parameters
    ----------
    title, x, y : str
        With units.
    names : sequence of str
    step : bool
        Draw steps instead of straight lines.
    """

    def __init__(self, title: str, x: str, y: str, names: tuple[str, ...], **how: Any) -> None:
        self.plot = _figure(title, x, y, **how)
        self._sources = {name: ColumnDataSource({"x": [], "y": []}) for name in names}
        for number, (name, source) in enumerate(self._sources.items()):
            colour = COLOURS[number % len(COLOURS)]
            self.plot.line("x", "y", source=source, color=colour, line_width=1.5, legend_label=name)
        _legend_below(self.plot)
        self.plot.add_tools(HoverTool(tooltips=[(x, "@x{0.0}"), (y, "@y{0.000}")]))

    def show(self, **lines: tuple[NDArray[np.float64], NDArray[np.float64]]) -> None:
        """Replace lines, by name with underscores for spaces; those not named become empty."""
        for name in self._sources:
            self.put(name, *lines.get(name.replace(" ", "_"), ((), ())))

    def put(self, name: str, x: ArrayLike, y: ArrayLike) -> None:
        """Replace one line; browsers are sent what has changed of it, nothing if nothing has."""
        source, found = self._sources[name], {"x": np.asarray(x, float), "y": np.asarray(y, float)}
        if not all(np.array_equal(source.data[key], value, equal_nan=True) for key, value in found.items()):
            source.data = found


class RawSpectrum:
    """One raw spectrum and the mean of what it is made of."""

    def __init__(self) -> None:
        names = ("raw spectrum with flare", "star", "star with flare", "sky", "dark", "bias")
        self.lines = Lines("One observation", "wavelength (nm)", "DN in the exposure", names)
        self.plot = self.lines.plot

    def show(self, quiet: Expectation, flare: Expectation) -> None:
        """The mean components; the raw spectrum follows when it is drawn."""
        w, gain = quiet.wavelength_nm, quiet.n_frames * quiet.gain_dn_per_electron
        parts = {
            "star": (w, gain * quiet.source_electrons),
            "star_with_flare": (w, gain * flare.source_electrons),
            "sky": (w, gain * quiet.sky_electrons),
            "dark": (w, quiet.n_frames * quiet.dark_dn),
            "bias": (w, quiet.n_frames * quiet.bias_dn),
        }
        self.lines.show(**parts)

    def add(self, quiet: Expectation, raw: NDArray[Any]) -> None:
        """A drawn raw spectrum."""
        self.lines.put("raw spectrum with flare", quiet.wavelength_nm, raw)


class InputSpectrum:
    """The star's spectrum at the telescope, without and with the flare."""

    def __init__(self) -> None:
        self.lines = Lines(
            "Spectrum at the telescope",
            "wavelength (nm)",
            "flux (erg / s / cm2 / Å)",
            ("star", "star with flare"),
            y_axis_type="log",
            x_range=(200, 700),
        )
        self.plot = self.lines.plot

    def show(self, star: Source, flare: Source) -> None:
        """Where the instrument looks; logarithms show nothing of zero."""
        shown = (star.wavelength_nm >= 190) & (star.wavelength_nm <= 710)
        wavelength = star.wavelength_nm[shown]
        one, two = (np.where(s.flux_flam > 0, s.flux_flam, np.nan)[shown] for s in (star, flare))
        self.lines.show(star=(wavelength, one), star_with_flare=(wavelength, two))


class SignalToNoise:
    """S/N per pixel and element: closed form at once, the spread of the realisations when it is there."""

    def __init__(self) -> None:
        names = ("per element of 10.5 nm", "per pixel", "2.5 % of realisations", "97.5 % of realisations")
        self.lines = Lines("Signal to noise without a flare", "wavelength (nm)", "S/N", names)
        self.plot = self.lines.plot
        self._theory: dict[str, Any] = {}

    def show(self, quiet: Expectation) -> None:
        """The closed forms of one star; an earlier simulation goes."""
        self._theory = {
            "per_element_of_10.5_nm": (quiet.element_wavelength_nm, quiet.snr_per_element()),
            "per_pixel": (quiet.wavelength_nm, quiet.snr()),
        }
        self.lines.show(**self._theory)

    def add(self, element: QTable) -> None:
        """Quantiles of the realisations, per element."""
        wavelength = element["wavelength"].to_value("nm")
        spread = {f"{q}_%_of_realisations": (wavelength, np.asarray(element[f"q{q}"])) for q in ("2.5", "97.5")}
        self.lines.show(**self._theory, **spread)


class NoiseBudget:
    """Noise of a pixel by origin."""

    PARTS = ("source_photon", "zodiacal_photon", "dark", "read", "total")

    def __init__(self) -> None:
        names = tuple(name.replace("_", " ") for name in self.PARTS)
        self.lines = Lines(
            "Noise of a pixel by origin", "wavelength (nm)", "DN rms in the exposure", names, y_axis_type="log"
        )
        self.plot = self.lines.plot

    def show(self, quiet: Expectation) -> None:
        """Of one star; nothing is drawn where there is none."""
        table = quiet.noise_budget()
        found = {}
        for name in self.PARTS:
            values = np.asarray(table[name].value)
            found[name] = (quiet.wavelength_nm, np.where(values > 0, values, np.nan))
        self.lines.show(**found)


class Smooth:
    """A closed form looked up quickly: exact at some points, smooth in the probit between them, for pictures.

    Parameters
    ----------
    form : Form
    """

    def __init__(self, form: Form) -> None:
        at = np.linspace(form.mean - 5 * form.std, form.mean + 6 * form.std, 14)
        beyond = np.array([form.sf(value) for value in at])
        # Where it is 0 or 1 to the last digit there is nothing to draw.
        kept = (beyond > 1e-12) & (beyond < 1 - 1e-12)
        self.mean, self.std = form.mean, form.std
        self._probit = PchipInterpolator(at[kept], special.ndtri(beyond[kept]), extrapolate=True)
        self._inverse = PchipInterpolator(-special.ndtri(beyond[kept]), at[kept], extrapolate=True)

    def sf(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """Probabilities of exceeding values."""
        return np.asarray(special.ndtr(self._probit(value)))

    def isf(self, probability: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values exceeded with probabilities."""
        return np.asarray(self._inverse(-special.ndtri(probability)))


class Distributions:
    """The asked statistic without and with the flare: the closed form at once, the simulation when it is there."""

    def __init__(self) -> None:
        self.plot = _figure("Distribution of the statistic", "statistic", "density, each peak = 1")
        self._bars = {name: ColumnDataSource({"left": [], "right": [], "top": []}) for name in ("no flare", "flare")}
        self._lines = {name: ColumnDataSource({"x": [], "y": []}) for name in ("no flare", "flare", "threshold")}
        colours = {"no flare": NULL, "flare": COLOURS[4], "threshold": COLOURS[6]}
        for name, source in self._bars.items():
            how = {"fill_color": colours[name], "fill_alpha": 0.35, "line_color": None}
            self.plot.quad("left", "right", "top", 0, source=source, legend_label=f"{name}, simulated", **how)
        for name, source in self._lines.items():
            dash = "dashed" if name == "threshold" else "solid"
            label = name if name == "threshold" else f"{name}, closed form"
            self.plot.line(
                "x", "y", source=source, color=colours[name], line_dash=dash, line_width=2, legend_label=label
            )
        _legend_below(self.plot)

    def show(self, null: Smooth, flare: Smooth, cut: float, statistic: str, fap: float) -> None:
        """The closed forms and threshold; an earlier simulation goes."""
        for source in self._bars.values():
            source.data = {"left": [], "right": [], "top": []}
        for name, form in (("no flare", null), ("flare", flare)):
            edges = np.linspace(form.mean - 5 * form.std, form.mean + 5 * form.std, 161)
            beyond = form.sf(edges)
            density = np.maximum(beyond[:-1] - beyond[1:], 0.0)
            middle = (edges[1:] + edges[:-1]) / 2
            self._lines[name].data = {"x": middle, "y": density / density.max()}
        self._lines["threshold"].data = {"x": [cut, cut], "y": [0.0, 1.0]}
        self._name(statistic, cut, fap)

    def _name(self, statistic: str, cut: float, fap: float) -> None:
        self.plot.xaxis.axis_label = f"{statistic} (threshold {cut:.4g} at a false-alarm probability of {fap:g})"

    def add(self, star: StarDetection, statistic: str, fap: float) -> None:
        """The simulated distributions and threshold."""
        for name, flare in (("no flare", None), ("flare", 0)):
            edges, counts = star.found.histogram(statistic, flare, bins=80)
            height = counts / max(counts.max(), 1)
            self._bars[name].data = {"left": edges[:-1], "right": edges[1:], "top": height}
        cut = star.found.threshold(fap, statistic).value
        self._lines["threshold"].data = {"x": [cut, cut], "y": [0.0, 1.0]}
        self._name(statistic, cut, fap)


class Roc:
    """Detection probability against false-alarm probability."""

    def __init__(self) -> None:
        self.lines = Lines(
            "Receiver operating characteristic",
            "false-alarm probability per test",
            "detection probability",
            ("closed form", "simulated"),
            x_axis_type="log",
        )
        self.plot = self.lines.plot
        self._theory: Any = None

    def show(self, null: Smooth, flare: Smooth) -> None:
        """The closed form; an earlier simulation goes."""
        faps = np.logspace(-6, 0, 121)[:-1]
        self._theory = faps, flare.sf(null.isf(faps))
        self.lines.show(closed_form=self._theory)

    def add(self, star: StarDetection, statistic: str) -> None:
        """The simulated curve."""
        curve = star.found.roc(statistic).table()
        fap = np.asarray(curve["fap"], float)
        seen = fap > 0
        self.lines.show(closed_form=self._theory, simulated=(fap[seen], np.asarray(curve["probability"], float)[seen]))
