"""Study sections for stares and the flares in them; `stare_expectation` converts them, and takes longer to import."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from mauvecl.flares.cooling import CoolingLaw
from mauvecl.flares.curves import Curve
from mauvecl.flares.defaults import ORBIT_S, SHAPE_NAMES, check_shape
from mauvecl.noise.disturbances import PointingDrifts
from mauvecl.noise.unknowns import COURSES, STARE_PROCESSES, Changing
from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Unit
from mauvecl.schema.physical import Amplitude, Duration, Energy, Positive, Temperature, Wavelength
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape

#: Orbital period rounded down to a multiple of the frame time, s.
ORBIT_FRAMES_S = 5680.0


Spreads = dict[Changing, Positive]
#: Shape of flares in stares and searches.
ShapeName = Annotated[str, Help("Shape of flares", choices=", ".join(SHAPE_NAMES)), Flag("--shape")]


class StareQuestion(Section):
    """Duration and gaps of a stare, known and unknown changes during it, and its flares unless `events` are given."""

    duration_s: Annotated[Duration, Help("Duration of the stare"), Flag("--duration")] = ORBIT_FRAMES_S
    gaps: Annotated[
        tuple[tuple[float, float], ...],
        Unit("s"),
        Help("Gap without recorded frames, from:to", "as in 1000:2000"),
        Flag("--gap", kind=list[str], read=parsing.gaps),
    ] = ()
    orbit_s: Annotated[Duration, Help("Orbital period")] = ORBIT_S
    orbit_gap_s: Annotated[float, Unit("s"), Range(0), Help("Gap at the end of every orbit"), Flag("--orbit-gap")] = 0.0
    along_orbit: Annotated[bool, Help("Whether detector temperature and sky follow the orbit of the section orbit")] = (
        False
    )
    thermal: Annotated[
        Curve | None,
        Help("Known change of the detector temperature, deg C"),
        Flag(
            "--thermal",
            kind=float,
            read=lambda half, _: {"amplitude": half},
            help=Help("Half the range of the known thermal cycle of the orbit, deg C", default="0"),
        ),
    ] = None
    variability: Annotated[Curve | None, Help("Known relative change of the star's light")] = None
    throughput: Annotated[Curve | None, Help("Known relative change of the throughput")] = None
    sky: Annotated[Curve | None, Help("Known relative change of the sky")] = None
    jitters: Annotated[Spreads, Help("Standard deviations of unknown changes that differ in each frame")] = Field(
        default_factory=dict
    )
    offsets: Annotated[Spreads, Help("Standard deviations of unknown constant changes")] = Field(default_factory=dict)
    drifts: Annotated[Spreads, Help("Standard deviations of unknown drifts per hour")] = Field(default_factory=dict)
    cycles: Annotated[Spreads, Help("Standard deviations of unknown cycles of the orbit")] = Field(default_factory=dict)
    pointing: Annotated[
        PointingDrifts | None,
        Help("Drifts out of the fibre, each ended by a re-acquisition, all of it assumed"),
        Flag(
            "--pointing-drifts",
            kind=float,
            read=lambda rate, _: {"rate_per_h": rate},
            help=Help("Drifts out of the fibre per hour, with assumed depth and duration", default="none"),
        ),
    ] = None
    number: Annotated[int, Range(0, 2**32 - 1), Help("Number of the drawn stare")] = 0
    half_width_s: Annotated[Duration, Help("Half-width of the flares"), Flag("--half-width")] = 60.0
    shape: ShapeName = "davenport2014"
    energies_erg: Annotated[
        tuple[Energy, ...], Help("Bolometric energy of a flare", "instead of amplitudes"), Flag("--energy")
    ] = ()
    search: Annotated[
        bool, Help("Search the stare for flares, as the section search says"), Flag("--search/--no-search")
    ] = True
    bands_nm: Annotated[tuple[tuple[Wavelength, Wavelength], ...], Help("Wavelength ranges of light curves")] = (
        (200.0, 300.0),
        (300.0, 400.0),
        (400.0, 550.0),
        (550.0, 700.0),
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        check_shape(self.shape)
        if self.orbit_gap_s >= self.orbit_s:
            raise InputError(
                f"stare.orbit_gap_s = {self.orbit_gap_s:g} of an orbit of {self.orbit_s:g} s",
                "a shorter gap",
                key="orbit_gap_s",
                value=self.orbit_gap_s,
            )
        for low, high in self.bands_nm:
            if not 0 < low < high:
                raise InputError.of("stare.bands_nm", (low, high), "ascending wavelengths", unit="nm")
        return self

    @property
    def has_unknowns(self) -> bool:
        """True if the stare has unknown changes."""
        return any(getattr(self, name) for name in (*COURSES, *STARE_PROCESSES))

    def all_gaps(self) -> list[tuple[float, float]]:
        """Return the given gaps and the gap at the end of every orbit."""
        every = [*self.gaps]
        if self.orbit_gap_s:
            orbits = math.ceil(self.duration_s / self.orbit_s)
            every += [((n + 1) * self.orbit_s - self.orbit_gap_s, (n + 1) * self.orbit_s) for n in range(orbits)]
        return every


class EventChoice(Section):
    """A flare of a study, with one of several measures of size; other values are the study's by default.

    At most one of `amplitude`, `peak`, `equivalent_duration_s` and `energy_erg` is given. The flare that follows, an
    `Event`, depends on the case: an energy needs the star's size, and sweeps change the study's values.
    """

    peak_s: Annotated[float, Unit("s"), Help("Time of the peak after the start of the stare")]
    half_width_s: Annotated[Duration | None, Help("Half-width of the shape", default="the stare's")] = None
    amplitude: Annotated[Amplitude | None, Help("Amplitude of the shape", default="the flare's")] = None
    peak: Annotated[Amplitude | None, Help("Maximum of the shape, instead of its amplitude")] = None
    equivalent_duration_s: Annotated[Duration | None, Help("Equivalent duration, instead of an amplitude")] = None
    energy_erg: Annotated[Energy | None, Help("Energy, instead of an amplitude")] = None
    energy: Annotated[Literal["bolometric", "band"], Help("Meaning of the energy")] = "bolometric"
    temperature_k: Annotated[Temperature | None, Help("Temperature", default="the flare's")] = None
    cooling: Annotated[CoolingLaw | None, Help("Exponential cooling from that temperature")] = None
    shape: Annotated[str | None, Help("Shape", default="the stare's", choices=", ".join(SHAPE_NAMES))] = None
    shape_file: Annotated[Path | None, Help("File of a shape with two columns, time in half-widths and value")] = None

    @model_validator(mode="after")
    def _one_size(self) -> Self:
        sizes = ("amplitude", "peak", "equivalent_duration_s", "energy_erg")
        given = [name for name in sizes if getattr(self, name) is not None]
        if len(given) > 1:
            raise InputError(
                f"an event has {' and '.join(given)}", "one of them", key=given[0], value=getattr(self, given[0])
            )
        if self.shape is not None and self.shape_file is not None:
            raise InputError("an event has both shape and shape_file", "one of them", key="shape", value=self.shape)
        if self.shape is not None:
            check_shape(self.shape)
        return self

    def load_shape(self, default: str) -> Shape:
        """Return the shape, or the published shape named `default` if none is given."""
        from mauvecl.flares.shapes import TableShape, shape_of
        from mauvecl.host.tables.text_lines import read_columns
        from mauvecl.schema.text import shortened

        if self.shape_file is None:
            return shape_of(self.shape or default)
        columns = read_columns("flare shape", "values", self.shape_file)
        return TableShape(columns[:, 0], columns[:, 1], self.shape_file.stem, shortened(self.shape_file.name))
