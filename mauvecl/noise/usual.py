"""The unknowns that `--with-unknowns` draws and marginalises over: one table, which documentation and messages read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mauvecl.noise.priors import Normal, Prior, Uniform


@dataclass(frozen=True)
class Usual:
    """One unknown.

    Attributes
    ----------
    nuisance : str
        Its spectrum, of `statistics.nuisances.NUISANCES`.
    process : str
        What draws it, of `processes.Processes`.
    prior : callable
        From the detector's nominal temperature, deg C, to what is drawn.
    sd : float
        The prior standard deviation that statistics take; infinite where it is projected out.
    scatter : float
        Root mean square of the amplitude that is drawn.
    drawn, marginalised, source : str
        The same in words; a source, or the word assumption.
    """

    nuisance: str
    process: str
    prior: Callable[[float], Prior]
    sd: float
    scatter: float
    drawn: str
    marginalised: str
    source: str


USUAL = (
    Usual(
        "dark",
        "detector_temperature",
        lambda t: Normal(t, 0.5, t - 2.5, t + 2.5),
        float("inf"),
        0.5,
        "detector temperature, normal, +-0.5 deg C around the nominal one, cut at 2.5 deg C",
        "free: the dark current follows the temperature by an exponential, which is no normal amplitude",
        "assumption: the thermal cycle of one orbit",
    ),
    Usual(
        "light",
        "jitter",
        lambda _: Uniform(0.0, 0.05),
        float("inf"),
        0.05 / 3**0.5,
        "share of the light lost in each frame, uniform, 0-5 %",
        "free: the mean loss is unknown too, and so is the star's own level",
        "the paper: light lost by pointing errors stays below 5 %; uniform and anew in each frame: assumption",
    ),
    Usual(
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
