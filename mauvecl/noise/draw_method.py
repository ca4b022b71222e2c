"""Choice of the method by which the noise of scenarios is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise.cumulants import Cumulants, joint_is_exact, needs_fourth_power, stack_is_exact
from mauvecl.noise.drawing import Drawing, Mode, Recipe
from mauvecl.noise.factor_tables import Factors
from mauvecl.noise.pixel_tables import sky_share
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.noise.processes import Processes

#: Frames are drawn one by one if a pixel's mean is within this many standard deviations of a rail.
RAIL_SIGMA = 8.0
#: The device does not round counts correctly beyond this distance from their base.
REACH_DN = 2.0**22
#: Limit of the counter's 24 bits for groups of four pixels.
MAX_PIXELS = 65_536


@dataclass(frozen=True, eq=False)
class DrawMethod:
    """Method by which scenarios are drawn; see `Scene` for the switches."""

    frames: bool
    joint: bool
    quartic: bool
    photons: bool
    each: int  # frames per draw
    cumulants: list[Cumulants]  # of one draw of each scenario


def choose_method(scenarios: Sequence[Expectation], drawing: Drawing, factors: Factors) -> DrawMethod:
    """Choose the method for scenarios. Raises InputError if they cannot be drawn as requested, or not together."""
    quiet, processes = scenarios[0], drawing.processes
    modulations = processes.modulations
    if quiet.wavelength_nm.size > MAX_PIXELS:
        raise InputError(
            f"{quiet.wavelength_nm.size} pixels", f"at most {MAX_PIXELS}", key="pixels", value=quiet.wavelength_nm.size
        )
    for other in scenarios[1:]:
        _check_same_detector(quiet, other)
    corners = _corners(factors)
    frames = _draw_frames(scenarios, drawing.mode, factors, processes, corners)
    each = 1 if frames else quiet.n_frames
    cumulants = [Cumulants.of(x, each) for x in scenarios]
    varied = [[_scaled(x, c, corner) for corner in corners] for x, c in zip(scenarios, cumulants, strict=True)]
    joint = _joint(scenarios, varied, drawing.recipe)
    if modulations and not joint:
        raise InputError(
            f"{modulations[0][0]} varies within a run, and the noise of {quiet.name} cannot be drawn jointly",
            "Gaussian noise of at least 1.5 Poisson counts in each pixel and more for few counts, or no such process",
            key=modulations[0][0],
        )
    return DrawMethod(
        frames=frames,
        joint=joint,
        quartic=joint and any(needs_fourth_power(c, varying=bool(modulations)) for row in varied for c in row),
        photons=not joint and quiet.photon_noise == "poisson",
        each=each,
        cumulants=cumulants,
    )


def near_rail(x: Expectation, factors: Factors, processes: Processes) -> NDArray[np.bool_]:
    """Return the pixels whose frames come within `RAIL_SIGMA` of zero or saturation, shape (n_pixel,).

    The limits include all values allowed by the priors and the largest charge of additive processes per frame.
    """
    variance, light = x.unsaturated_variance_dn2 / x.n_frames, x.light_dn / x.n_frames
    mean = x.mean_raw_dn
    ends = []
    for end_light, more_dark, sky in zip(factors.light_ends, factors.dark_ends, factors.sky_ends, strict=True):
        more_light = factors.on_light(end_light, sky, sky_share(x))
        there = mean + (more_light - 1.0) * light + (more_dark - 1.0) * x.dark_dn
        more = (more_light - 1.0) * x.gain_dn_per_electron * light + (more_dark - 1.0) * x.dark_variance_dn2
        ends.append((there, RAIL_SIGMA * np.sqrt(variance + np.maximum(more, 0.0))))
    added = x.gain_dn_per_electron * sum(one.most_electrons(x.frame_s) for one in processes.additive.values())
    low: NDArray[np.bool_] = ends[0][0] - ends[0][1] < 0.0
    high: NDArray[np.bool_] = ends[1][0] + ends[1][1] + added > x.highest_dn
    return low | high


def _corners(factors: Factors) -> list[tuple[float, float, float]]:
    """Return a grid of factors on light, dark and sky that spans the priors in steps of at most 2."""
    ends = (factors.light_ends, factors.dark_ends, factors.sky_ends)
    grids = [np.geomspace(low, high, 1 + int(np.ceil(np.log2(high / low)))) for low, high in ends]
    return [(float(light), float(dark), float(sky)) for light in grids[0] for dark in grids[1] for sky in grids[2]]


def _scaled(x: Expectation, c: Cumulants, corner: tuple[float, float, float]) -> Cumulants:
    light, dark, sky = corner
    return c.scaled(light if sky == 1.0 else Factors.on_light(light, sky, sky_share(x)), dark)


def _joint(scenarios: Sequence[Expectation], varied: Sequence[Sequence[Cumulants]], recipe: Recipe) -> bool:
    """Return whether each pixel's noise can be drawn from one normal for all factors on light and dark."""
    if recipe == "apart":
        return False
    for x, c in ((x, c) for x, row in zip(scenarios, varied, strict=True) for c in row):
        exact = joint_is_exact(c)
        if not exact.all():
            if recipe == "joint":
                pixel = int(np.argmin(exact))
                raise InputError(
                    f"recipe = 'joint', and pixel {pixel} of {x.name} has {np.sqrt(c.gaussian[pixel]):.3g} DN of "
                    "Gaussian noise next to Poisson counts",
                    "recipe 'apart' or 'auto'",
                    key="recipe",
                    value="joint",
                )
            return False
    return True


def _draw_frames(
    scenarios: Sequence[Expectation],
    mode: Mode,
    factors: Factors,
    processes: Processes,
    corners: Sequence[tuple[float, float, float]],
) -> bool:
    if scenarios[0].n_frames == 1 or mode == "frames":
        # For a single frame, both modes give the same draws.
        return mode == "frames" and scenarios[0].n_frames > 1
    for x in scenarios:
        near = near_rail(x, factors, processes)
        # The approximation of rounding as noise is worst for the least light and dark.
        coarse = ~stack_is_exact(_scaled(x, Cumulants.of(x, 1), corners[0]), x)
        for pixels, why in (
            (near, f"cannot clip, and a frame comes within {RAIL_SIGMA:g} sigma of zero or saturation"),
            (coarse, "treats rounding as noise, and a frame has too little noise for that"),
        ):
            if pixels.any():
                if mode == "stacked":
                    where = float(x.wavelength_nm[pixels][0])
                    raise InputError(
                        f"mode = 'stacked' {why} in the pixel at {where:.1f} nm of {x.name}",
                        "mode 'frames' or 'auto'",
                        key="mode",
                        value="stacked",
                    )
                return True
    return False


def check_reach(x: Expectation, c: Cumulants, factors: Factors) -> None:
    """Raise InputError if the priors allow counts beyond the range in which the device rounds correctly."""
    share = sky_share(x)
    least, most = (factors.on_light(*ends, share) for ends in zip(factors.light_ends, factors.sky_ends, strict=True))
    middle = factors.on_light(factors.light, factors.sky, share)
    light = np.maximum(most - middle, middle - least)
    dark = max(factors.dark_ends[1] - factors.dark, factors.dark - factors.dark_ends[0])
    variance = c.variance + most * c.light_variance + factors.dark_ends[1] * c.dark_variance
    reach = light * c.light_dn + dark * c.dark_dn + 8.0 * np.sqrt(variance)
    if (reach >= REACH_DN).any():
        pixel = int(np.argmax(reach))
        raise InputError(
            f"the priors move pixel {pixel} of {x.name} {reach[pixel]:.3g} DN away from its mean",
            f"less than {REACH_DN:g}: shorten the exposure or draw frame by frame",
            key="priors",
            value=float(reach[pixel]),
        )


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
        "photon_noise",
        "adc_max_dn",
        "saturation_dn",
    ):
        if not np.array_equal(getattr(quiet, name), getattr(other, name)):
            raise InputError(
                f"{name} of {other.name} differs from that of {quiet.name}",
                "scenarios of one study to share instrument and exposure",
                key=name,
                value=other.name,
            )
