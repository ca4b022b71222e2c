"""Expectations for the engine's tests: real stars on the nominal payload, or on a part of its pixels."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray
from scipy import stats

import mauvecl
from mauvecl import SHAPES, Expectation, Frames, Instrument, Sky, Source, Stare, Study, analyse, expect
from mauvecl.flares import stare_scene
from mauvecl.noise import scene as noise_scene

Float = NDArray[np.float64]
Components, prepare = stare_scene.Components, noise_scene.prepare

#: Tables of the bands by name: wavelength in nm, and throughput.
BANDS = {
    table.meta["name"]: table
    for path in (Path(mauvecl.__file__).parent / "host" / "stars" / "library" / "bands").iterdir()
    for table in [Table.read(path, format="ascii.ecsv")]
}

#: False alarms per star-day, rarer than those of a day, whose simulation takes less time.
PER_MONTH, PER_CENTURY = 12 / 365.25, 1 / 36_525

#: Of `flaring_stares`: around the boundary of the counter's first word.
N_STARES, FIRST_STARE = 200, 2**32 - 70

#: Half of a hotter star 0.6 magnitudes fainter than `star`.
NEAR: Any = Study().with_settings(
    [f"star=[{{library='G2V', neighbours='{Path(__file__).parent}/data/studies/near.csv', neighbour_share=0.5}}]"]
).star[0].near()  # fmt: skip

#: Band and continuum of the Mg II line, nm.
MG_II: Any = {"band_nm": (278.5, 281.5), "continuum_nm": ((275.5, 278.0), (282.0, 284.5))}


def instrument(name: str = "mauvesim", *, part: bool = False, **changes: Any) -> Instrument:
    """Return the payload, or only its 198 pixels around the peak of the throughput for the slow reference."""
    if part:
        changes = {"output_min_nm": 300.0, "output_max_nm": 360.0} | changes
    found = Instrument.load(name)
    return found.with_(**changes) if changes else found


def star(
    name: str = "G2V",
    magnitude: float = 7.4,
    *,
    amplitudes: tuple[float, ...] = (),
    exposure: float = 50.0,
    payload: Instrument | None = None,
    neighbours: Any = None,
) -> list[Expectation]:
    """Return the expectations of the quiescent star and its flares."""
    payload = payload or instrument()
    quiet = Source.from_library(name).at_magnitude(magnitude)
    sources = [quiet, *(quiet.flaring(a) for a in amplitudes)]
    return [expect(s, payload, exposure=exposure, sky=Sky.of_brightness(22.1), neighbours=neighbours) for s in sources]


def paper(*settings: str) -> Study:
    """Return a study of the paper's conventions with some settings."""
    return Study().paper().with_settings(settings)


def study_of_g2v(**sections: Any) -> Study:
    """Return a study of the paper's G2V star, a 24 % flare and a short run, with sections changed or added."""
    data: dict[str, Any] = {
        "star": [{"library": "G2V", "magnitude": 7.4}],
        "flare": {"amplitudes": [0.24]},
        "run": {"realisations": 20_000, "fap": 1e-2, "statistics": ["matched"], "seed": 5},
    }
    for name, values in sections.items():
        data[name] = data.get(name, {}) | values if isinstance(values, dict) else values
    return Study.build(data, "test")


@cache
def source(library: str = "M3V", magnitude: float = 9.0) -> Source:
    return Source.from_library(library).at_magnitude(magnitude)


@cache
def quiescent(library: str = "M3V", magnitude: float = 9.0, exposure: float = 50.0) -> Expectation:
    return expect(source(library, magnitude), "mauvesim", exposure=exposure)


def assert_covered(inside: Any, n: int, least: float, most: float, false: float = 1e-6) -> None:
    """Check counts of covered truths of n against coverages, which are left with this probability on each side."""
    low, high = stats.binom.ppf(false, n, least), stats.binom.isf(false, n, most)
    assert ((low <= np.asarray(inside)) & (np.asarray(inside) <= high)).all(), np.asarray(inside) / n


def flaring_stares(method: Any = "cumulants", **more: Any) -> stare_scene.StaresRequest:
    """Return two hundred stares of half a minute, each with different flares in two scenarios."""
    quiet, flare = star(amplitudes=(1.0,), exposure=5.0, payload=instrument(part=True))
    slope = np.linspace(-1.0, 1.0, quiet.wavelength_nm.size)
    components = Components.of(quiet, [flare], np.stack([np.ones_like(slope), slope]))
    stare = Stare.of(30.0, jitters={"light": 0.01}, offsets={"temperature": 0.1}, temperature_c=21.0)
    rng = np.random.default_rng(1)
    flares = {"flare": rng.random((N_STARES, 6, 1)), "amplitudes": rng.random((2, N_STARES))}
    return stare_scene.StaresRequest(
        components, stare, N_STARES, 5, **({**flares, "start": FIRST_STARE, "method": method} | more)
    )


def flare(
    time_s: Float, frame_s: float, peak_s: float, half_width_s: float, shape: Any = SHAPES["davenport2014"]
) -> Float:
    """Return the mean of a flare of unit amplitude over each frame."""
    edges = np.column_stack([time_s - frame_s / 2, time_s + frame_s / 2])
    return shape.mean_over(edges, peak_s, half_width_s)


def through(name: str, nm: Float, flux: Float) -> float:
    """Integrate a spectrum through a band, weighted with energy: erg s-1 cm-2."""
    at, throughput = (np.asarray(BANDS[name][column], float) for column in ("wavelength", "throughput"))
    fine = np.linspace(at[0], at[-1], 60_001)
    response = np.interp(fine, at, throughput / throughput.max())
    return float(np.trapezoid(response * np.interp(fine, nm, flux, left=0, right=0), fine)) * 10


def noisy(rng: Any, time_s: Float, light: Float, noise: float, **more: Any) -> Frames:
    """Return frames of light with normal noise, which is stated, by a generator or a seed."""
    flux = light + noise * np.random.default_rng(rng).standard_normal(time_s.size)
    return Frames.of(time_s, flux, np.full(time_s.size, noise), **more)


def analysed(frames: Frames, **search: Any) -> Any:
    """Return the answer of `analyse` for one false alarm a day, or as the study's section says."""
    return analyse(Study.build({"search": {"per": "day"} | search}, "test"), frames=frames)


def detected(analysis: Any, per_day: float | None = None) -> list[Any]:
    """Return the flares above the threshold, or above that of a rarer false alarm, extrapolated from the rates."""
    rates = () if per_day is None else (analysis.modelled, analysis.measured)
    threshold = max([analysis.threshold, *(rate.threshold(per_day) for rate in rates)])
    return [one for one in analysis.events if one.kind == "flare" and one.value >= threshold]
