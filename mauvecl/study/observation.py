"""Study sections of an observation: instrument and exposure, sky, realisations, and what is unknown of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, ValidationInfo, create_model, field_validator, model_validator

from mauvecl.detection import DEFAULT_STATISTICS, RECOMMENDED, STATISTIC_NAMES, Tails
from mauvecl.host.exposure import DEFAULT_SKY
from mauvecl.host.instrument import DEFAULT_INSTRUMENT, FORMERLY_MAUVE, current_name, shipped_names
from mauvecl.noise.disturbances import Prior, PriorField
from mauvecl.noise.unknowns import DOCUMENTED_NUISANCES, INSTRUMENT_VALUES, NUISANCES, Comparison, unknown_values_of
from mauvecl.schema import fields
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import Accepted, Flag, Help, Range, Slider, says_none
from mauvecl.schema.section import Section, check_all, check_one, read_words, setting

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.host.exposure.background import Sky
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument


#: Embedded instruments in help texts.
INSTRUMENTS = [
    f"{name} (with the conventions of the MauveSim paper)" if name == FORMERLY_MAUVE else name
    for name in shipped_names()
]


class Observation(Section):
    """Instrument, exposure, and how the detector is modelled."""

    exposure_s: fields.Exposure = setting(
        50.0,
        "Exposure time; rounded up to whole frames of 5 s",
        flag="--exposure -t",
        hint="Time on the star; whole frames of 5 s are added up.",
        slider=Slider(5, 3600, 5),
        quantity=("exposure", "length of the exposure", "exposure (s)"),
    )
    instrument: Annotated[str, AfterValidator(current_name)] = setting(
        DEFAULT_INSTRUMENT,
        "Instrument",
        flag="--instrument",
        choices=f"{', '.join(INSTRUMENTS)}, or your own TOML file",
        label="Payload",
        hint="mauve: dark counts are Poisson in electrons, as in physics. mauvesim: Poisson in DN, as in the "
        "MauveSim paper, which makes the dark noise 1.3 times as large.",
        options=shipped_names(),
    )
    temperature_c: fields.DetectorTemperature | None = setting(
        None,
        "Detector temperature",
        flag="--temperature",
        usual="the instrument's",
        label="Detector temperature",
        hint="The dark current doubles every few degrees.",
        placeholder="21, or along the orbit in plans",
        slider=Slider(-10, 40, 1),
        quantity=("detector_temperature", "temperature of the detector", "detector temperature (deg C)"),
    )
    order: Literal["paper", "physical"] = setting("paper", "Order of efficiency and line spread function")
    signal: Literal["net", "paper"] = setting(
        "net",
        "Signal of an S/N",
        flag="--signal",
        choices="net (the star alone) or paper (with the zodiacal light)",
        label="Counted as signal",
        hint="In the S/N: the light of the star alone (net), or that of the sky too, as in the MauveSim paper. It "
        "moves no detection.",
        place=2,
    )
    mode: Literal["auto", "frames", "stacked"] = setting("auto", "How the frames of an exposure are drawn")
    recipe: Literal["auto", "joint", "apart"] = setting("auto", "How the noise of a frame is drawn")
    changes: dict[str, Annotated[fields.Number | fields.WholeNumber | str, Accepted("a number or text")]] = setting(
        dict, "Changed values of the instrument, by name"
    )

    def load_instrument(self) -> Instrument:
        """Load the instrument and apply `changes` and the detector temperature."""
        from mauvecl.host.instrument.instrument import Instrument

        return self.changed(Instrument.load(self.instrument))

    def changed(self, instrument: Instrument) -> Instrument:
        """Return an instrument with `changes` and the detector temperature."""
        changes = self.changes | ({} if self.temperature_c is None else {"temperature_c": self.temperature_c})
        return instrument.with_(**changes) if changes else instrument


def utc_time(cls: type[Section], text: str | None, info: ValidationInfo) -> str | None:
    """Return the text of a key that is a time, or its default, for which astropy need not be loaded."""
    key = str(info.field_name)
    if text is not None and text != cls.model_fields[key].default:
        from mauvecl.host.exposure.background import parse_time
        from mauvecl.host.tables.units import offline

        with offline():
            parse_time(text, key)
    return text


class SkyLight(Section):
    """Sky background: a surface brightness, that of a target at a time, or none."""

    surface_brightness: fields.SkyBrightness | None = setting(
        None,
        "Surface brightness of the sky in V; or none",
        flag=Flag("--sky", kind=str),
        usual=f"{DEFAULT_SKY:g}",
        label="Sky brightness",
        hint="Zodiacal light, V magnitudes per square arc second.",
        name="sky_brightness",
        first=f"{DEFAULT_SKY:g}",
        unit="mag/arcsec²",
        slider=Slider(20, 24, 0.1),
        quantity=("sky", "zodiacal surface brightness in V", "sky brightness (V mag / arcsec²)"),
    )
    target: str | None = setting(
        None,
        "Target whose zodiacal light is the sky, with the time; a star such as 'AU Mic', or '290.68 +11.12'",
        flag="--target",
        label="Sky target",
        hint="A star by name, such as AU Mic, or coordinates in degrees such as 290.68 +11.12.",
    )
    time: str | None = setting(
        None,
        "Time of the observation, UTC, with the target",
        flag="--time",
        label="Time, UTC",
        hint="Such as 2026-09-01T12:00.",
    )
    none: bool = setting(False, "Whether there is no sky")

    _time = field_validator("time")(utc_time)

    @model_validator(mode="before")
    @classmethod
    def _default_brightness(cls, data: Any) -> Any:
        """Set the default brightness of a sky without keys, and no sky for the brightness "none"."""
        if isinstance(data, dict) and says_none(data.get("surface_brightness")):
            return data | {"surface_brightness": None, "none": True}
        return {"surface_brightness": DEFAULT_SKY} if data == {} else data

    def _check_values(self) -> None:
        check_all(self, "the sky", "target", "time")
        check_one(self, "the sky", "surface_brightness", "target", "none")

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return the sky of one value, which replaces all others."""
        return type(self)(**{path[0]: value})

    def describe(self) -> str:
        """Return the sky in words."""
        if self.target is not None:
            return f"sky at {self.target}, {self.time} UTC"
        return "no sky" if self.none else f"sky of V = {self.surface_brightness:g} mag/arcsec2"

    def sky(self) -> Sky:
        """Return the sky for the host."""
        from mauvecl.host.exposure.background import Sky

        if self.target is not None and self.time is not None:
            return Sky.at(self.target, self.time)
        return Sky.none() if self.surface_brightness is None else Sky.of_brightness(self.surface_brightness)


class Run(Section):
    """Number of realisations, seed, statistics and false-alarm probability."""

    realisations: fields.Realisations = setting(1_000_000, "Noise realisations", flag="--realisations -n")
    seed: fields.Seed = setting(
        fields.DEFAULT_SEED, "Seed", flag="--seed", hint="The same seed gives the same noise, to the bit.", place=3
    )
    statistics: Annotated[
        tuple[str, ...], AfterValidator(lambda names: STATISTIC_NAMES if "all" in names else names)
    ] = setting(
        (RECOMMENDED,),
        "Detection statistic",
        min_length=1,
        flag=(
            Flag("--statistic", read=read_words),
            Flag(
                "--all-statistics",
                kind=bool,
                read=lambda *_: DEFAULT_STATISTICS,
                help=Help(f"Answer by {', '.join(DEFAULT_STATISTICS)} instead of {RECOMMENDED} alone"),
            ),
        ),
        choices=f"{', '.join(STATISTIC_NAMES)}, or all",
    )
    fap: fields.Probability = setting(
        1e-3,
        "False-alarm probability per test",
        flag="--fap",
        label="False-alarm probability",
        hint="How often noise alone passes for a flare, per test: it sets the threshold.",
        unit="per test",
        slider=Slider(1e-6, 0.1, 10**0.1, log=True),
    )
    tails: Tails = setting(
        "counted",
        "Thresholds with fewer than 100 draws beyond them",
        flag="--tails",
        choices="counted rejects them, sampled finds them by importance sampling",
    )
    reference: str = setting(
        "template",
        "Spectrum that is subtracted",
        flag="--reference",
        choices="template (noise-free), exposure (noisy), or stack:N of them",
    )
    variances: Literal["model", "estimated"] = setting(
        "model", "Variances", flag="--variances", choices="model, or estimated from the counts as an observer must"
    )
    template_temperatures_k: tuple[fields.Temperature, ...] = setting(
        (), "Temperature of a flare that is also looked for; shows what a wrong template costs", flag="--template"
    )
    weights: dict[str, Path] = setting(dict, "Files with weights of your own statistics, by name")

    def _check_values(self) -> None:
        self.comparison()

    def comparison(self) -> Comparison:
        """Return the reference of the comparison for the engine."""
        return Comparison.of(self.reference, self.variances)


#: Standard deviation of an unknown.
Spread = Annotated[fields.Positive | Literal["free"], Accepted("a number above 0, or 'free'")]


def sd_of(spread: Spread) -> float:
    """Return the standard deviation of a spread, infinite for "free"."""
    return math.inf if spread == "free" else spread


class OwnNuisance(Section):
    """User-defined nuisance spectrum: wavelength in nm and DN per exposure at unit amplitude, as a file or points."""

    file: Path | None = setting(None, "File with two columns, wavelength in nm and DN per exposure")
    points: tuple[tuple[fields.Number, fields.Number], ...] | None = setting(
        None, "Wavelengths in nm, and DN per exposure"
    )
    sd: Spread = setting("free", "Standard deviation of the amplitude, or free")

    def _check_values(self) -> None:
        check_one(self, "a nuisance spectrum", "points", "file", needed=True)


_OWN = Flag(
    "--nuisance",
    kind=list[str],
    help=Help(
        f"Marginalise over {', '.join(NUISANCES)} or a file's spectrum, with a standard deviation or free",
        "as in dark=0.1 or stray.txt=free",
    ),
)
_keys: Any = {
    "usual": (bool, setting(
        True, "Draw the usual unknowns and marginalise over them, or take everything but the noise as known",
        flag="--with-unknowns/--ideal",
    )),
    **{name: (Spread | None, setting(None, f"Standard deviation of {row.label}, or free"))
       for name, row in NUISANCES.items()},
    "own": (dict[str, OwnNuisance], setting(dict, "Your own nuisance spectra, by name", flag=_OWN)),
}  # fmt: skip


class NuisanceChoice(create_model("_Amplitudes", __base__=Section, **_keys)):  # type: ignore[misc]
    """Prior standard deviations of the amplitudes that statistics are marginalised over, or "free" (projected out).

    With `usual`, the default, the documented set is drawn and marginalised over; values given here replace those of the
    set.
    """

    @property
    def none(self) -> bool:
        """True if everything but the noise is known."""
        return self == KNOWN

    def marginalised(self, quiet: Expectation) -> Nuisances | None:
        """Return the nuisance parameters for the engine, or None if there are none."""
        import numpy as np

        from mauvecl.detection.nuisances import Nuisances, at_pixels, read_at_pixels, spectrum_of

        documented = DOCUMENTED_NUISANCES if self.usual else ()
        # Parameters without effect, such as the brightness of no sky, are left out.
        sd = {row.name: row.sd for row in documented if row.sd is not None and spectrum_of(row.name, quiet).any()}
        sd |= {name: sd_of(spread) for name, spread in self.spreads().items()}
        own: dict[str, NDArray[np.float64]] = {}
        for name, nuisance in self.own.items():
            # DN per exposure at unit amplitude, shape (n_pixel,).
            if nuisance.file is not None:
                own[name] = read_at_pixels("spectrum", name, nuisance.file, quiet.wavelength_nm)
            else:
                points = f"points of {shortened(name)}"
                own[name] = at_pixels(points, "DN", np.array(nuisance.points), quiet.wavelength_nm)
            sd[name] = sd_of(nuisance.sd)
        return Nuisances.of(quiet, sd, own) if sd else None

    def spreads(self) -> dict[str, float | Literal["free"]]:
        """Return the given standard deviations of amplitudes with built-in spectra."""
        return {name: spread for name in NUISANCES if (spread := getattr(self, name)) is not None}


#: Choice of unknowns with which everything but the noise is known.
KNOWN = NuisanceChoice(usual=False)

#: Number of draws, priors by name, and names of known values.
_unknown_keys: Any = {
    "draws": (Annotated[int, Range(0, 4096)], setting(
        0, "Draws of unknown instrument values over which the answer is averaged", flag="--unknown"
    )),
    **{name: (PriorField | None, value.prior) for name, value in INSTRUMENT_VALUES.items()},
    "known": (tuple[str, ...], setting(
        (), "Instrument value that is known; as in temperature_c,light_loss", flag=Flag("--known", read=read_words)
    )),
}  # fmt: skip


class Unknowns(create_model("_InstrumentValues", __base__=Section, **_unknown_keys)):  # type: ignore[misc]
    """Priors of instrument values that are unknown but constant; ignored unless `draws` is positive.

    The documentation page on nominal values explains the default priors.
    """

    def _check_values(self) -> None:
        if self.draws == 1:
            raise InputError.of("unknowns.draws", self.draws, "0 or at least 2")
        for name in self.known:
            if name not in INSTRUMENT_VALUES:
                raise InputError.of("unknowns.known", name, f"some of {', '.join(INSTRUMENT_VALUES)}")

    def priors(self, instrument: Instrument) -> dict[str, Prior]:
        """Return the priors of an instrument's unknown values by name, as in `noise.unknowns.unknown_values_of`."""
        rows = {name: row for name, row in unknown_values_of(instrument).items() if name not in self.known}
        priors: dict[str, Any] = {name: getattr(self, name, row.prior) for name, row in rows.items()}
        return {name: prior for name, prior in priors.items() if prior is not None}
