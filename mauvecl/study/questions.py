"""Study sections for campaigns, S/N, raw frames, limits, maps and sweeps."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from mauvecl.schema.errors import InputError
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.sections import Section

if TYPE_CHECKING:
    QuantityName = str
else:
    QuantityName = Literal[tuple(QUANTITIES)]

#: Largest number of combinations of a sweep; each has its own expectations.
MAX_CELLS = 100_000


class CampaignQuestion(Section):
    """Number of tests of a search, and the false alarms that the whole search may have."""

    frames: Annotated[int, Field(ge=1)] | None = None  # in total
    step: Annotated[int, Field(ge=1)] | None = None  # frames between the starts of consecutive stacks
    fap: Annotated[float, Field(gt=0, lt=1)] | None = None  # probability of at least one false alarm
    alarms: Annotated[float, Field(gt=0)] | None = None  # expected number of false alarms

    @model_validator(mode="after")
    def _requires_frames(self) -> Self:
        given = next((name for name in ("step", "fap", "alarms") if getattr(self, name) is not None), None)
        if given is not None and self.frames is None:
            raise InputError(
                f"campaign.{given} is given without campaign.frames",
                "the number of frames that are searched",
                key=given,
                value=getattr(self, given),
            )
        return self


class SignalQuestion(Section):
    """S/N that an exposure must reach."""

    snr: Annotated[float, Field(gt=0)] | None = None
    wavelength_nm: float | None = None
    per: Literal["element", "pixel"] = "element"


class BulkQuestion(Section):
    """Data stored per realisation: the summed exposure or single frames, and optionally the mean components."""

    frames: Literal["stack", "all"] | Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = "stack"
    components: bool = False

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if not isinstance(self.frames, str) and list(self.frames) != sorted(set(self.frames)):
            raise InputError.of("bulk.frames", list(self.frames), "ascending numbers")
        return self

    def chosen(self, n_frames: int) -> tuple[int, ...] | None:
        """Return the indices of the frames to store, or None to store their sum."""
        if self.frames == "stack":
            return None
        if isinstance(self.frames, str):
            return tuple(range(n_frames))
        if self.frames[-1] >= n_frames:
            raise InputError.of("bulk.frames", self.frames[-1], f"0 to {n_frames - 1}")
        return self.frames


class LimitQuestion(Section):
    """Quantity whose limit is computed, and the detection probability at the limit."""

    of: Literal["magnitude", "amplitude", "exposure"] = "magnitude"
    power: Annotated[float, Field(gt=0, lt=1)] = 0.9


class Axis(Section):
    """Axis of a map or sweep: explicit values, or `steps` values from `start` to `stop`."""

    quantity: QuantityName
    values: tuple[float | str, ...] | None = None
    start: float | None = None
    stop: float | None = None
    steps: Annotated[int, Field(ge=2, le=1000)] | None = None
    log: bool = False

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        spaced = (self.start, self.stop, self.steps)
        if (self.values is None) == (None in spaced) or (self.values is not None and spaced != (None, None, None)):
            raise InputError(
                f"the axis {self.quantity!r} has neither or both of values and start, stop, steps",
                "one of them",
                key="values",
                value=self.values,
            )
        if self.values is not None and len(self.values) == 0:
            raise InputError(f"the axis {self.quantity!r} has no values", "some", key="values", value=self.values)
        quantity = QUANTITIES[self.quantity]
        for value in self.points():
            if quantity.is_name != isinstance(value, str):
                expected = "names of the library" if quantity.is_name else "numbers"
                raise InputError(
                    f"the axis {self.quantity!r} has the value {value!r}", expected, key="values", value=value
                )
            if not isinstance(value, str) and value not in quantity.range:
                raise InputError(
                    f"the axis {self.quantity!r} reaches {value:g}",
                    quantity.range.words(quantity.unit),
                    key="values",
                    value=value,
                )
        return self

    def points(self) -> tuple[float | str, ...]:
        """Return the values along the axis."""
        if self.values is not None:
            return self.values
        assert self.start is not None
        assert self.stop is not None
        assert self.steps is not None
        if self.log and min(self.start, self.stop) <= 0:
            raise InputError(
                f"the logarithmic axis {self.quantity!r} runs from {self.start:g} to {self.stop:g}",
                "values above 0",
                key="start",
                value=(self.start, self.stop),
            )
        share = [i / (self.steps - 1) for i in range(self.steps)]
        if self.log:
            return tuple(self.start * (self.stop / self.start) ** s for s in share)
        return tuple(self.start + (self.stop - self.start) * s for s in share)


class MapQuestion(Section):
    """Axes and contour levels of a map of the detection probability."""

    x: Axis = Axis(quantity="magnitude", start=4.0, stop=10.0, steps=16)
    y: Axis = Axis(quantity="amplitude", start=0.01, stop=1.0, steps=16, log=True)
    contours: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = (0.1, 0.5, 0.9)

    @model_validator(mode="after")
    def _different_axes(self) -> Self:
        if self.x.quantity == self.y.quantity:
            raise InputError(
                f"both axes of the map are {self.x.quantity!r}", "two quantities", key="y", value=self.y.quantity
            )
        return self


class Sweep(Section):
    """Quantities that take several values, in all combinations ("product") or in parallel ("list")."""

    how: Literal["product", "list"] = "product"
    axes: tuple[Axis, ...] = ()

    @model_validator(mode="after")
    def _possible(self) -> Self:
        names = [axis.quantity for axis in self.axes]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"the sweep has the quantity {twice!r} twice", "different ones", key="axes", value=twice)
        lengths = {axis.quantity: len(axis.points()) for axis in self.axes}
        if self.how == "list" and len(set(lengths.values())) > 1:
            counts = ", ".join(f"{n} of {name}" for name, n in lengths.items())
            raise InputError(f"the sweep is a list of {counts}", "equal numbers of values", key="axes", value=counts)
        if self.size > MAX_CELLS:
            raise InputError(
                f"the sweep has {self.size} combinations", f"at most {MAX_CELLS}", key="axes", value=self.size
            )
        return self

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
