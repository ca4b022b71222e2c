"""Study sections of questions: runs, sweeps, maps and limits, and the quantities that they vary."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import Field, model_validator

from mauvecl.schema.errors import InputError, shown
from mauvecl.schema.fields import Accepted, Flag, Help, Quantity, Range, Slider, Unit, first
from mauvecl.schema.physical import Positive, Probability, Wavelength
from mauvecl.schema.section import Section, check_different, check_needs, fields_of, read_axis, read_frames, setting
from mauvecl.study.observation import Observation, SkyLight
from mauvecl.study.star import Flare, Star

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mauvecl.study.stare import EventChoice, StareQuestion


#: Quantities that vary, by name, with the unit and range of their fields.
QUANTITIES = {
    one.name: replace(one, path=path, unit=(first(field, Unit) or Unit("")).name, range=first(field, Range))
    for name, section in (("star", Star), ("flare", Flare), ("observation", Observation), ("sky", SkyLight))
    for path, field in fields_of(section, (name,))
    if (one := first(field, Quantity)) is not None
}
if TYPE_CHECKING:
    QuantityName = str
else:
    QuantityName = Literal[tuple(QUANTITIES)]

#: Largest number of combinations of a sweep; each has its own expectations.
MAX_CELLS = 100_000


class CampaignQuestion(Section):
    """Number of tests of a search, and the false alarms that the whole search may have."""

    frames: Annotated[int, Range(1)] | None = setting(
        None, "Frames of a whole search; shows what one test means for all of it", flag="--campaign"
    )
    step: Annotated[int, Range(1)] | None = setting(
        None, "Frames from one stack of the search to the next", flag="--campaign-step", usual="a stack"
    )
    fap: Probability | None = setting(
        None,
        "Wanted probability of any false alarm in the search; shows what each test may have",
        flag="--campaign-fap",
    )
    alarms: Positive | None = setting(
        None, "Wanted number of false alarms in the search; shows what each test may have", flag="--campaign-alarms"
    )

    def _check_values(self) -> None:
        check_needs(self, "the campaign", ("step", "fap", "alarms"), "frames")


class SignalQuestion(Section):
    """S/N that an exposure must reach."""

    snr: Positive | None = setting(None, "Wanted signal-to-noise ratio", flag="--snr")
    wavelength_nm: Wavelength | None = setting(None, "Wavelength", flag="--at")
    per: Literal["element", "pixel"] = setting(
        "element", "Bin of the S/N", flag="--per", choices="element (10.5 nm) or pixel"
    )


class BulkQuestion(Section):
    """Data stored per realisation: the summed exposure or single frames, and optionally the mean components."""

    frames: Annotated[
        Literal["stack", "all"] | Annotated[tuple[Annotated[int, Range(0)], ...], Field(min_length=1)],
        Accepted("stack, all, or numbers of frames"),
    ] = setting(
        "stack",
        "Stored frames",
        flag=Flag("--frames", kind=str, read=read_frames),
        choices="stack (the sum of an exposure), all, or numbers of frames such as 0,4,9",
    )
    components: bool = setting(False, "Also store the mean of star, sky and noise of each pixel", flag="--components")

    def _check_values(self) -> None:
        if not isinstance(self.frames, str) and list(self.frames) != sorted(set(self.frames)):
            raise InputError.of("bulk.frames", list(self.frames), "ascending numbers")

    def chosen(self, n_frames: int) -> tuple[int, ...] | None:
        """Return the indices of the frames to store, or None to store their sum."""
        if self.frames == "stack":
            return None
        if isinstance(self.frames, str):
            return tuple(range(n_frames))
        if self.frames[-1] >= n_frames:
            raise InputError.of("bulk.frames", self.frames[-1], f"between 0 and {n_frames - 1}")
        return self.frames


class LimitQuestion(Section):
    """Quantity whose limit is computed, and the detection probability at the limit."""

    of: Literal["magnitude", "amplitude", "exposure"] = setting(
        "magnitude",
        "Quantity whose limit is computed",
        flag="--of",
        label="Solve for",
        hint="The smallest flare, the faintest star or the shortest exposure that is detected with the wanted "
        "probability; all else is as entered. The tab Limit and map simulates it.",
        first="amplitude",
    )
    power: Probability = setting(
        0.9,
        "Wanted detection probability",
        flag="--power",
        label="Wanted probability",
        hint="With which a flare is to be detected at the limit.",
        group="Detection",
        slider=Slider(0.5, 0.99, 0.01),
    )


def _wrong_value(quantity: Quantity, text: str) -> InputError:
    accepted = "a name of the library" if quantity.range is None else quantity.range.words(quantity.unit)
    return InputError(f"a value of the axis {quantity.name!r} must be {accepted}, not {text}", key="values")


Number = Annotated[float, Range()]
NumberOrName = Annotated[float | str, Accepted("a number or a name")]


class Axis(Section):
    """Axis of a map or sweep: explicit values, or `steps` values from `start` to `stop`."""

    quantity: Annotated[QuantityName, Help("Quantity that varies")]
    values: tuple[NumberOrName, ...] | None = setting(None, "Values")
    start: Number | None = setting(None, "First of evenly spaced values")
    stop: Number | None = setting(None, "Last of evenly spaced values")
    steps: Annotated[int, Range(2, 1000)] | None = setting(None, "Number of evenly spaced values")
    log: bool = setting(False, "Whether values are evenly spaced in the logarithm")

    @model_validator(mode="before")
    @classmethod
    def _without_units(cls, given: Any) -> Any:
        """Convert values with a unit, such as "10 min", to the unit of the quantity."""
        quantity = QUANTITIES.get(str(given.get("quantity"))) if isinstance(given, dict) else None
        if quantity is None or quantity.range is None:
            return given
        keys = [key for key in ("values", "start", "stop") if key in given]
        try:
            return given | {key: Unit(quantity.unit).plain(given[key]) for key in keys}
        except ValueError as error:
            raise _wrong_value(quantity, str(error)) from error

    def _check_values(self) -> None:
        spaced = (self.start, self.stop, self.steps)
        if (self.values is None) == (None in spaced) or (self.values is not None and spaced != (None, None, None)):
            raise InputError(
                f"the axis {self.quantity!r} needs either values or start, stop and steps, but has neither or both",
                key="values",
            )
        if self.values is not None and len(self.values) == 0:
            raise InputError(f"the axis {self.quantity!r} needs at least one value, but has none", key="values")
        quantity = QUANTITIES[self.quantity]
        for value in self.points():
            if isinstance(value, str) != (quantity.range is None) or (quantity.range and value not in quantity.range):
                raise _wrong_value(quantity, shown(value))

    def points(self) -> tuple[float | str, ...]:
        """Return the values along the axis."""
        if self.values is not None:
            return self.values
        start, stop, steps = cast("tuple[float, float, int]", (self.start, self.stop, self.steps))
        share = [i / (steps - 1) for i in range(steps)]
        if not self.log:
            return tuple(start + (stop - start) * s for s in share)
        if min(start, stop) <= 0:
            raise InputError(
                f"the logarithmic axis {self.quantity!r} needs values above 0, but runs from {start:g} to {stop:g}",
                key="start",
            )
        return tuple(start * (stop / start) ** s for s in share)


class MapQuestion(Section):
    """Axes and contour levels of a map of the detection probability."""

    x: Axis | None = setting(
        None,
        "Horizontal axis of the map; such as magnitude:4:10:16, or exposure=5,50,600",
        flag=Flag("--x", kind=str, read=read_axis),
        usual="the magnitudes over which the flares are lost",
    )
    y: Axis = setting(
        Axis(quantity="amplitude", start=0.01, stop=1.0, steps=16, log=True),
        "Vertical axis of the map; such as amplitude:0.01:1:16:log",
        flag=Flag("--y", kind=str, read=read_axis),
    )
    contours: tuple[Probability, ...] = setting((0.1, 0.5, 0.9), "Detection probabilities of contours")

    def _check_values(self) -> None:
        if self.y.quantity == ("magnitude" if self.x is None else self.x.quantity):
            raise InputError(
                f"the axes of the map must be two different quantities, but both are {self.y.quantity!r}", key="y"
            )

    @property
    def axes(self) -> tuple[Axis, Axis]:
        """The horizontal and the vertical axis of a map that has been computed."""
        assert self.x is not None
        return self.x, self.y


class Sweep(Section):
    """Quantities that take several values, in all combinations ("product") or in parallel ("list")."""

    how: Literal["product", "list"] = setting(
        "product",
        "Every combination of the values, or one after the other",
        flag=Flag(
            "--as-list",
            kind=bool,
            read=lambda wanted, _: "list" if wanted else None,
            help=Help("Vary the quantities of a sweep together instead of in every combination"),
        ),
    )
    axes: tuple[Axis, ...] = setting(
        (),
        "Values of a quantity; as in exposure=5,50,600 or magnitude:4:10:7; several give every combination",
        flag=Flag("--sweep", kind=list[str], read=lambda texts, name: [read_axis(text, name) for text in texts]),
    )

    def _check_values(self) -> None:
        check_different([axis.quantity for axis in self.axes], "the sweep's quantity", "axes")
        lengths = {axis.quantity: len(axis.points()) for axis in self.axes}
        if self.how == "list" and len(set(lengths.values())) > 1:
            counts = ", ".join(f"{n} of {name}" for name, n in lengths.items())
            raise InputError(
                f"the sweep is a list, whose axes must have equally many values, but it has {counts}", key="axes"
            )
        if self.size > MAX_CELLS:
            raise InputError(f"the sweep must have at most {MAX_CELLS} combinations, but has {self.size}", key="axes")

    @property
    def size(self) -> int:
        """Number of cells."""
        lengths = [len(axis.points()) for axis in self.axes]
        return max(lengths, default=1) if self.how == "list" else math.prod(lengths)

    def cells(self) -> list[dict[str, float | str]]:
        """Return the values of each cell; without axes, a single empty cell."""
        values = [axis.points() for axis in self.axes]
        together = zip(*values, strict=True) if self.how == "list" and values else itertools.product(*values)
        return [{a.quantity: v for a, v in zip(self.axes, cell, strict=True)} for cell in together]


def formula_grid(*, magnitude: bool = True, exposure_s: float | None = None) -> Sweep:
    """Return the default sweep of `gaussian`, over magnitudes and over exposures, or at a given exposure."""
    axes = [Axis(quantity="magnitude", values=(4.0, 6.0, 8.0, 10.0, 12.0))] if magnitude else []
    exposures = (5.0, 50.0, 600.0) if exposure_s is None else (exposure_s,)
    return Sweep(axes=(*axes, Axis(quantity="exposure", values=exposures)))


def check_sweep(sweep: Sweep, stare: StareQuestion, events: Sequence[EventChoice]) -> None:
    """Raise InputError if a swept quantity has no effect on the stare."""
    fixed = {
        "exposure": True,
        "amplitude": all(event.sizes for event in events) if events else bool(stare.energies_erg),
        "flare_temperature": bool(events) and all(event.temperature_k is not None for event in events),
    }
    for axis in sweep.axes:
        if fixed.get(axis.quantity):
            raise InputError(
                f"a sweep over {axis.quantity.replace('_', ' ')} changes no flare of this stare; "
                "give a quantity that [stare] and [[events]] do not fix",
                key="sweep",
            )
