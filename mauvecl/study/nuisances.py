"""Study section for nuisance parameters, which vary between exposures and are drawn and marginalised over."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, create_model, model_validator

from mauvecl.noise.unknowns import DOCUMENTED_NUISANCES, NUISANCES, Processes, default_processes
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import Flag, Help
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.host.exposure.expectation import Expectation


def _spread(given: Any) -> Any:
    """Validate a standard deviation or "free"."""
    if given == "free":
        return given
    try:
        value = float(given) if not isinstance(given, bool) else float("nan")
    except (TypeError, ValueError):
        value = float("nan")
    if not 0 < value < float("inf"):
        raise InputError(
            f"the standard deviation of an unknown is {shortened(str(given))}", "a number above 0, or 'free'"
        )
    return value


Spread = Annotated[float | Literal["free"], BeforeValidator(_spread)]


def sd_of(spread: Spread) -> float:
    """Return the standard deviation of a spread, infinite for "free"."""
    return math.inf if spread == "free" else spread


class OwnNuisance(Section):
    """User-defined nuisance spectrum: wavelength in nm and DN per exposure at unit amplitude, as a file or points."""

    file: Annotated[Path | None, Help("File with two columns, wavelength in nm and DN per exposure")] = None
    points: Annotated[tuple[tuple[float, float], ...] | None, Help("Wavelengths in nm, and DN per exposure")] = None
    sd: Annotated[Spread, Help("Standard deviation of the amplitude, or free")] = "free"

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        if (self.file is None) == (self.points is None):
            raise InputError("a nuisance spectrum needs either file or points, but has neither or both", key="points")
        return self

    def spectrum(self, name: str, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the DN per exposure at unit amplitude, shape (n_pixel,)."""
        import numpy as np

        from mauvecl.detection.nuisances import at_pixels, read_spectrum

        if self.file is not None:
            return read_spectrum(name, self.file, wavelength_nm)
        return at_pixels(f"points of {shortened(name)}", "DN", np.array(self.points), wavelength_nm)


Usual = Annotated[
    bool,
    Help("Draw the usual unknowns and marginalise over them, or take everything but the noise as known"),
    Flag("--with-unknowns/--ideal"),
]
Own = Annotated[
    dict[str, OwnNuisance],
    Help("Your own nuisance spectra, by name"),
    Flag(
        "--nuisance",
        kind=list[str],
        help=Help(
            f"Marginalise over {', '.join(NUISANCES)} or a file's spectrum, with a standard deviation or free",
            "as in dark=0.1 or stray.txt=free",
        ),
    ),
]
_keys: Any = (
    {"usual": (Usual, True)}
    | {
        name: (Annotated[Spread | None, Help(f"Standard deviation of {row.label}, or free")], None)
        for name, row in NUISANCES.items()
    }
    | {"own": (Own, Field(default_factory=dict))}
)


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
        from mauvecl.detection.nuisances import Nuisances

        sd = usual_spreads(quiet) if self.usual else {}
        sd |= {name: sd_of(spread) for name, spread in self.spreads().items()}
        own: dict[str, NDArray[np.float64]] = {}
        for name, nuisance in self.own.items():
            own[name] = nuisance.spectrum(name, quiet.wavelength_nm)
            sd[name] = sd_of(nuisance.sd)
        return Nuisances.of(quiet, sd, own) if sd else None

    def spreads(self) -> dict[str, float | Literal["free"]]:
        """Return the given standard deviations of amplitudes with built-in spectra."""
        return {name: spread for name in NUISANCES if (spread := getattr(self, name)) is not None}

    def processes(self, named: Processes, temperature_c: float) -> Processes:
        """Return the processes to draw: those given and, with `usual`, those of the documented set."""
        if not self.usual:
            return named
        added = default_processes(temperature_c)
        update = {name: prior for name, prior in added.items() if getattr(named, name) is None}
        every: Processes = named.model_copy(update=update)
        return every


#: Choice of unknowns with which everything but the noise is known.
KNOWN = NuisanceChoice(usual=False)


def usual_spreads(quiet: Expectation) -> dict[str, float]:
    """Return the standard deviations of the documented set, omitting parameters without effect, such as no sky."""
    from mauvecl.detection.nuisances import spectrum_of

    return {
        row.name: row.prior.sd
        for row in DOCUMENTED_NUISANCES
        if row.prior is not None and spectrum_of(row.name, quiet).any()
    }
