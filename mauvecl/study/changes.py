"""Study section for changes between visits."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Slider, Unit, Widget
from mauvecl.schema.physical import Positive
from mauvecl.schema.section import Section

#: Changes by default: the indices of the four lines, the Balmer jump, two bands and the colour.
DEFAULT_CHANGES = ("Mg II", "Ca II", "H beta", "H alpha", "balmer jump", "200-320", "320-700", "colour")
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
    ] = None
    band: Annotated[str, Help("Band in which the light of that spectrum is measured")] = "V"
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

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.shortest_d < self.longest_d:
            raise InputError.of("change.longest_d", self.longest_d, f"more than {self.shortest_d:g} d", unit="d")
        if "spectrum" in self.of and self.file is None:
            raise InputError("the change 'spectrum' has no file", "`change.file`", key="change.file")
        return self
