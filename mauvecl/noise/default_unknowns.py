"""Default unknowns, which `--with-unknowns` draws and marginalises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mauvecl.noise.priors import Normal, Prior, Uniform


@dataclass(frozen=True)
class DefaultUnknown:
    """Default treatment of an unknown.

    Attributes
    ----------
    nuisance : str
        Name of its spectrum in `statistics.nuisances.NUISANCES`.
    process : str
        Name of the process in `processes.Processes` that draws it.
    prior : callable
        Function that returns the prior for the detector's nominal temperature, deg C.
    sd : float
        Prior standard deviation for statistics; infinite if the unknown is projected out.
    scatter : float
        Root mean square of the drawn amplitude.
    drawn, marginalised : str
        Descriptions of the draw and of the marginalisation, for messages and documentation.
    source : str
        Source of the values, or "assumption".
    """

    nuisance: str
    process: str
    prior: Callable[[float], Prior]
    sd: float
    scatter: float
    drawn: str
    marginalised: str
    source: str


DEFAULT_UNKNOWNS = (
    DefaultUnknown(
        "dark",
        "detector_temperature",
        lambda t: Normal(t, 0.5, t - 2.5, t + 2.5),
        float("inf"),
        0.5,
        "detector temperature, normal, +-0.5 deg C around the nominal one, cut at 2.5 deg C",
        "free: the dark current follows the temperature by an exponential, which is no normal amplitude",
        "assumption: the thermal cycle of one orbit",
    ),
    DefaultUnknown(
        "light",
        "jitter",
        lambda _: Uniform(0.0, 0.05),
        float("inf"),
        0.05 / 3**0.5,
        "share of the light lost in each frame, uniform, 0-5 %",
        "free: the mean loss is unknown too, and so is the star's own level",
        "the paper: light lost by pointing errors stays below 5 %; uniform and anew in each frame: assumption",
    ),
    DefaultUnknown(
        "sky",
        "sky_level",
        lambda _: Normal(1.0, 0.1, 0.5, 1.5),
        0.1,
        0.1,
        "factor on the sky's light, normal, 1 +- 0.1, cut at 0.5 and 1.5",
        "10 %",
        "assumption: the scatter of the zodiacal light about its model",
    ),
)
