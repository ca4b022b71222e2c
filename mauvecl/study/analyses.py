"""Study sections of data and what is done with them: measurements, calibrations and changes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from mauvecl.host.stars.library import ALIASES
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Slider, Unit, Widget
from mauvecl.schema.physical import DetectorTemperature, Magnitude, Positive, Wavelength
from mauvecl.schema.section import Section, check_needs, check_one, read_ranges, read_words
from mauvecl.study.star import Star

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source
    from mauvecl.study.star import Flare


class CalibrationObservation(Section):
    """Raw frames of a standard star, or of no light if neither `library` nor `spectrum` is given."""

    frames: Annotated[Path, Help("File of raw frames, DN with bias and dark")]
    mapping: Annotated[Path | None, Help("Where time, flux and temperature are in that file (TOML)")] = None
    library: Annotated[str | None, Help("Name of the standard star in the library")] = None
    spectrum: Annotated[Path | None, Help("File with the spectrum of the standard star, such as CALSPEC's")] = None
    magnitude: Annotated[Magnitude | None, Help("Magnitude", default="that of the spectrum")] = None
    band: Annotated[str, Help("Band of the magnitude")] = "V"
    temperature_c: Annotated[
        DetectorTemperature | None, Help("Detector temperature, where the frames do not state it")
    ] = None

    def _check_values(self) -> None:
        check_one(self, "an observation", "spectrum", "library")
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

    observations: Annotated[
        tuple[CalibrationObservation, ...],
        Help("Observations of standard stars and of no light"),
        Widget(
            "Observations",
            "A zip archive: a TOML file with [[calibrate.observations]], as for the command line, and the frames, "
            "mappings and spectra that it names.",
            kind="upload",
        ),
    ] = ()
    knots: Annotated[
        int,
        Range(4, 200),
        Help("Intervals of the spline of the throughput"),
        Flag("--knots"),
        Widget(
            "Intervals of the throughput",
            "Intervals of the spline that describes the throughput: more of them follow narrower features, with "
            "larger errors.",
        ),
    ] = 100
    light_error: Annotated[
        float,
        Range(0, 1),
        Help("Relative error of the light of an observation, by pointing"),
        Flag("--light-error"),
        Widget("Error of the light", "By how much the light of an observation differs, by pointing.", unit="%"),
    ] = 0.0
    spectrum_error: Annotated[
        Annotated[float, Range(0, 1)] | None,
        Help("Relative error of the spectra of the stars, at each of 12 wavelengths",
             default="0.1 for one star, fitted for several if they disagree"),
        Flag("--spectrum-error"),
        Widget("Error of the spectra",
               "Error of the stars' spectra, at each of 12 wavelengths. Empty: 10 % for one star, fitted if several "
               "disagree.", unit="%"),
    ] = None  # fmt: skip


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
        Flag("--change", kind=list[str], read=read_words),
        Widget(
            "Changes",
            "What changes, with commas: lines such as Mg II or 656.5 (nm), balmer jump, colour, and bands such as "
            "200-320 (nm).",
            name="changes",
            first=", ".join(DEFAULT_CHANGES),
        ),
    ] = DEFAULT_CHANGES
    file: Annotated[
        Path | None,
        Help("Spectrum that the change adds", "as an accretion excess or a companion"),
        Flag("--change-file"),
        Widget(
            "Added spectrum",
            "Light that a change adds to the star, such as an accretion excess or a companion: the change “spectrum”.",
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
            "Band of the added light",
            "The smallest change is the light of the added spectrum in this band over that of the star.",
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
            "Added: unit of wavelengths",
            "Such as Angstrom or Angstrom air. Nothing: what the file says.",
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
            "Added: unit of fluxes",
            "Such as W m-2 nm-1 or Jy. Nothing: what the file says.",
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
            "Added: continue with",
            "Library spectrum that continues the added one beyond its end, such as M3V, scaled to match at the "
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
            "Visits",
            "How many exposures of the star are compared with each other.",
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
        Widget(hint="The first period of the map.", slider=Slider(0.1, 10, 1.1, log=True)),
    ] = 1.0
    longest_d: Annotated[
        Days,
        Help("Longest period"),
        Flag("--longest-period"),
        Widget(hint="The last period of the map.", slider=Slider(2, 200, 1.1, log=True)),
    ] = 30.0
    steps: Annotated[int, Range(2, 50), Help("Periods and amplitudes of the map, each")] = 6
    period_fap: Annotated[
        Annotated[float, Range(1e-3, 0.5)], Help("Probability of a peak of noise anywhere in a periodogram")
    ] = 0.01
    trials: Annotated[int, Range(10, 10_000), Help("Simulated sinusoids in each cell of the map")] = 50

    def light(self) -> Source | None:
        """Read the spectrum that the change adds; None without a file."""
        from mauvecl.host.stars.source import Source

        if self.file is None:
            return None
        return Source.read(
            self.file, wavelength_unit=self.wavelength_unit, flux_unit=self.flux_unit, extend=self.extend
        )

    def _check_values(self) -> None:
        if not self.shortest_d < self.longest_d:
            raise InputError.of("change.longest_d", self.longest_d, f"more than {self.shortest_d:g} d", unit="d")
        if self.file is None:
            if SPECTRUM in self.of:
                raise InputError("the change 'spectrum' needs a file: give `change.file`", key="change.file")
            check_needs(self, "the change", ("wavelength_unit", "flux_unit", "extend"), "file")
        elif SPECTRUM not in self.of:
            raise InputError("change.file needs the change 'spectrum' in change.of as well", key="change.file")


class DataChoice(Section):
    """Observed frames that `analyse` reads."""

    file: Annotated[
        Path | None,
        Help("Observed frames: FITS, ECSV or CSV; the verb's argument stands for it"),
        Flag("--data"),
        Widget(
            "Frames",
            "A light curve or a sequence of spectra: FITS, ECSV or CSV of at most 16 MiB; the command line reads "
            "larger ones. Files of mauvecl, TESS, Kepler and lightkurve need no mapping.",
            name="frames",
            kind="upload",
        ),
    ] = None
    mapping: Annotated[
        Path | None,
        Help("Where time, flux and error are in that file (TOML)"),
        Flag("--mapping"),
        Widget(
            "Mapping",
            "Other files need a short TOML file that names the columns of time, flux and error, such as "
            "time = 'TIME', flux = 'RATE'; the documentation has one for each layout.",
            kind="upload",
        ),
    ] = None
    quality_bits: Annotated[
        str | None,
        Help(
            "Bits of the quality flag that exclude a frame",
            "numbers and names as in 'Desat,128', or all, or none",
            default="lightkurve's default for Kepler and K2, for TESS without ImpulsiveOutlier, else all",
        ),
        Flag("--quality-bits"),
        Widget(
            "Quality bits",
            "Bits of the quality flag that exclude a frame: numbers and names as in Desat,128, or all, or none. "
            "Without them lightkurve's default applies to Kepler and K2, its default without ImpulsiveOutlier to TESS, "
            "and all bits to other files.",
        ),
    ] = None
    ignore_checksum: Annotated[
        bool, Help("Read FITS files although their CHECKSUM or DATASUM differs"), Flag("--ignore-checksum")
    ] = False
    report: Annotated[Literal["pdf", "html"], Help("Form of the report"), Flag("--report")] = "html"

    barycentric: Annotated[
        str | None,
        Help("Target for which times are converted to the Solar System's barycentre (TDB)", "name or coordinates"),
        Flag("--barycentric"),
    ] = None


FittedModel = Literal["blackbody", "balmer", "lines", "two-temperatures"]


class MeasureQuestion(Section):
    """Models that are fitted to simulated exposures."""

    models: Annotated[
        tuple[FittedModel, ...],
        Help("Fitted model", default="the flare's, and simpler ones"),
        Flag("--model", read=read_words),
    ] = ()
    lines: Annotated[
        tuple[str, ...],
        Help("Line that the model 'lines' fits", default="the flare's"),
        Flag("--fit-line", read=read_words),
    ] = ()
    fits: Annotated[int, Range(1, 1_000_000), Help("Simulated exposures of each flare"), Flag("--fits")] = 1000
    bands_nm: Annotated[
        tuple[tuple[Wavelength, Wavelength], ...], Help("Wavelength ranges for which the flux is reported")
    ] = ((200.0, 320.0), (200.0, 700.0))
    skipped_nm: Annotated[
        tuple[tuple[Wavelength, Wavelength], ...],
        Help("Wavelengths that fits leave out, from:to", "as in 322:368"),
        Flag(
            "--skip",
            kind=list[str],
            read=partial(read_ranges, expected="two wavelengths in nm, such as 322:368", unit="nm"),
        ),
        Widget(
            "Leave out wavelengths",
            "Ranges in nm that fits do not use, such as 322:368, or 200:250, 322:368.",
            unit="nm",
        ),
    ] = ()
    snr_per_bin: Annotated[
        Positive | None,
        Help("S/N of bins of frames in which the flares of the study's stare are measured against time"),
        Flag("--snr-per-bin"),
        Widget(
            "S/N of bins",
            "Simulated fits then also measure the flare of a stare of one orbit against time, in bins of frames "
            "in which it reaches this S/N. Nothing: they do not.",
        ),
    ] = None
    joint_fit: Annotated[
        bool,
        Help(
            "Fit shape, temperature and, if it falls, cooling of the flare to all frames of the study's stare together"
        ),
        Flag("--joint-fit"),
        Widget(
            "Joint fit",
            "Simulated fits then also fit shape and spectrum of the flare to all frames of a stare of one orbit "
            "together: its peak, half-width, amplitude and temperature.",
        ),
    ] = False

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


def fitted_models(asked: MeasureQuestion, flare: Flare) -> list[tuple[FittedModel, bool, tuple[str, ...]]]:
    """Return the name of each fitted model, whether it has a Balmer continuum, and its lines."""
    light = flare.spectrum
    lines = asked.lines or tuple(dict.fromkeys((*light.lines, *light.line_fluxes)))
    models = list(asked.models)
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
