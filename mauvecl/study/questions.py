"""Study sections of questions: sweeps, maps and limits with their quantities, measurements, calibrations, changes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import Field, model_validator

from mauvecl.host.stars.library import ALIASES
from mauvecl.schema import fields, section
from mauvecl.schema.errors import InputError, shown
from mauvecl.schema.fields import Accepted, Flag, Help, Quantity, Range, Slider, Unit, first
from mauvecl.schema.section import Section, read_axis, setting
from mauvecl.study.observation import Observation, SkyLight
from mauvecl.study.star import Flare, Star, unit_of_file
from mauvecl.study.stare import SIZES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mauvecl.host.stars.source import Source
    from mauvecl.study.stare import EventChoice, StareQuestion


#: Quantities that vary, by name, with the unit and range of their fields.
QUANTITIES = {
    quantity.name: replace(quantity, path=path, unit=(first(field, Unit) or Unit("")).name, range=first(field, Range))
    for name, kind in (("star", Star), ("flare", Flare), ("observation", Observation), ("sky", SkyLight))
    for path, field in section.fields_of(kind, (name,))
    if (quantity := first(field, Quantity)) is not None
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
    fap: fields.Probability | None = setting(
        None,
        "Wanted probability of any false alarm in the search; shows what each test may have",
        flag="--campaign-fap",
    )
    alarms: fields.Positive | None = setting(
        None, "Wanted number of false alarms in the search; shows what each test may have", flag="--campaign-alarms"
    )

    def _check_values(self) -> None:
        section.check_needs(self, "the campaign", ("step", "fap", "alarms"), "frames")


class SignalQuestion(Section):
    """S/N that an exposure must reach."""

    snr: fields.Positive | None = setting(None, "Wanted signal-to-noise ratio", flag="--snr")
    wavelength_nm: fields.Wavelength | None = setting(None, "Wavelength", flag="--at")
    per: Literal["element", "pixel"] = setting(
        "element", "Bin of the S/N", flag="--per", choices="element (resolution element, 10.5 nm for Mauve) or pixel"
    )


class BulkQuestion(Section):
    """Data stored per realisation: the summed exposure or single frames, and optionally the mean components."""

    frames: Annotated[
        Literal["stack", "all"] | Annotated[tuple[Annotated[int, Range(0)], ...], Field(min_length=1)],
        Accepted("stack, all, or numbers of frames"),
    ] = setting(
        "stack",
        "Stored frames",
        flag=Flag("--frames", kind=str, read=section.read_frame_choice),
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
    power: fields.Probability = setting(
        0.9,
        "Wanted detection probability",
        flag="--power",
        label="Wanted probability",
        hint="With which a flare is to be detected at the limit.",
        slider=Slider(0.5, 0.99, 0.01),
    )


def _wrong_value(quantity: Quantity, text: str) -> InputError:
    accepted = "a name of the library" if quantity.range is None else quantity.range.words(quantity.unit)
    return InputError(f"a value of the axis {quantity.name!r} must be {accepted}, not {text}", key="values")


NumberOrName = Annotated[fields.Number | str, Accepted("a number or a name")]


class Axis(Section):
    """Axis of a map or sweep: explicit values, or `steps` values from `start` to `stop`."""

    quantity: Annotated[QuantityName, Help("Quantity that varies")]
    values: tuple[NumberOrName, ...] | None = setting(None, "Values")
    start: fields.Number | None = setting(None, "First of evenly spaced values")
    stop: fields.Number | None = setting(None, "Last of evenly spaced values")
    steps: Annotated[int, Range(2, 1000)] | None = setting(None, "Number of evenly spaced values")
    log: bool = setting(False, "Whether values are evenly spaced in the logarithm")

    @model_validator(mode="before")
    @classmethod
    def _without_units(cls, data: Any) -> Any:
        """Convert values with a unit, such as "10 min", to the unit of the quantity."""
        quantity = QUANTITIES.get(str(data.get("quantity"))) if isinstance(data, dict) else None
        if quantity is None or quantity.range is None:
            return data
        keys = [key for key in ("values", "start", "stop") if key in data]
        try:
            return data | {key: Unit(quantity.unit).plain(data[key]) for key in keys}
        except ValueError as error:
            raise _wrong_value(quantity, str(error)) from error

    def _check_values(self) -> None:
        spaced = (self.start, self.stop, self.steps)
        if (self.values is None) == (None in spaced) or (self.values is not None and spaced != (None, None, None)):
            fault = f"the axis {self.quantity!r} needs either values or start, stop and steps, but has neither or both"
            raise InputError(fault, key="values")
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
        # The last value is exact, since rounding could put it out of the quantity's range.
        shares = [i / (steps - 1) for i in range(steps - 1)]
        if not self.log:
            return (*(start + (stop - start) * share for share in shares), stop)
        if min(start, stop) <= 0:
            fault = f"the logarithmic axis {self.quantity!r} needs values above 0, but runs from {start:g} to {stop:g}"
            raise InputError(fault, key="start")
        return (*(start * (stop / start) ** share for share in shares), stop)


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
    contours: tuple[fields.Probability, ...] = setting((0.1, 0.5, 0.9), "Detection probabilities of contours")

    def _check_values(self) -> None:
        if self.y.quantity == ("magnitude" if self.x is None else self.x.quantity):
            fault = f"the axes of the map must be two different quantities, but both are {self.y.quantity!r}"
            raise InputError(fault, key="y")

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
            read=lambda is_set, _: "list" if is_set else None,
            help=Help("Vary the quantities of a sweep together instead of in every combination"),
        ),
    )
    axes: tuple[Axis, ...] = setting(
        (),
        "Values of a quantity; as in exposure=5,50,600 or magnitude:4:10:7; several give every combination",
        flag=Flag("--sweep", kind=list[str], read=lambda texts, name: [read_axis(text, name) for text in texts]),
    )

    def _check_values(self) -> None:
        section.check_different([axis.quantity for axis in self.axes], "the sweep's quantity", "axes")
        lengths = {axis.quantity: len(axis.points()) for axis in self.axes}
        if self.how == "list" and len(set(lengths.values())) > 1:
            counts = ", ".join(f"{n} of {name}" for name, n in lengths.items())
            fault = f"the sweep is a list, whose axes must have equally many values, but it has {counts}"
            raise InputError(fault, key="axes")
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


def check_sweep(sweep: Sweep, stare: StareQuestion, events: Sequence[EventChoice]) -> None:
    """Raise InputError if a swept quantity has no effect on the stare."""
    fixed = {
        "exposure": True,
        "amplitude": all(section.given_keys(event, SIZES) for event in events) if events else bool(stare.energies_erg),
        "flare_temperature": bool(events) and all(event.temperature_k is not None for event in events),
    }
    for axis in sweep.axes:
        if fixed.get(axis.quantity):
            fault = f"a sweep over {axis.quantity.replace('_', ' ')} changes no flare of this stare"
            raise InputError(f"{fault}; give a quantity that [stare] and [[events]] do not fix", key="sweep")


class CalibrationObservation(Section):
    """Raw frames of a standard star, or of no light if neither `library` nor `spectrum` is given."""

    frames: Annotated[Path, Help("File of raw frames, DN with bias and dark")]
    mapping: Path | None = setting(None, "Where time, flux and temperature are in that file (TOML)")
    library: str | None = setting(None, "Name of the standard star in the library")
    spectrum: Path | None = setting(None, "File with the spectrum of the standard star, such as CALSPEC's")
    magnitude: fields.Magnitude | None = setting(None, "Magnitude", usual="that of the spectrum")
    band: str = setting("V", "Band of the magnitude")
    temperature_c: fields.DetectorTemperature | None = setting(
        None, "Detector temperature, where the frames do not state it"
    )

    def _check_values(self) -> None:
        section.check_one(self, "an observation", "spectrum", "library")
        if self.magnitude is not None and self.library is None and self.spectrum is None:
            raise InputError("a magnitude needs the library or spectrum of the star as well", key="magnitude")

    def source(self) -> Source | None:
        """Load the spectrum of the star at its brightness; None for frames without light."""
        if self.library is None and self.spectrum is None:
            return None
        return Star(library=self.library, file=self.spectrum, magnitude=self.magnitude, band=self.band).source()


#: Keys of an observation that hold paths.
PATHS = tuple(
    name for name, field in CalibrationObservation.model_fields.items() if field.annotation in (Path, Path | None)
)


class CalibrateQuestion(Section):
    """Observations from which `calibrate` fits an instrument."""

    observations: tuple[CalibrationObservation, ...] = setting(
        (),
        "Observations of standard stars and of no light",
        label="Observations",
        hint="A zip archive: a TOML file with [[calibrate.observations]], as for the command line, and the frames, "
        "mappings and spectra that it names.",
        kind="upload",
    )
    knots: Annotated[int, Range(4, 200)] = setting(
        100,
        "Intervals of the spline of the throughput",
        flag="--knots",
        label="Intervals of the throughput",
        hint="Intervals of the spline that describes the throughput: more of them follow narrower features, with "
        "larger errors.",
    )
    light_error: Annotated[float, Range(0, 1)] = setting(
        0.0,
        "Relative error of the light of an observation, by pointing",
        flag="--light-error",
        label="Error of the light",
        hint="By how much the light of an observation differs, by pointing.",
        unit="%",
    )
    spectrum_error: Annotated[float, Range(0, 1)] | None = setting(
        None,
        "Relative error of the spectra of the stars, at each of 12 wavelengths",
        flag="--spectrum-error",
        usual="0.1 for one star, fitted for several if they disagree",
        label="Error of the spectra",
        hint="Error of the stars' spectra, at each of 12 wavelengths. Empty: 10 % for one star, fitted if several "
        "disagree.",
        unit="%",
    )


#: Changes by default: the indices of the four lines, the Balmer jump, two bands and the colour.
DEFAULT_CHANGES = ("Mg II", "Ca II", "H beta", "H alpha", "balmer jump", "200-320", "320-700", "colour")
#: Name of the change that adds the light of `change.file`.
SPECTRUM = "spectrum"


class ChangeQuestion(Section):
    """Changes of a star between visits, and periods in them."""

    of: tuple[str, ...] = setting(
        DEFAULT_CHANGES,
        "Change",
        min_length=1,
        flag=Flag("--change", kind=list[str], read=section.read_words),
        choices="a line such as Mg II, balmer jump, colour, a band in nm such as 200-320, or spectrum",
        label="Changes",
        hint="What changes, with commas: lines such as Mg II or 656.5 (nm), balmer jump, colour, and bands such as "
        "200-320 (nm).",
        name="changes",
        first=", ".join(DEFAULT_CHANGES),
    )
    file: Path | None = setting(
        None,
        "Spectrum that the change adds; as an accretion excess or a companion",
        flag="--change-file",
        label="Added spectrum",
        hint="Light that a change adds to the star, such as an accretion excess or a companion: the change “spectrum”.",
        place=1,
        kind="file",
    )
    band: str = setting(
        "V",
        "Band in which the light of that spectrum is measured",
        flag="--change-band",
        choices=tuple(ALIASES),
        label="Band of the added light",
        hint="The smallest change is the light of the added spectrum in this band over that of the star.",
    )
    wavelength_unit: str | None = unit_of_file("wavelength", "change", "that spectrum", "Added")
    flux_unit: str | None = unit_of_file("flux", "change", "that spectrum", "Added")
    extend: str | None = setting(
        None,
        "Library spectrum that continues that spectrum beyond its end",
        flag="--change-extend",
        label="Added: continue with",
        hint="Library spectrum that continues the added one beyond its end, such as M3V, scaled to match at the "
        "join. Nothing: it must cover what the instrument sees.",
        kind="library",
    )
    visits: Annotated[int, Range(2, 10_000)] = setting(
        2,
        "Visits that are compared",
        flag="--visits",
        hint="How many exposures of the star are compared with each other.",
        first="20",
        slider=Slider(2, 100, 1),
    )
    periods: bool = setting(
        False, "Map which periods are recovered, from visits to the first target of the orbit", flag="--periods"
    )
    shortest_d: fields.Days = setting(
        1.0,
        "Shortest period",
        flag="--shortest-period",
        hint="The first period of the map.",
        slider=Slider(0.1, 10, 1.1, log=True),
    )
    longest_d: fields.Days = setting(
        30.0,
        "Longest period",
        flag="--longest-period",
        hint="The last period of the map.",
        slider=Slider(2, 200, 1.1, log=True),
    )
    steps: Annotated[int, Range(2, 50)] = setting(6, "Periods and amplitudes of the map, each")
    period_fap: Annotated[float, Range(1e-3, 0.5)] = setting(
        0.01, "Probability of a peak of noise anywhere in a periodogram"
    )
    trials: Annotated[int, Range(10, 10_000)] = setting(50, "Simulated sinusoids in each cell of the map")

    def light(self) -> Source | None:
        """Read the spectrum that the change adds; None without a file."""
        from mauvecl.host.stars.source import Source

        if self.file is None:
            return None
        with section.reading_for(self, "change"):
            return Source.read(
                self.file, wavelength_unit=self.wavelength_unit, flux_unit=self.flux_unit, extend=self.extend
            )

    def _check_values(self) -> None:
        if not self.shortest_d < self.longest_d:
            raise InputError.of("change.longest_d", self.longest_d, f"more than {self.shortest_d:g} d", unit="d")
        if self.file is None:
            if SPECTRUM in self.of:
                raise InputError("the change 'spectrum' needs a file: give `change.file`", key="change.file")
            section.check_needs(self, "the change", ("wavelength_unit", "flux_unit", "extend"), "file")
        elif SPECTRUM not in self.of:
            raise InputError("change.file needs the change 'spectrum' in change.of as well", key="change.file")


class DataChoice(Section):
    """Observed frames that `analyse` reads."""

    file: Path | None = setting(
        None,
        Help("Observed frames: FITS, ECSV or CSV; the verb's argument stands for it"),
        flag="--data",
        label="Frames",
        hint="A light curve or a sequence of spectra: FITS, ECSV or CSV of at most 16 MiB; the command line reads "
        "larger ones. Files of mauvecl, TESS, Kepler and lightkurve need no mapping.",
        name="frames",
        kind="upload",
    )
    mapping: Path | None = setting(
        None,
        "Where time, flux and error are in that file (TOML)",
        flag="--mapping",
        hint="Other files need a short TOML file that names the columns of time, flux and error, such as "
        "time = 'TIME', flux = 'RATE'; the documentation has one for each layout.",
        kind="upload",
    )
    quality_bits: str | None = setting(
        None,
        "Bits of the quality flag that exclude a frame; numbers and names as in 'Desat,128', or all, or none",
        flag="--quality-bits",
        usual="lightkurve's default for Kepler and K2, for TESS without ImpulsiveOutlier, else all",
        hint="Bits of the quality flag that exclude a frame: numbers and names as in Desat,128, or all, or none. "
        "Without them lightkurve's default applies to Kepler and K2, its default without ImpulsiveOutlier to TESS, "
        "and all bits to other files.",
    )
    ignore_checksum: bool = setting(
        False, "Read FITS files although their CHECKSUM or DATASUM differs", flag="--ignore-checksum"
    )
    report: Literal["pdf", "html"] = setting("html", "Form of the report", flag="--report")

    barycentric: str | None = setting(
        None,
        "Target for which times are converted to the Solar System's barycentre (TDB); name or coordinates",
        flag="--barycentric",
    )


FittedModel = Literal["blackbody", "balmer", "lines", "two-temperatures"]


class MeasureQuestion(Section):
    """Models that are fitted to simulated exposures."""

    models: tuple[FittedModel, ...] = setting(
        (), "Fitted model", flag=Flag("--model", read=section.read_words), usual="the flare's, and simpler ones"
    )
    lines: tuple[str, ...] = setting(
        (), "Line that the model 'lines' fits", flag=Flag("--fit-line", read=section.read_words), usual="the flare's"
    )
    fits: Annotated[int, Range(1, 1_000_000)] = setting(1000, "Simulated exposures of each flare", flag="--fits")
    bands_nm: tuple[tuple[fields.Wavelength, fields.Wavelength], ...] = setting(
        ((200.0, 320.0), (200.0, 700.0)), "Wavelength ranges for which the flux is reported"
    )
    skipped_nm: tuple[tuple[fields.Wavelength, fields.Wavelength], ...] = setting(
        (),
        "Wavelengths that fits leave out, from:to; as in 322:368",
        flag=Flag(
            "--skip",
            kind=list[str],
            read=partial(section.read_ranges, expected="two wavelengths in nm, such as 322:368", unit="nm"),
        ),
        label="Leave out wavelengths",
        hint="Ranges in nm that fits do not use, such as 322:368, or 200:250, 322:368.",
    )
    snr_per_bin: fields.Positive | None = setting(
        None,
        "S/N of bins of frames in which the flares of the study's stare are measured against time",
        flag="--snr-per-bin",
        label="S/N of bins",
        hint="Simulated fits then also measure the flare of a stare of one orbit against time, in bins of frames "
        "in which it reaches this S/N. Nothing: they do not.",
    )
    joint_fit: bool = setting(
        False,
        "Fit shape, temperature and, if it falls, cooling of the flare to all frames of the study's stare together",
        flag="--joint-fit",
        hint="Simulated fits then also fit shape and spectrum of the flare to all frames of a stare of one orbit "
        "together: its peak, half-width, amplitude and temperature.",
    )

    @property
    def along_stare(self) -> bool:
        """True if flares are measured along a stare."""
        return self.snr_per_bin is not None or self.joint_fit

    def _check_values(self) -> None:
        if self.lines:
            from mauvecl.host.stars.flare import EmissionLine

            for name in self.lines:
                EmissionLine.named(name)
        for key in ("bands_nm", "skipped_nm"):
            for low, high in getattr(self, key):
                if not 0 < low < high:
                    raise InputError.of(f"measure.{key}", (low, high), "ascending wavelengths", unit="nm")


def fitted_models(question: MeasureQuestion, flare: Flare) -> list[tuple[FittedModel, bool, tuple[str, ...]]]:
    """Return the name of each fitted model, whether it has a Balmer continuum, and its lines."""
    light = flare.spectrum
    lines = question.lines or tuple(dict.fromkeys((*light.lines, *light.line_fluxes)))
    models = list(question.models)
    if not models:
        models = ["blackbody"]
        if light.second_area is not None:
            models += ["two-temperatures"]
        elif not flare.is_blackbody:
            models += ["balmer", "lines"] if lines else ["balmer"]
    # Next to two blackbodies, lines are fitted without a Balmer continuum.
    with_lines = "two-temperatures" if light.second_area is not None else "lines"
    return [(name, name in ("balmer", "lines"), lines if name in ("lines", with_lines) else ())
            for name in dict.fromkeys(models)]  # fmt: skip
