"""Pictures of a calibration: throughput, residuals, dark current and photon transfer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.pictures.inputs import RANGE_NM, WAVELENGTH
from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, NULL, headline, plain_numbers, styled_picture

if TYPE_CHECKING:
    from mauvecl.answers.observations.calibrate import CalibrateAnswer

#: Pixels that are averaged for a point of the residuals.
BIN = 16
#: Bins of the photon transfer, of equal numbers of values.
TRANSFER_BINS = 40


@picture_of("CalibrateAnswer", "throughput")
@styled_picture
def fitted_throughput(plt: Any, answer: CalibrateAnswer) -> Any:
    """Plot the fitted throughput with its 95 % band next to the nominal one, and their ratio."""
    table = answer.throughput_table
    nm, fitted, ratio = (np.asarray(table[name]) for name in ("wavelength", "throughput", "ratio"))
    error = 1.96 * np.asarray(table["relative_error"])
    figure, (above, below) = plt.subplots(2, 1, figsize=(5.2, 4.6), sharex=True)
    above.plot(
        nm, 100 * np.asarray(table["nominal"]), color=NULL, linestyle="--", label=f"{answer.nominal.name}, nominal"
    )
    above.fill_between(nm, 100 * fitted * np.exp(-error), 100 * fitted * np.exp(error), color=COLOURS[1], alpha=0.5,
                       linewidth=0)  # fmt: skip
    above.plot(nm, 100 * fitted, color=COLOURS[0], label="fitted, 95 %")
    above.set(ylabel="electrons per photon (%)", ylim=(0, None))
    above.legend()
    below.axhline(1, color=NULL, linestyle="--", linewidth=0.8)
    below.fill_between(nm, ratio * np.exp(-error), ratio * np.exp(error), color=COLOURS[1], alpha=0.5, linewidth=0)
    below.plot(nm, ratio, color=COLOURS[0])
    below.set(xlabel=WAVELENGTH, ylabel="fitted / nominal", xlim=RANGE_NM)
    headline(figure, f"Throughput {answer.source}")
    return figure


@picture_of("CalibrateAnswer", "residuals")
@styled_picture
def calibration_residuals(plt: Any, answer: CalibrateAnswer) -> Any:
    """Plot the residuals of each star, averaged over some pixels, in their standard deviations."""
    f = answer.throughput
    figure, axes = plt.subplots(len(f.residual), 1, figsize=(5.2, 1.0 + 1.1 * len(f.residual)), sharex=True,
                                sharey=True, squeeze=False)  # fmt: skip
    nm, each = f.binned_residuals(BIN)
    for axis, one, binned in zip(axes[:, 0], answer.stars, each, strict=True):
        axis.axhspan(-2, 2, color=NULL, alpha=0.2, linewidth=0)
        axis.plot(nm, binned, ".", color=COLOURS[0], markersize=4)
        axis.set_title(one.name)
    axes[len(axes) // 2, 0].set_ylabel(f"residual of {BIN} pixels (sigma)")
    axes[-1, 0].set(xlabel=WAVELENGTH, xlim=RANGE_NM)
    headline(figure, f"Observed less fitted spectra; grey: 2 sigma; p = {f.p_value:.2g}")
    return figure


@picture_of("CalibrateAnswer", "photon-transfer", when=lambda answer: "gain" not in answer.transfer.assumed)
@styled_picture
def photon_transfer(plt: Any, answer: CalibrateAnswer) -> Any:
    """Plot the variance of frames against their mean, binned, with the fit and its residuals."""
    t = answer.transfer
    # Dark counts have their own variance, which the fit includes.
    groups = np.array_split(np.argsort(t.model), TRANSFER_BINS)
    model, measured = (np.array([values[group].mean() for group in groups]) for values in (t.model, t.variance))
    error = np.array([(t.variance - t.model)[group].std() / np.sqrt(group.size) for group in groups])
    figure, (above, below) = plt.subplots(2, 1, figsize=(4.6, 4.6), sharex=True)
    above.plot(model, model, color=NULL)
    above.plot(model, measured, ".", color=COLOURS[0])
    above.set(xscale="log", yscale="log", ylabel="measured variance (DN²)")
    below.axhline(0, color=NULL)
    below.errorbar(model, 100 * (measured / model - 1), 100 * error / model, fmt=".", color=COLOURS[0], elinewidth=0.8)
    below.set(xlabel="variance by the fit (DN²)", ylabel="difference (%)")
    plain_numbers(above)
    text = f"gain {t.noise.gain:.4g} +- {t.gain_error:.1g} DN per electron, read noise {t.read_noise_dn:.3g} +- "
    headline(figure, f"Photon transfer: {text}{t.read_noise_error:.1g} DN; dark counts in {t.dark_unit}")
    return figure


@picture_of("CalibrateAnswer", "dark", when=lambda answer: answer.dark.dof > 0)
@styled_picture
def dark_current(plt: Any, answer: CalibrateAnswer) -> Any:
    """Plot the dark current of each pixel, and its mean against temperature with the fit."""
    d = answer.dark
    figure, (pixels, mean) = plt.subplots(1, 2, figsize=(7.2, 2.9))
    pixels.plot(answer.nominal.wavelength_nm, d.level_dn_per_s, ".", color=COLOURS[0], markersize=2)
    pixels.set(xlabel=f"{WAVELENGTH} of the pixel", ylabel="dark current (DN/s)", xlim=RANGE_NM,
               title=f"at {d.reference_c:.1f} C")  # fmt: skip
    every = []
    for one in answer.observations:
        if one.star is None:
            rate = (one.raw_dn - d.bias_dn).mean(axis=1) / one.exposure_s
            mean.plot(one.temperature_c, rate, ".", color=COLOURS[0], markersize=3)
            every.append(one.temperature_c)
    kelvin = np.linspace(min(map(np.min, every)), max(map(np.max, every)), 101)
    mean.plot(kelvin, d.level_dn_per_s.mean() * d.growth(kelvin), color=COLOURS[4], label="fitted")
    n = answer.nominal
    usual = n.dark_scale_dn_per_s * np.exp(n.dark_slope_per_c * kelvin)
    mean.plot(kelvin, usual, color=NULL, linestyle="--", label="nominal")
    mean.set(xlabel="detector temperature (C)", ylabel="mean dark current (DN/s)")
    mean.legend()
    headline(figure, f"Dark current: slope {d.slope_per_c:.4g} +- {d.slope_error:.1g} per deg C")
    return figure
