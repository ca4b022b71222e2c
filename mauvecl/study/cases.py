"""Cases of a study: what answers need of each star at each combination of sweep values, computed on first use."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Self

from mauvecl.study.labels import label
from mauvecl.study.questions import Sweep

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.detection.statistics import Setting
    from mauvecl.flares.events import Event
    from mauvecl.flares.frames import StareExpectation
    from mauvecl.flares.stare import Stare
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.exposure.sky import Sky
    from mauvecl.host.exposure.star import Neighbours
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source
    from mauvecl.noise.processes import Processes
    from mauvecl.study.sections import Observation, SkyLight, Star
    from mauvecl.study.study import Study


#: Sections of a study on which no expectation depends.
WITHOUT_LIGHT = frozenset({"nuisances"})
#: Number of stars whose spectra a study's cases keep, since a sweep may have any number of them.
MAX_SOURCES = 16


class Loader:
    """Stars, instruments and skies that the cases of a study share; each is loaded once.

    `source` returns the spectrum of a star, by default that of the study's section.
    """

    def __init__(self, source: Callable[[Star], Source] | None = None) -> None:
        self.source: Callable[[Star], Source] = lru_cache(MAX_SOURCES)(source or (lambda star: star.source()))
        self.sky: Callable[[SkyLight], Sky] = lru_cache(MAX_SOURCES)(lambda light: light.sky())
        self._near: Callable[[Star], Neighbours | None] = lru_cache(MAX_SOURCES)(lambda star: star.near())
        self._instruments: dict[str, Instrument] = {}
        self._unchanged: dict[str, Instrument] = {}

    def neighbours(self, star: Star) -> Neighbours | None:
        """Return the neighbours of a star, which do not depend on its magnitude."""
        return None if star.neighbours is None else self._near(star.model_copy(update={"magnitude": None}))

    def instrument(self, observation: Observation) -> Instrument:
        """Return the instrument of an observation."""
        key = repr((observation.instrument, observation.temperature_c, sorted(observation.changes.items())))
        if key not in self._instruments:
            file = str(observation.instrument)
            if file not in self._unchanged:
                unchanged = observation.model_copy(update={"changes": {}, "temperature_c": None})
                self._unchanged[file] = unchanged.load_instrument()
            self._instruments[key] = observation.changed(self._unchanged[file])
        return self._instruments[key]


@dataclass(frozen=True, eq=False)
class Case:
    """One star at one combination of sweep values.

    Nothing is loaded or computed before it is asked for, and each thing only once.

    Examples
    --------
    >>> from mauvecl import Study
    >>> from mauvecl.study.cases import cases
    >>> first, second = cases(Study())
    >>> first.label, round(first.quiet.exposure_s), len(first.flares)
    ('K3V V = 3.7', 50, 4)
    """

    study: Study  # with this star alone, at these values, without a sweep
    at: Mapping[str, float | str] = field(default_factory=dict)  # sweep values by quantity
    loader: Loader = field(default_factory=Loader, compare=False, repr=False)

    @property
    def star(self) -> Star:
        """The study's section of the star."""
        return self.study.star[0]

    @property
    def amplitudes(self) -> tuple[float, ...]:
        """Amplitudes of the flares."""
        return self.study.flare.amplitudes

    @cached_property
    def label(self) -> str:
        """Name and magnitude of the star, for tables and plots."""
        return label(self.star, self.quiet)

    @property
    def source(self) -> Source:
        """Spectrum of the star without a flare."""
        return self.loader.source(self.star)

    @property
    def neighbours(self) -> Neighbours | None:
        """Neighbours of the star, or None."""
        return self.loader.neighbours(self.star)

    @property
    def instrument(self) -> Instrument:
        """The instrument, with the study's changes and detector temperature."""
        return self.loader.instrument(self.study.observation)

    @property
    def sky(self) -> Sky:
        """The sky behind the star."""
        return self.loader.sky(self.study.sky)

    @cached_property
    def quiet(self) -> Expectation:
        """Expectation of the star without a flare."""
        return self.expect(self.source)[0]

    @cached_property
    def flares(self) -> list[Expectation]:
        """Expectations of the star with each of the study's flares."""
        return self.expect(*map(self.flaring, self.amplitudes))

    @property
    def expectations(self) -> list[Expectation]:
        """Expectations without a flare and with each flare."""
        return [self.quiet, *self.flares]

    @cached_property
    def processes(self) -> Processes:
        """Noise processes to draw."""
        processes = self.study.processes
        if self.study.nuisances.usual:
            return self.study.nuisances.processes(processes, self.instrument.temperature_c)
        return processes

    @property
    def draw_options(self) -> dict[str, Any]:
        """Arguments of the engine's methods: mode, recipe and processes."""
        o = self.study.observation
        return {"mode": o.mode, "recipe": o.recipe, "processes": self.processes}

    def flaring(self, amplitude: float, temperature_k: float | None = None) -> Source:
        """Return the star with a flare, by default of the study's temperature."""
        f = self.study.flare
        return self.source.flaring(
            amplitude,
            spectrum=f.light(temperature_k),
            band=f.band,
            geometry=f.geometry,
            photosphere_temperature=f.photosphere_temperature_k,
        )

    def expect(self, *sources: Source) -> list[Expectation]:
        """Compute the expectations of sources for the instrument, sky and exposure."""
        from mauvecl.host.exposure.expectation import expect

        o = self.study.observation
        how: dict[str, Any] = {"exposure": o.exposure_s, "sky": self.sky, "order": o.order, "signal": o.signal}
        how["neighbours"] = self.neighbours
        return [expect(source, self.instrument, **how) for source in sources]

    def unknowns(self, quiet: Expectation | None = None) -> Nuisances | None:
        """Return the nuisance parameters that statistics are marginalised over, or None.

        Their spectra are those of `quiet`, by default the star without a flare.
        """
        return self.study.nuisances.marginalised(self.quiet if quiet is None else quiet)

    def unknowns_of_fits(self, quiet: Expectation | None = None, stare: Stare | None = None) -> Nuisances | None:
        """Return the nuisance parameters of fits of flares, or None; `quiet` as for `unknowns`.

        The factor on all light has the mean and, unless the study states another, the standard deviation of what is
        drawn; those of a stare are of the stare. The documented set leaves the star's own level free as well.
        """
        import numpy as np

        from mauvecl.noise.scene import FactorDistributions

        quiet = self.quiet if quiet is None else quiet
        unknown, given = self.unknowns(quiet), self.study.nuisances.light
        if unknown is None or "light" not in unknown.names or given == "free":
            return unknown
        if given is None and "star" not in unknown.names:
            unknown = unknown.with_spectrum("star", quiet.net_source_dn, math.inf)
        if stare is not None:
            return unknown.without(["light"]) if given is None else unknown
        drawn = FactorDistributions.from_processes(self.processes, quiet)
        light = None if drawn is None else drawn.spreads.get("light")
        if light is None:
            return unknown.without(["light"]) if given is None else unknown
        if given is not None:
            return unknown.with_prior("light", light.mean - 1.0, given)
        unknown = unknown.with_prior("light", light.mean - 1.0, light.sd)
        if light.normal:
            return unknown
        return replace(unknown, factor_prior=np.array([(light.values - light.mean) / light.sd, light.weights]))

    def detect_options(self, quiet: Expectation | None = None) -> dict[str, Any]:
        """Return all arguments of `Engine.detect` except expectations and seed; `quiet` as for `unknowns`."""
        run = self.study.run
        how = {"realisations": run.realisations, "statistics": run.statistics, "tails": run.tails}
        return self.draw_options | how | {"nuisances": self.unknowns(quiet), "comparison": run.comparison()}

    def setting(self, quiet: Expectation, *flares: Expectation) -> Setting:
        """Return the input of statistics for closed forms."""
        from mauvecl.detection.statistics import Setting
        from mauvecl.noise.scene import FactorDistributions

        unknown = self.unknowns(quiet)
        drawn = FactorDistributions.from_processes(self.processes, quiet) if unknown else None
        return Setting(quiet, ~quiet.saturated, self.study.run.comparison(), flares, unknown, drawn)

    def with_value(self, quantity: str, value: float | str) -> Self:
        """Return the case at another value of a quantity of `quantities.QUANTITIES`."""
        return replace(self, study=self.study.at(quantity, value))

    def with_sections(self, **sections: Any) -> Self:
        """Return the case with other sections of the study, such as ``flare``."""
        case = replace(self, study=self.study.model_copy(update=sections))
        if sections.keys() <= WITHOUT_LIGHT:
            vars(case).update({name: vars(self)[name] for name in ("quiet", "flares") if name in vars(self)})
        return case

    def at_observed_brightness(self) -> Self:
        """Return the case with the amplitude at which the flare has the flux of its file at the telescope."""
        from mauvecl.host.stars.flare import added_light

        flare, star = self.study.flare, self.source
        light = added_light(
            star.wavelength_nm, star.flux_flam, spectrum=flare.light(), band=flare.band, geometry=flare.geometry,
            photosphere_temperature_k=flare.photosphere_temperature_k,
        )  # fmt: skip
        scaled = flare.spectrum.model_copy(update={"as_observed": False})
        return self.with_sections(flare=flare.model_copy(update={"amplitudes": (1.0 / light.hot,), "spectrum": scaled}))

    @cached_property
    def one_frame(self) -> Self:
        """The same case with an exposure of a single frame."""
        exposure = {"exposure_s": self.instrument.frame_s}
        return self.with_sections(observation=self.study.observation.model_copy(update=exposure))

    def flare_electrons(self, temperatures_k: NDArray[np.float64] | tuple[float, ...]) -> NDArray[np.float64]:
        """Return the electrons that flares of unit amplitude add to an exposure, shape (n_temperature, n_pixel).

        Raises InputError if some lines of the flare do not scale with its amplitude.
        """
        import numpy as np

        from mauvecl.host.stars.flare import check_scales

        check_scales(self.study.flare.light())
        # A flare that replaces photosphere is linear in its amplitude, but an amplitude of 1 may exceed the whole disc.
        unit = 1.0 if self.study.flare.geometry == "added" else 0.01
        flaring = self.expect(*(self.flaring(unit, float(k)) for k in temperatures_k))
        electrons = [(x.source_electrons - self.quiet.source_electrons) / unit for x in flaring]
        return np.reshape(electrons, (len(temperatures_k), self.quiet.wavelength_nm.size))

    @cached_property
    def stare(self) -> Stare:
        """The study's stare."""
        from mauvecl.study.stare_expectation import stare_of

        return stare_of(self.study, self.instrument)

    @cached_property
    def stare_expectation(self) -> StareExpectation:
        """Expectation of the stare at the star, with its flares."""
        from mauvecl.study.stare_expectation import expect_stare

        frame = self.one_frame
        return expect_stare(self.stare, self.events, frame.quiet, frame.flare_electrons)

    @cached_property
    def events(self) -> list[Event]:
        """Flares in the stare."""
        from mauvecl.study.stare_expectation import events_of

        return events_of(self.study, self.source)


def cases(study: Study, *, swept: bool = True) -> list[Case]:
    """Return the cases of a study: every star at every combination of sweep values, or at the study's own values."""
    loader = Loader()
    found = []
    for values in study.sweep.cells() if swept else ({},):
        cell = study.model_copy(update={"sweep": Sweep()})
        for quantity, value in values.items():
            cell = cell.at(quantity, value)
        stars = [Case(cell.model_copy(update={"star": (star,)}), values, loader) for star in cell.star]
        found += [case.at_observed_brightness() for case in stars] if cell.flare.spectrum.as_observed else stars
    return found
