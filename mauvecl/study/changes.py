"""Study section for changes between visits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import Field, model_validator

from mauvecl.host.stars.band_names import ALIASES
from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Slider, Unit, Widget
from mauvecl.schema.physical import Positive
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

#: Changes by default: the indices of the four lines, the Balmer jump, two bands and the colour.
DEFAULT_CHANGES = ("Mg II", "Ca II", "H beta", "H alpha", "balmer jump", "200-320", "320-700", "colour")
#: Name of the change that adds the light of `change.file`.
SPECTRUM = "spectrum"
Days = Annotated[Positive, Unit("d")]


class ChangeQuestion(Section):
    """Changes of a star between visits, and periods in them."""

    of: Annotated[
        tuple[str, ...],
        Field(min_length=1),
        Help("Change", choices="a line such as Mg II, balmer jump, colour, a band in nm such as 200-320, or spectrum"),
        Flag("--change", kind=list[str], read=parsing.words),
        Widget(
            label="Changes",
            hint="What changes, with commas: lines such as Mg II or 656.5 (nm), balmer jump, colour, and bands such as "
            "200-320 (nm).",
            group="Change",
            name="changes",
            first=", ".join(DEFAULT_CHANGES),
        ),
    ] = DEFAULT_CHANGES
    file: Annotated[
        Path | None,
        Help("Spectrum that the change adds", "as an accretion excess or a companion"),
        Flag("--change-file"),
        Widget(
            label="Added spectrum",
            hint="Light that a change adds to the star, such as an accretion excess or a companion: the change "
            "“spectrum”.",
            group="Change",
            name="change_file",
            place=1,
            kind="file",
        ),
    ] = None
    band: Annotated[
        str,
        Help("Band in which the light of that spectrum is measured", choices=", ".join(ALIASES)),
        Flag("--change-band"),
        Widget(
            label="Band of the added light",
            hint="The smallest change is the light of the added spectrum in this band over that of the star.",
            group="Added spectrum",
            name="change_band",
            choices=tuple(ALIASES),
        ),
    ] = "V"
    wavelength_unit: Annotated[
        str | None,
        Help("Unit of the wavelengths of that spectrum"),
        Flag("--change-wavelength-unit"),
        Widget(
            label="Added: unit of wavelengths",
            hint="Such as Angstrom or Angstrom air. Nothing: what the file says.",
            group="Added spectrum",
            name="change_wavelength_unit",
            suggestions=("nm", "Angstrom", "um", "nm air", "Angstrom air"),
        ),
    ] = None
    flux_unit: Annotated[
        str | None,
        Help("Unit of the fluxes of that spectrum"),
        Flag("--change-flux-unit"),
        Widget(
            label="Added: unit of fluxes",
            hint="Such as W m-2 nm-1 or Jy. Nothing: what the file says.",
            group="Added spectrum",
            name="change_flux_unit",
            suggestions=("erg s-1 cm-2 Angstrom-1", "W m-2 nm-1", "Jy"),
        ),
    ] = None
    extend: Annotated[
        str | None,
        Help("Library spectrum that continues that spectrum beyond its end"),
        Flag("--change-extend"),
        Widget(
            label="Added: continue with",
            hint="Library spectrum that continues the added one beyond its end, such as M3V, scaled to match at the "
            "join. Nothing: it must cover what the instrument sees.",
            group="Added spectrum",
            name="change_extend",
            kind="library",
        ),
    ] = None
    visits: Annotated[
        int,
        Range(2, 10_000),
        Help("Visits that are compared"),
        Flag("--visits"),
        Widget(
            label="Visits",
            hint="How many exposures of the star are compared with each other.",
            group="Change",
            first="20",
            slider=Slider(2, 100, 1),
        ),
    ] = 2
    periods: Annotated[
        bool, Help("Map which periods are recovered, from visits to the first target of the orbit"), Flag("--periods")
    ] = False
    shortest_d: Annotated[
        Days,
        Help("Shortest period"),
        Flag("--shortest-period"),
        Widget(
            label="Shortest period",
            hint="The first period of the map.",
            group="Change",
            slider=Slider(0.1, 10, 1.1, log=True),
        ),
    ] = 1.0
    longest_d: Annotated[
        Days,
        Help("Longest period"),
        Flag("--longest-period"),
        Widget(
            label="Longest period",
            hint="The last period of the map.",
            group="Change",
            slider=Slider(2, 200, 1.1, log=True),
        ),
    ] = 30.0
    steps: Annotated[int, Range(2, 50), Help("Periods and amplitudes of the map, each")] = 6
    period_fap: Annotated[
        Annotated[float, Range(1e-3, 0.5)], Help("Probability of a peak of noise anywhere in a periodogram")
    ] = 0.01
    trials: Annotated[int, Range(10, 10_000), Help("Simulated sinusoids in each cell of the map"), Flag("--trials")] = (
        50
    )

    def light(self) -> Source | None:
        """Read the spectrum that the change adds; None without a file."""
        from mauvecl.host.stars.source import Source

        if self.file is None:
            return None
        return Source.read(
            self.file, wavelength_unit=self.wavelength_unit, flux_unit=self.flux_unit, extend=self.extend
        )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.shortest_d < self.longest_d:
            raise InputError.of("change.longest_d", self.longest_d, f"more than {self.shortest_d:g} d", unit="d")
        if self.file is None:
            if SPECTRUM in self.of:
                raise InputError("the change 'spectrum' has no file", "`change.file`", key="change.file")
            for key in ("wavelength_unit", "flux_unit", "extend"):
                if value := getattr(self, key):
                    raise InputError.of(f"change.{key}", value, "change.file as well")
        elif SPECTRUM not in self.of:
            raise InputError.of("change.file", str(self.file), "the change 'spectrum' in change.of as well")
        return self
