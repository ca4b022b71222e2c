"""Expectations of one study as the arrays that the kernels and their twin read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl import layout
from mauvecl.host.errors import InputError
from mauvecl.poisson import SMALLEST_EXPANDED, table_set

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Mode = Literal["auto", "frames", "stacked"]

#: Pixels are padded to a multiple of this with ones that never contribute.
PIXEL_BLOCK = 32
#: `frames` is chosen where a pixel's mean is within this many sigma of a rail.
RAIL_SIGMA = 8.0


@dataclass(frozen=True, eq=False)
class Scene:
    """Scenarios on common draws; scenario 0 is the quiescent one.

    Attributes
    ----------
    n_pixel : int
        Real pixels; the arrays are padded to a multiple of `PIXEL_BLOCK`.
    n_frames : int
        Frames of the exposure.
    frames : bool
        Each frame drawn, rounded and clipped (True), or their sum drawn at once.
    expansion : bool
        Whether the dark counts come from the expansion, all means being large, or from alias tables.
    clip : bool
        Whether single draws meet the ADC's rails.
    pixels : ndarray of layout.PIXEL, shape (n_padded,)
    levels : ndarray of layout.LEVEL, shape (n_scenario, n_padded)
    tables : ndarray of uint32
        Alias tables of the dark counts, end to end.
    base_dn : ndarray of int64, shape (n_scenario, n_pixel)
        Whole DN of one draw's mean that the kernels leave out.
    used : ndarray of bool, shape (n_pixel,)
        Pixels that enter the statistics: those not saturated without a flare.
    """

    n_pixel: int
    n_frames: int
    frames: bool
    expansion: bool
    clip: bool
    pixels: NDArray[np.void]
    levels: NDArray[np.void]
    tables: NDArray[np.uint32]
    base_dn: NDArray[np.int64]
    used: NDArray[np.bool_]

    @property
    def n_draws(self) -> int:
        """Draws summed into one realisation of a pixel."""
        return self.n_frames if self.frames else 1

    def part(self, scenarios: Sequence[int]) -> Scene:
        """The same scene with some of its scenarios, in the order given."""
        chosen = list(scenarios)
        return replace(self, levels=self.levels[chosen], base_dn=self.base_dn[chosen])


def near_rail(x: Expectation) -> NDArray[np.bool_]:
    """Pixels whose single frame comes within `RAIL_SIGMA` of the ADC's ends, shape (n_pixel,)."""
    reach = RAIL_SIGMA * np.sqrt(x.variance_dn2 / x.n_frames)
    low: NDArray[np.bool_] = x.mean_raw_dn - reach < 0.0
    high: NDArray[np.bool_] = x.mean_raw_dn + reach > x.adc_max_dn
    return low | high


def prepare(scenarios: Sequence[Expectation], mode: Mode = "auto") -> Scene:
    """Lay out scenarios for the device.

    Parameters
    ----------
    scenarios : sequence of Expectation
        The quiescent one first, on one instrument and exposure.
    mode : {"auto", "frames", "stacked"}
        Draw each frame, or all at once; by itself frames only near a rail.

    Raises
    ------
    InputError
        If the scenarios differ in anything but their light, or stacked draws are asked for near a rail.
    """
    quiet = scenarios[0]
    for other in scenarios[1:]:
        _check_same_detector(quiet, other)
    frames = _draw_frames(scenarios, mode)
    n_draw = 1 if frames else quiet.n_frames
    n_pixel = quiet.wavelength_nm.size
    padded = -(-n_pixel // PIXEL_BLOCK) * PIXEL_BLOCK

    gain = quiet.gain_dn_per_electron
    dark_gain = gain if quiet.dark_unit == "electrons" else np.ones(n_pixel)
    dark_mean = n_draw * quiet.dark_dn / dark_gain
    expansion = bool(dark_mean.min() >= SMALLEST_EXPANDED)
    tables, starts, entries = table_set([0.0] * n_pixel if expansion else dark_mean.tolist())
    centre = np.rint(dark_mean)

    used = ~quiet.saturated
    variance = quiet.variance_dn2
    pixels = np.zeros(padded, layout.PIXEL)
    real = pixels[:n_pixel]
    real["table_start"] = starts
    real["table_bits"] = [table.bits for table in tables]
    pixels["table_bits"][n_pixel:] = tables[0].bits
    real["dark_low"] = np.array([table.low for table in tables]) - centre
    if expansion:
        root = np.sqrt(dark_mean)
        real["dark_offset"] = dark_mean - centre - 1 / 6
        real["dark_slope"] = root - 1 / (36 * root)
        real["dark_cubic"] = -1 / (72 * root)
    real["dark_gain"] = dark_gain
    real["used"] = used
    real["inverse_variance"] = used / variance
    ends = np.append(np.diff(quiet.element) > 0, True)
    real["element_end"] = ends
    pixels["end_among_four"] = np.repeat(pixels["element_end"].reshape(-1, 4).any(axis=1), 4)
    element_variance = np.bincount(quiet.element, variance * used)
    with np.errstate(divide="ignore"):
        inverse = np.where(element_variance > 0, 1.0 / element_variance, 0.0)
    real["inverse_element_variance"][ends] = inverse

    levels = np.zeros((len(scenarios), padded), layout.LEVEL)
    base = np.zeros((len(scenarios), n_pixel), np.int64)
    quiet_mean = quiet.n_frames * quiet.mean_raw_dn
    for k, x in enumerate(scenarios):
        light = x.source_electrons + x.sky_electrons
        mean = n_draw * (gain * light + x.bias_dn) + dark_gain * centre
        top = np.inf if n_draw > 1 else x.adc_max_dn
        base[k] = np.clip(np.rint(mean), 0, top)
        level = levels[k, :n_pixel]
        # A stack of n rounded frames has n/12 of rounding variance; its own rounding brings the last 1/12.
        level["sd"] = np.sqrt(n_draw * (gain**2 * light + x.read_noise_dn**2) + (n_draw - 1) / 12)
        level["fraction"] = mean - base[k]
        level["low"] = -base[k]
        level["high"] = x.adc_max_dn - base[k]
        level["offset"] = (quiet.n_frames // n_draw) * base[k] - quiet_mean
    return Scene(
        n_pixel=n_pixel,
        n_frames=quiet.n_frames,
        frames=frames,
        expansion=expansion,
        clip=n_draw == 1,
        pixels=pixels,
        levels=levels,
        tables=entries,
        base_dn=base,
        used=used,
    )


def _draw_frames(scenarios: Sequence[Expectation], mode: Mode) -> bool:
    if mode not in ("auto", "frames", "stacked"):
        raise InputError(f"mode = {mode!r}, expected 'auto', 'frames' or 'stacked'")
    if scenarios[0].n_frames == 1 or mode == "frames":
        # One frame is its own stack: the same draws either way.
        return mode == "frames" and scenarios[0].n_frames > 1
    for x in scenarios:
        near = near_rail(x)
        if near.any():
            if mode == "stacked":
                where = float(x.wavelength_nm[near][0])
                raise InputError(
                    f"mode = 'stacked' cannot clip, and the pixel at {where:.1f} nm of {x.name} comes within "
                    f"{RAIL_SIGMA:g} sigma of the ADC's range, expected mode 'frames' or 'auto'"
                )
            return True
    return False


def _check_same_detector(quiet: Expectation, other: Expectation) -> None:
    for name in (
        "wavelength_nm",
        "dark_dn",
        "bias_dn",
        "read_noise_dn",
        "gain_dn_per_electron",
        "element",
        "n_frames",
        "frame_s",
        "dark_unit",
        "adc_max_dn",
    ):
        if not np.array_equal(getattr(quiet, name), getattr(other, name)):
            raise InputError(
                f"{name} of {other.name} differs from that of {quiet.name}, expected scenarios of one study "
                "to share instrument and exposure"
            )
