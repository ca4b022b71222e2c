"""An instrument fitted to frames of standard stars and to frames without light."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer, TableOf, ecsv_text
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.host.exposure.expectation import Expectation, expect
from mauvecl.host.instrument import shipped_names
from mauvecl.host.instrument.curves import CALIBRATED, MODE, ThroughputErrors
from mauvecl.host.instrument.instrument import FILE_VERSION, Instrument
from mauvecl.observations import detector
from mauvecl.observations.frame_files import read_frames
from mauvecl.observations.frames import Frames
from mauvecl.observations.throughput import ERROR_KNOTS, ThroughputFit, ThroughputModel, fit_throughput
from mauvecl.schema.columns import Column, number, percent
from mauvecl.schema.errors import InputError, counted

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.host.stars.source import Source
    from mauvecl.runs.pool import Pool
    from mauvecl.study.study import Study

#: Knots of the written throughput factor, nm apart.
KNOT_NM = 2.0
#: Bands of equal width whose light the first modes of the throughput's errors determine.
MODE_BANDS = 8
#: Factor between fitted and nominal throughput above which it is reported.
FAR_FROM_NOMINAL = 3.0
#: Probability of chi-squared below which a fit is reported as bad.
REJECTED = 0.01


@dataclass(frozen=True)
class FittedValue:
    """A value of the instrument: fitted, or assumed where the observations do not determine it."""

    name: str
    value: float
    error: float  # NaN if it is assumed
    nominal: float
    unit: str

    @property
    def determined(self) -> bool:
        """True if the observations determine the value."""
        return bool(np.isfinite(self.error))


COLUMNS = (
    Column("quantity", "name", "", "value of the instrument", "quantity", kind=str),
    Column("value", "value", "", "fitted, or nominal where it is not determined", "value",
           lambda value, error: f"{value:.6g} +- {error:.2g}" if error == error else f"{value:.6g}", ("error",)),
    Column("error", "error", "", "standard error; nan: not determined by these observations"),
    Column("nominal", "nominal", "", "value of the instrument that was given", "nominal", ".6g"),
    Column("deviation", lambda row: (row.value - row.nominal) / row.error if row.error > 0 else np.nan, "",
           "fitted less nominal value in standard errors", "sigma", number("+.1f")),
    Column("unit", "unit", "", "of the value", "unit", kind=str),
    Column("determined", "determined", "", "whether these observations determine it", "status",
           lambda determined: "" if determined else "assumed", kind=bool),
)  # fmt: skip
#: Columns of the goodness of fit, for pairs of a name and a fit.
FIT_COLUMNS = (
    Column("fit", lambda row: row[0], "", "what is fitted", "fit", kind=str),
    Column("chi2", lambda row: row[1].chi2, "", "chi-squared", "chi-squared / dof",
           lambda chi2, dof: f"{chi2:.1f} / {dof:.1f}", ("dof",)),
    Column("dof", lambda row: float(row[1].dof), "", "values less the effective number of parameters"),
    Column("p_value", lambda row: row[1].p_value, "", "probability of a chi-squared at least as large", "p",
           number(".3g")),
)  # fmt: skip
THROUGHPUT_COLUMNS = (
    Column("wavelength", "throughput.wavelength_nm", "nm", "middle of the pixel", "nm", ".1f"),
    Column("throughput", "fitted_throughput", "", "electrons per photon", "throughput", ".4f"),
    Column("error", lambda answer: answer.fitted_throughput * answer.throughput.error, "", "its standard error"),
    Column("nominal", lambda answer: answer.nominal.throughput(answer.throughput.wavelength_nm), "",
           "throughput of the instrument that was given"),
    Column("ratio", lambda answer: np.exp(answer.throughput.log_factor), "", "fitted over nominal throughput",
           "over nominal", ".4f"),
    Column("relative_error", "throughput.error", "", "relative standard error, with that of the gain", "error",
           percent(".2f")),
    Column("relative_error_counts",
           lambda fit: np.sqrt(np.maximum(fit.throughput.error**2 - fit.transfer.relative_gain_error**2, 0.0)), "",
           "relative standard error of DN per photon, which the gain does not change"),
)  # fmt: skip
DARK_COLUMNS = (
    Column("wavelength", "nominal.wavelength_nm", "nm", "middle of the pixel"),
    Column("dark", "dark.level_dn_per_s", "DN / s", "dark current at the reference temperature"),
    Column("dark_error", "dark.level_error", "DN / s", "its standard error"),
    Column("slope", "dark.pixel_slope_per_c", "1 / deg_C",
           "slope of the logarithm of this pixel alone; nan: not determined"),
    Column("slope_error", "dark.pixel_slope_error", "1 / deg_C", "its standard error"),
    Column("bias", "dark.bias_dn", "DN", "fitted or assumed"),
    Column("bias_error", "dark.bias_error", "DN", "its standard error"),
)  # fmt: skip
TRANSFER_COLUMNS = (
    Column("light", "transfer.mean_dn", "DN", "mean light of a frame"),
    Column("variance", "transfer.variance", "DN2", "variance of frames"),
    Column("model", "transfer.model", "DN2", "fitted variance"),
)


@dataclass(frozen=True, eq=False)
class CalibrateAnswer(Answer):
    """Answer of `calibrate`: fits of throughput, dark current and photon transfer, and the instrument with them."""

    USES = ("instrument", "sky")

    study: Study
    # The instrument from which the fit starts, whose values remain where the observations determine none.
    nominal: Instrument
    observations: tuple[detector.CalibrationFrames, ...]
    dark: detector.DarkFit
    transfer: detector.PhotonTransfer
    throughput: ThroughputFit

    #: One row per value of the instrument.
    values_table = TableOf(
        "calibrate", COLUMNS, "values", key="rows", meta=("dark.reference_c", "transfer.dark_unit", "study"),
        title=lambda answer: f"{answer.nominal.name} fitted to {counted(len(answer.stars), 'observation')} of "
        f"standard stars; dark current at {answer.dark.reference_c:.1f} C",
    )  # fmt: skip
    #: One row per pixel: fitted and nominal throughput.
    throughput_table = TableOf(
        "throughput", THROUGHPUT_COLUMNS, lambda answer: answer, title="Throughput, electrons per photon",
        shown=lambda table: table[np.linspace(0, len(table) - 1, 11).astype(int)],
    )  # fmt: skip
    #: One row per fit: its goodness.
    fits = TableOf("fits", FIT_COLUMNS, lambda answer: [
        (name, fit) for name, fit in (
            ("throughput", answer.throughput), ("dark current", answer.dark), ("photon transfer", answer.transfer)
        ) if fit.dof > 0
    ], title="Goodness of fit", key="fits", meta=())  # fmt: skip
    #: One row per pixel: dark current and bias.
    dark_table = TableOf("dark", DARK_COLUMNS, lambda answer: answer, meta=("dark.reference_c",))
    #: One row per observation and usable pixel: the variance of frames.
    transfer_table = TableOf("photon-transfer", TRANSFER_COLUMNS, lambda answer: answer, meta=())

    @property
    def stars(self) -> list[detector.CalibrationFrames]:
        """Observations of standard stars."""
        return [observation for observation in self.observations if observation.star is not None]

    @cached_property
    def values(self) -> list[FittedValue]:
        """Values of the instrument, fitted or assumed."""
        d, t, f, n = self.dark, self.transfer, self.throughput, self.nominal
        level = float(np.mean(d.level_dn_per_s))
        at = float(n.per_pixel("dark", 1.0).mean() * n.dark_scale_dn_per_s * np.exp(n.dark_slope_per_c * d.reference_c))
        bias = float(n.per_pixel("bias_dn", n.bias_dn).mean())
        rows = [
            FittedValue("dark current", level, float(np.sqrt(d.shared[1, 1])), at, "DN / s"),
            FittedValue("dark slope", d.slope_per_c, d.slope_error, n.dark_slope_per_c, "1 / deg_C"),
            FittedValue("bias", float(d.bias_dn.mean()), float(d.bias_error.mean()), bias, "DN"),
            FittedValue("gain", t.noise.gain, t.gain_error, n.gain_dn_per_electron, "DN / electron"),
            FittedValue("read noise", t.read_noise_dn, t.read_noise_error, n.read_noise_dn, "DN"),
        ]
        rows = [replace(row, error=np.nan) if row.name in (*d.assumed, *t.assumed) else row for row in rows]
        names = ("wavelength shift", "wavelength stretch", "line width", "line width, change to the red")
        usual = (0.0, 0.0, n.gaussian_fwhm_nm, 0.0)
        shapes = zip(names, f.shape_nm.tolist(), f.shape_error_nm.tolist(), usual, strict=True)
        return [*rows, *(FittedValue(*shape, "nm") for shape in shapes)]

    @cached_property
    def fitted_throughput(self) -> NDArray[np.float64]:
        """Throughput at each pixel, electrons per photon, shape (n_pixel,)."""
        fit = self.throughput
        return np.asarray(np.exp(fit.log_factor) * self.nominal.throughput(fit.wavelength_nm))

    @property
    def tables(self) -> dict[str, Table]:
        """Values, goodness of fit, throughput, dark current, photon transfer, and what the instrument file names."""
        return super().tables | self.instrument_tables

    @property
    def headline(self) -> str:
        """The error of the throughput."""
        return (
            f"The throughput of {self.nominal.name} is fitted to {counted(len(self.observations), 'observation')}, "
            f"with a standard error of {100 * float(np.median(self.throughput.error)):.2g} % in the median pixel."
        )

    @property
    def messages(self) -> list[str]:
        lines = self._throughput_messages
        if self.study.calibrate.light_error == 0:
            lines.append("Losses by pointing are taken to be alike in all observations (calibrate.light_error).")
        for row in self.fits:
            if row["p_value"] < REJECTED:
                lines.append(f"The fit of the {row['fit']} is rejected: p = {row['p_value']:.2g}, below {REJECTED:g}.")
        if self.dark.slopes_p_value < REJECTED:
            lines.append(
                "The dark current of single pixels rises differently with temperature: the instrument file has the "
                f"common slope (p = {self.dark.slopes_p_value:.2g})."
            )
        if abs(self.throughput.shape_nm[3]) > 3 * self.throughput.shape_error_nm[3]:
            lines.append("The line width changes along the spectrum: the instrument file has its mean.")
        saturated = [lit.name for lit in self.stars if not lit.usable(self.nominal).all()]
        if saturated:
            lines.append(f"Saturated pixels are not used: {', '.join(saturated)}.")
        return lines

    @property
    def _throughput_messages(self) -> list[str]:
        """Messages on what is not determined, and on the throughput."""
        lines = []
        assumed = [*self.dark.assumed, *self.transfer.assumed, *self.throughput.assumed]
        if assumed:
            lines.append(f"NOT DETERMINED by these observations, taken as nominal: {', '.join(assumed)}.")
        error, is_given = self.throughput.spectrum_error, self.study.calibrate.spectrum_error is not None
        if "errors of the star's spectrum" in self.throughput.assumed and not is_given:
            lines.append(
                "One star cannot tell errors of its spectrum from the throughput: an error of "
                f"{100 * error:.2g} % at each of {ERROR_KNOTS} wavelengths is assumed."
            )
        elif error > 0 and not is_given:
            lines.append(
                f"The stars disagree: their spectra are taken to be wrong by {100 * error:.2g} % at each of "
                f"{ERROR_KNOTS} wavelengths."
            )
        if self.throughput.structure > 0:
            lines.append(
                "The throughput has structure finer than the spline follows, of "
                f"{100 * self.throughput.structure:.2g} %: every pixel has its own factor."
            )
        far = float(np.exp(np.abs(self.throughput.log_factor).max()))
        if far > FAR_FROM_NOMINAL:
            lines.append(f"The throughput is up to {far:.2g} times above or below the nominal one: check the stars.")
        return lines

    @property
    def inputs(self) -> list[Expectation]:
        exposure, sky = self.nominal.frame_s, self.study.sky.sky()
        stars = filter(None, (observation.star for observation in self.observations))
        return [expect(star, self.nominal, exposure=exposure, sky=sky) for star in stars]

    @property
    def source(self) -> str:
        """Origin of the fitted values."""
        return f"fitted to {', '.join(star.name for star in self.stars)}"

    @cached_property
    def instrument(self) -> Instrument:
        """The fitted instrument, as its file has it."""
        with tempfile.TemporaryDirectory() as folder:
            zipfile.ZipFile(io.BytesIO(self.instrument_zip())).extractall(folder)
            return Instrument.load(Path(folder) / "instrument.toml")

    @property
    def notice(self) -> str:
        """Remark on the fitted values that every answer repeats."""
        error = 100 * float(np.median(self.throughput.error))
        return f"The throughput is {self.source}; median standard error {error:.2g} %."

    @property
    def changes(self) -> dict[str, Any]:
        """Fitted values of the instrument by the names in its file; values that are not determined are left out."""
        n, d, t, f = self.nominal, self.dark, self.transfer, self.throughput
        values: dict[str, Any] = {}
        if "dark current" not in d.assumed:
            values["dark_slope_per_c"] = d.slope_per_c
            values["dark_scale_dn_per_s"] = float(np.mean(d.level_dn_per_s) * np.exp(-d.slope_per_c * d.reference_c))
            values["bias_dn"] = float(d.bias_dn.mean())
        if "gain" not in t.assumed:
            volts = n.adc_range_v / 2**n.adc_bits
            values["conversion_uv_per_electron"] = float(t.noise.gain * volts * 1e6)
            values |= {"read_noise_dn": t.read_noise_dn, "dark_unit": t.dark_unit}
        shift, stretch, fwhm = f.shape_nm[:3].tolist()
        fitted = np.isfinite(f.shape_error_nm)
        if fitted[0]:
            # A feature is found at a pixel whose nominal wavelength is too small by the shift.
            half = np.ptp(f.wavelength_nm) / 2
            values["dispersion_nm_per_pixel"] = n.dispersion_nm_per_pixel * (1 + stretch / half)
            first = n.pixel_zero_nm - f.wavelength_nm.mean()
            values["pixel_zero_nm"] = n.pixel_zero_nm + shift + stretch * first / half
            # The instrument still reads the pixels that were observed.
            step, read = values["dispersion_nm_per_pixel"], n.read_pixels
            lowest, highest = (values["pixel_zero_nm"] + step * end for end in (read.start - 0.5, read.stop - 0.5))
            values["output_min_nm"] = max(n.output_min_nm, float(lowest))
            values["output_max_nm"] = min(n.output_max_nm, float(highest))
        if fitted[2]:
            values["gaussian_fwhm_nm"] = fwhm
        return values

    @cached_property
    def instrument_tables(self) -> dict[str, Table]:
        """Tables that the instrument file names: factor and errors of the throughput, and the pixels."""
        nm = self.throughput.wavelength_nm
        knots = np.unique(np.concatenate([nm[:1], np.arange(np.ceil(nm[0]), nm[-1], KNOT_NM), nm[-1:]]))
        # A pixel keeps its throughput, but its wavelength, and with it the nominal throughput, changes.
        names = ("pixel_zero_nm", "dispersion_nm_per_pixel")
        moved = self.nominal.with_(**{name: self.changes[name] for name in names if name in self.changes})
        pixels = np.arange(moved.pixels)[self.nominal.read_pixels]
        centres_nm = moved.pixel_zero_nm + moved.dispersion_nm_per_pixel * pixels
        nominal = self.nominal.throughput(np.clip(centres_nm, *self.nominal.curves_nm))
        factor = np.interp(knots, centres_nm, self.fitted_throughput / nominal)
        at = np.searchsorted(nm, knots).clip(0, nm.size - 1)
        # Light of the pixels at the knots in each band, shape (n_band, n_knot).
        band = at * MODE_BANDS // nm.size
        light = np.asarray(self.fitted_throughput[at] * (band == np.arange(MODE_BANDS)[:, None]))
        errors = ThroughputErrors.of_covariance(
            knots, self._covariance(at), f"C: {self.source}", names=tuple(CALIBRATED), sums=light
        )
        modes = {f"{MODE}{k}": mode for k, mode in enumerate(errors.modes, 1)}
        values = {name: list(steps) for name, steps in errors.values.items()}
        origin, step_nm = {"tag": "C", "source": self.source}, {"wavelength": knots * u.nm}
        return {
            "throughput-factor": QTable(step_nm | {"factor": factor}, meta=origin),
            "throughput-errors": QTable(step_nm | modes, meta=origin | {"values": values}),
            "pixel-map": QTable(self._pixel_map, meta=origin, descriptions={"dark": "factor on the dark current"}),
        }

    @property
    def _pixel_map(self) -> dict[str, Any]:
        """Columns of the map of pixels; those that are not read have the mean dark current and bias of the others."""
        level, bias, read = self.dark.level_dn_per_s, self.dark.bias_dn, self.nominal.read_pixels
        level = level / (self.nominal.dark_dn_per_s if "dark current" in self.dark.assumed else level.mean())
        n_pixel = self.nominal.pixels
        dark, every_bias = np.full(n_pixel, level.mean()), np.full(n_pixel, bias.mean())
        dark[read], every_bias[read] = level, bias
        columns: dict[str, Any] = {"pixel": np.arange(n_pixel), "dark": dark}
        for name in ("response", "gain", "read_noise_dn"):
            if (column := getattr(self.nominal.pixel_map, name, None)) is not None:
                columns[name] = column
        if "read_noise_dn" in columns:
            # The fit determines the mean variance of the pixels that are read.
            noise_dn = columns["read_noise_dn"]
            rms_dn = np.sqrt(np.mean(noise_dn[read] ** 2))
            fitted_dn = self.changes.get("read_noise_dn", rms_dn)
            # A nominal map of zeros does not tell how pixels differ.
            noise_dn = noise_dn * fitted_dn / rms_dn if rms_dn > 0 else np.full(n_pixel, fitted_dn)
            columns["read_noise_dn"] = noise_dn * u.DN
        if np.ptp(bias) > 0:
            columns["bias_dn"] = every_bias * u.DN
        return columns

    def _covariance(self, at: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the covariance of log throughput at some pixels and of the logarithms of the values in `CALIBRATED`.

        Counts determine the product of gain and throughput. Frames without light give the sum of dark counts and bias,
        and of the variances of dark and read noise, so that an error of the bias changes dark current and read noise.
        The throughput of a pixel is known better than its wavelength.
        """
        f, t, d, n, now = self.throughput, self.transfer, self.dark, self.nominal, self.changes
        count, m = at.size, len(f.joint) - f.wavelength_nm.size
        place = {name: count + k for k, name in enumerate(CALIBRATED)}
        of_light = np.eye(count + len(CALIBRATED), count + m)
        of_light[count:] = 0.0
        if m >= 2:
            half = np.ptp(f.wavelength_nm) / 2
            slope = np.gradient(np.log(self.fitted_throughput), f.wavelength_nm)[at]
            of_light[:count, count] = -slope
            of_light[:count, count + 1] = -slope * (f.wavelength_nm[at] - f.wavelength_nm.mean()) / half
            first = (n.pixel_zero_nm - f.wavelength_nm.mean()) / half
            of_light[place["pixel_zero_nm"], count : count + 2] = np.array([1.0, first]) / now["pixel_zero_nm"]
            of_light[place["dispersion_nm_per_pixel"], count + 1] = (
                n.dispersion_nm_per_pixel / half / now["dispersion_nm_per_pixel"]
            )
        if m == 4:
            of_light[place["gaussian_fwhm_nm"], count + 2] = n.gaussian_fwhm_nm / now["gaussian_fwhm_nm"]
        chosen = np.concatenate([at, np.arange(f.wavelength_nm.size, len(f.joint))])
        joint = f.joint[np.ix_(chosen, chosen)]
        joint[:count, :count] -= t.relative_gain_error**2
        covariance = of_light @ joint @ of_light.T
        of_transfer = np.zeros((len(covariance), 2))
        of_transfer[:count, 1] = -1 / t.noise.gain
        of_transfer[place["conversion_uv_per_electron"], 1] = 1 / t.noise.gain
        # A read noise at its bound of zero has no relative error.
        read = 0.0 if "read noise" in t.assumed or not t.read_noise_dn else 0.5 / t.read_noise_dn**2
        of_transfer[place["read_noise_dn"], 0] = read
        covariance += of_transfer @ t.covariance @ of_transfer.T
        if "dark current" not in d.assumed:
            of_dark = np.zeros((len(covariance), 3))
            of_dark[place["read_noise_dn"], 0] = read * t.noise.dark_factor
            # From the logarithm of the level at the reference to that at 0 deg C.
            of_dark[place["dark_scale_dn_per_s"], 1:] = 1 / d.level_dn_per_s.mean(), -d.reference_c
            of_dark[place["dark_slope_per_c"], 2] = 1 / d.slope_per_c
            covariance += of_dark @ d.shared @ of_dark.T
        return np.asarray(covariance)

    def instrument_toml(self) -> bytes:
        """Return the content of the instrument file."""
        import tomli_w

        parent = self.study.observation.instrument
        extends = parent if parent in shipped_names() else str(Path(parent).resolve())
        values: dict[str, Any] = {"version": FILE_VERSION, "extends": extends}
        values |= {"name": f"{self.nominal.name}-calibrated", "notice": self.notice}
        values |= {key: {"value": value, "tag": "C", "source": self.source} for key, value in self.changes.items()}
        values |= {"throughput_factor": "throughput-factor.ecsv", "throughput_errors": "throughput-errors.ecsv",
                   "pixel_map": "pixel-map.ecsv"}  # fmt: skip
        return tomli_w.dumps(values).encode()

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """The instrument file, alone and with the tables that it names."""
        return {"instrument.toml": self.instrument_toml, "instrument.zip": self.instrument_zip}

    def instrument_zip(self) -> bytes:
        """Return an archive of the instrument file and of the tables that it names."""
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("instrument.toml", self.instrument_toml())
            for name, table in self.instrument_tables.items():
                archive.writestr(f"{name}.ecsv", ecsv_text(table))
        return out.getvalue()


@by_keywords("fits, of which none is reported")
def calibrate(
    study: Study,
    engine: Engine | Pool | None = None,
    progress: Progress = None,
    *,
    frames: tuple[Frames, ...] | None = None,
    stars: tuple[Source | None, ...] | None = None,
) -> CalibrateAnswer:
    """Fit an instrument to raw frames of standard stars and to frames without light.

    The study's ``calibrate`` lists the observations; its observation names the instrument from which the fit starts.

    Parameters
    ----------
    frames : tuple of Frames, optional
        Frames in memory, in place of the files of the observations, in their order.
    stars : tuple of Source or None, optional
        Spectra in memory, in place of those of the observations; None for frames without light.
    """
    question = study.calibrate
    nominal, observations = _observations(study, frames, stars)
    lit = [observation for observation in observations if observation.star is not None]
    without = [observation for observation in observations if observation.star is None]
    noise = detector.NoiseModel.nominal(nominal)
    # The dark current is fitted again with the noise as fitted.
    for _ in range(2 if without else 1):
        dark = detector.fit_dark(without, nominal, noise)
        error = float(np.sqrt(dark.shared[0, 0]))
        variances = detector.measured_variances(observations, dark, nominal)
        transfer = detector.fit_photon_transfer(variances, nominal, error)
        noise = transfer.noise
    model = ThroughputModel(
        lit, nominal, dark, transfer, knots=question.knots, sky=study.sky.sky(), order=study.observation.order,
        light_error=question.light_error,
    )  # fmt: skip
    throughput = fit_throughput(model, question.spectrum_error)
    return CalibrateAnswer(study, nominal, observations, dark, transfer, throughput)


def _observations(
    study: Study, frames: tuple[Frames, ...] | None, stars: tuple[Source | None, ...] | None
) -> tuple[Instrument, tuple[detector.CalibrationFrames, ...]]:
    """Return the instrument from which the fit starts and the observations; parameters as for `calibrate`."""
    question = study.calibrate
    if not any(observation.library or observation.spectrum for observation in question.observations):
        raise InputError(
            "calibrate.observations must name the library or spectrum of a standard star", key="calibrate.observations"
        )
    for name, argument in (("frames", frames), ("stars", stars)):
        if argument is not None and len(argument) != len(question.observations):
            raise InputError.of(name, len(argument), f"{len(question.observations)}, one for each observation")
    nominal = study.observation.load_instrument()
    observations = list[detector.CalibrationFrames]()
    for k, entry in enumerate(question.observations):
        read = frames[k] if frames else read_frames(entry.frames, entry.mapping, raw=True)
        star = stars[k] if stars else entry.source()
        observation = detector.CalibrationFrames.of(read, nominal, star, entry.temperature_c)
        if not observation.usable(nominal).any():
            raise InputError.of("observations", observation.name, "frames with a pixel below saturation")
        if any(np.array_equal(observation.raw_dn, earlier.raw_dn) for earlier in observations):
            raise InputError.of("observations", observation.name, "frames that no other observation has")
        observations.append(observation)
    return nominal, tuple(observations)
