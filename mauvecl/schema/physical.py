"""Physical quantities with unit and range; study keys, flags, sweeps, page fields and Python arguments share them."""

from __future__ import annotations

from typing import Annotated

from mauvecl.schema.fields import Range, Unit

#: Seconds in a day.
DAY_S = 86_400.0

#: From far brighter than the Sun (-26.76, Willmer 2018) to fainter than any detected star.
Magnitude = Annotated[float, Unit("mag"), Range(-30, 40)]
#: Relative rise in a band. The largest known flare, ASASSN-16ae, rose by 11 magnitudes: 2.5e4 (Schmidt et al. 2016).
Amplitude = Annotated[float, Range(0, 1e6)]
#: From cool starspots to the hottest white dwarfs; flares of 5000 to 50 000 K are published.
Temperature = Annotated[float, Unit("K"), Range(1_000, 200_000)]
#: One exposure lasts at most a day; longer ones are several that are added up.
Exposure = Annotated[float, Unit("s"), Range(0, DAY_S, open_low=True)]
#: Operating range in the datasheet of the detector, Hamamatsu S11639-01 (KMPD1163E, absolute maximum ratings).
DetectorTemperature = Annotated[float, Unit("deg_C"), Range(-40, 65)]
#: Surface brightness in V; any sky seen from orbit lies well within.
SkyBrightness = Annotated[float, Unit("mag / arcsec2"), Range(5, 35)]
#: Ratio of the flux just below the Balmer edge to that just above.
BalmerJump = Annotated[float, Range(1, 100)]
#: Ratio of two areas of a flare.
AreaRatio = Annotated[float, Range(0, 1e6)]
#: Flux of a line over that of the continuum in 200-700 nm.
LineFraction = Annotated[float, Range(0)]
#: Factor on the fluxes of lines.
LineScale = Annotated[float, Range(0, 1e6)]
#: Colour excess E(B-V).
Reddening = Annotated[float, Unit("mag"), Range(0, 10)]
#: Width of the bins of a spectrum.
BinWidth = Annotated[float, Unit("nm"), Range(0.01, 50)]
#: Probability that is neither 0 nor 1.
Probability = Annotated[float, Range(0, 1, open_low=True, open_high=True)]
#: From well within the Sun's distance (4.8e-6 pc) to nearby galaxies.
Distance = Annotated[float, Unit("pc"), Range(1e-7, 1e6)]
#: From far below white dwarfs (0.01) to above the largest supergiants (some 1500).
Radius = Annotated[float, Unit("solRad"), Range(1e-4, 1e4)]
#: Solid angle of a field of view.
SolidAngle = Annotated[float, Unit("arcsec2"), Range(1e-6, 1e12)]
#: Wavelength in vacuum; also a frequency or an energy of photons.
Wavelength = Annotated[float, Unit("nm"), Range(0, open_low=True)]
#: Moment, from the start of an observation, and length of time.
Moment = Annotated[float, Unit("s"), Range()]
Duration = Annotated[float, Unit("s"), Range(0, open_low=True)]
#: Energy of a flare.
Energy = Annotated[float, Unit("erg"), Range(0, open_low=True)]
#: Seed of a random generator with 64 bits.
Seed = Annotated[int, Range(0, 2**64 - 1)]
#: Seed where none is given.
DEFAULT_SEED = 1
#: Number of realisations, and that of the first of them.
Realisations = Annotated[int, Range(1)]
FirstRealisation = Annotated[int, Range(0, 2**63 - 1)]
Positive = Annotated[float, Range(0, open_low=True)]
NotNegative = Annotated[float, Range(0)]
#: Share of a whole.
Share = Annotated[float, Range(0, 1)]
#: Exponent of a power law of flare energies, dN/dE ~ E^-alpha; the integral over large energies must be finite.
RateExponent = Annotated[float, Range(1, 10, open_low=True, open_high=True)]
#: Exponent with which half-widths of flares grow with energy; below 1, since amplitudes grow as well.
DurationExponent = Annotated[float, Range(0, 1, open_high=True)]
#: Standard deviation of the decadic logarithm of half-widths about that law.
DurationScatter = Annotated[float, Range(0, 2)]
