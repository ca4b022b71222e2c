"""One target of a plan: its star and stretches, what is recovered of its flares, how often it has them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.conditions import Conditions, Met, hits_variance_dn2
from mauvecl.host.orbit.targets import Target
from mauvecl.lightcurve.flares.energies import EnergyScale, quiescent_luminosity
from mauvecl.lightcurve.flares.rates import BOLOMETRIC, Rates
from mauvecl.lightcurve.search.completeness import Completeness, frame_signal
from mauvecl.lightcurve.search.yields import Yield
from mauvecl.schema.errors import InputError
from mauvecl.study.orbits import PlanTarget
from mauvecl.study.sections import SkyLight, Star
from mauvecl.study.spectral_types import nearest_spectrum
from mauvecl.study.stare_expectation import energy_scale
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.visible import VisibleAnswer
    from mauvecl.host.expectation import Expectation

#: Amplitude of the flare whose light per amplitude is looked at; its own photon noise is left out.
SMALL = 0.01


@dataclass(frozen=True, eq=False)
class Looked:
    """What a completeness is made of: one target, its star, the stretches in which it is seen.

    Attributes
    ----------
    target : Target
    star : Star
    quiet : Expectation
        One frame.
    signal_per_frame : float
        S/N of a frame with a flare of amplitude 1; 0 where every pixel saturates.
    scale : EnergyScale
        Bolometric.
    window_s : float
        Median length of a stretch; 0 where it is never seen.
    sky : float or None
        Zodiacal light behind it, V mag arcsec^-2, as `quiet` has it; the study's sky where it is None.
    conditions : Conditions or None
        Of the orbit while it is seen; the study's where it is None.
    hits_per_cm2_s : float
        By particles.
    """

    target: Target
    star: Star
    quiet: Expectation
    signal_per_frame: float
    scale: EnergyScale
    window_s: float
    sky: float | None = None
    conditions: Conditions | None = None
    hits_per_cm2_s: float = 0.0


#: Of a star that saturates every pixel.
NOTHING = Completeness(np.array([1e24, 1e40]), np.zeros(2), BOLOMETRIC, "every pixel saturates: no flare is recovered")
#: A target's completeness, of bolometric energies; None for one that is never seen.
CompletenessOf = Callable[[Study, Looked], Completeness]


@dataclass(frozen=True, eq=False)
class Planned:
    """One target of a plan.

    Attributes
    ----------
    looked : Looked
    seen_h, hours : float
        In which it is seen, and of these observed.
    completeness : Completeness, optional
        None where it is never seen.
    rates : Rates, optional
        Of bolometric energies; None where none are known.
    recovered : Yield, optional
        With both of them.
    best_months : tuple of str
    no_rates : str
        Why there are none.
    """

    looked: Looked
    seen_h: float
    hours: float
    completeness: Completeness | None
    rates: Rates | None
    recovered: Yield | None
    best_months: tuple[str, ...]
    no_rates: str = ""

    @property
    def name(self) -> str:
        """The target's."""
        return self.looked.target.name

    def energy_at(self, probability: float) -> float:
        """Bolometric energy from which on a flare is recovered with a probability, erg; infinite where it never is."""
        return float("inf") if self.completeness is None else self.completeness.energy_at(probability)

    @property
    def extrapolated(self) -> bool:
        """Whether flares of E50 lie outside the energies at which the rates were measured."""
        if self.rates is None:
            return False
        low, high = self.rates.measured_erg
        return not low <= self.energy_at(0.5) <= high


def closed_form(study: Study, looked: Looked) -> Completeness:
    """The completeness of a bank of matched filters in white noise; see `Completeness.of_search`."""
    return Completeness.of_search(
        looked.signal_per_frame,
        looked.scale,
        window_s=looked.window_s,
        false_alarms_per_day=study.search.rate,
        bank=study.search.white_bank(looked.quiet.frame_s),
        law=study.plan.law(),
    )


def rates_of(study: Study, text: PlanTarget, looked: Looked) -> tuple[Rates | None, str]:
    """A target's flares by bolometric energy, or why none are known."""
    try:
        rates = text.distribution(looked.target.spectral_type or "")
    except InputError as error:
        if any(getattr(text, name) is not None for name in ("mass_msun", "alpha", "rates_file", "rates")):
            raise
        return None, str(error)
    if rates.definition == "light":
        return rates.in_band(BOLOMETRIC, flare=study.flare.light()), ""
    source, band = looked.star.source(), rates.amplitude_band
    measured = study.model_copy(update={"flare": study.flare.model_copy(update={"band": band})})
    scale = energy_scale(measured, looked.star, source, "bolometric", study.flare.temperature_k)
    assert scale is not None
    assert looked.star.distance_pc is not None
    return rates.of_light(scale.erg_per_s, quiescent_luminosity(source, looked.star.distance_pc, band)), ""


def star_of(study: Study, text: PlanTarget) -> Star:
    """The star of the library that stands for a target.

    Raises
    ------
    InputError
        If its type, magnitude or distance is neither given nor known.
    """
    known = text.target(study.orbit.simbad)
    given: dict[str, Any] = {
        "spectral_type": text.spectral_type or known.spectral_type,
        "magnitude": known.magnitude if text.magnitude is None else text.magnitude,
        "distance_pc": known.distance_pc if text.distance_pc is None else text.distance_pc,
    }
    missing = [name for name, value in given.items() if value is None]
    if missing:
        raise InputError(
            f"target {text.name!r} has no {' and no '.join(missing)}",
            "them in the table of targets: it is not in the embedded list",
            key="plan.targets",
            value=text.name,
        )
    library = nearest_spectrum(given.pop("spectral_type"))
    return Star(library=library, **given)


def looked_of(
    study: Study, text: PlanTarget, star: Star, target: Target, seen: VisibleAnswer, k: int, met: Met | None = None
) -> Looked:
    """One frame of a target, and what a flare adds to it."""
    if text.spectral_type is not None:
        target = replace(target, spectral_type=text.spectral_type)
    conditions = None if met is None else met.of(seen.visibility, k, study.orbit.orbit().elements.period_s)
    lengths = seen.windows[k].length_s
    window = float(np.median(lengths)) if lengths.size else 0.0
    sky, source = sky_behind(seen, k), star.source()
    one = stared_at(study.at("exposure", study.observation.load_instrument().frame_s), star, sky, conditions)
    quiet, flare = one.expect([source, one.flaring(source, SMALL)])
    rays = one.processes.cosmic_rays
    hits = None if rays is None else hits_variance_dn2(rays, quiet)
    signal = frame_signal(quiet, flare, SMALL, added_variance_dn2=hits)
    scale = energy_scale(study, star, source, "bolometric", study.flare.temperature_k)
    assert scale is not None
    return Looked(
        target, star, quiet, signal, scale, window, sky, conditions, 0.0 if rays is None else rays.rate_per_cm2_s
    )


def stared_at(study: Study, star: Star, sky: float | None, conditions: Conditions | None) -> Study:
    """The study with one star, the sky behind it, and what the orbit does to its frames."""
    changes: dict[str, Any] = {"star": (star,)}
    if sky is not None:
        changes["sky"] = SkyLight(surface_brightness=sky)
    if conditions is not None:
        rays = conditions.rays(study.processes.cosmic_rays)
        changes["processes"] = study.processes.model_copy(update={"cosmic_rays": rays})
        if study.observation.temperature_c is None:
            at = {"temperature_c": conditions.temperature_c}
            changes["observation"] = study.observation.model_copy(update=at)
    return study.model_copy(update=changes)


def sky_behind(seen: VisibleAnswer, k: int) -> float | None:
    """V mag arcsec^-2: the median over the days on which a target is seen, or over all."""
    light, hours = seen.zodiacal[k], seen.visibility.by_day(k)
    used = np.isfinite(light) & (hours > 0)
    used = used if used.any() else np.isfinite(light)
    return float(np.median(light[used])) if used.any() else None
