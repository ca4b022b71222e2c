"""Changes between visits against closed forms, drawn exposures, a direct integration and another periodogram."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy

from mauvecl import Engine, Expectation, Instrument, Nuisances, Sky, Source, Study, change, expect
from mauvecl.answers.observations.change import PERIOD_COLUMNS, PeriodRow
from mauvecl.observations.changes.indices import INDICES, Change, IndexValue
from mauvecl.observations.changes.periods import Recovery, recover_periods, visit_times_d
from mauvecl.observations.changes.smallest import error_of_change, error_of_index, smallest_change
from mauvecl.observations.line_index import line_index
from mauvecl.schema.tables import table_of
from mauvecl.statistics.intervals import Interval
from tests.refusals import refused

AU_MIC = Path(__file__).parents[1] / "data" / "flares" / "aumic_iue"
MAUVE = Instrument.load("mauve")
STAR = Source.from_library("M3V").at_magnitude(9.0)


@pytest.fixture(scope="module")
def quiet() -> Expectation:
    return expect(STAR, MAUVE, exposure=50.0, sky=Sky.of_brightness(22.1))


def counts(name: str, quiet: Expectation, file: Source | None = None) -> np.ndarray:
    return Change.named(name, STAR, quiet, MAUVE, "paper", file, "V").counts_dn


@pytest.mark.parametrize(("fap", "power"), [(1e-3, 0.9), (1e-6, 0.5), (0.05, 0.95)])
def test_two_visits_are_the_two_sided_test_of_a_difference(fap: float, power: float) -> None:
    """The closed form leaves out the far tail, which is below 1e-5 for these."""
    normal = scipy.stats.norm
    expected = np.sqrt(2.0) * (normal.isf(fap / 2) + normal.ppf(power))
    assert smallest_change(1.0, 2, fap, power).one == pytest.approx(expected, rel=1e-4)


def test_smallest_changes_have_the_power() -> None:
    """Draws of 30 visits: 20 000 tests each, within 4 binomial standard errors (once in 16 000 times)."""
    visits, fap, power, n = 30, 0.01, 0.8, 20_000
    found = smallest_change(2.0, visits, fap, power)
    rng = np.random.default_rng(1)
    noise = 2.0 * rng.standard_normal((n, visits))
    one = noise.copy()
    one[:, 3] += found.one
    scattered = noise + found.scatter * rng.standard_normal((n, visits))
    cut = scipy.stats.chi2.isf(fap, visits - 1)
    for values, expected in ((noise, fap), (one, power), (scattered, power)):
        share = np.mean(values.var(axis=1) * visits / 4.0 > cut)
        assert abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / n)


@pytest.mark.parametrize(
    ("line", "snr"), [("Mg II k", 0.050), ("Ca II K", 0.071), ("H beta", 0.075), ("H alpha", 0.066)]
)
def test_errors_of_lines_are_those_computed_independently(line: str, snr: float, quiet: Expectation) -> None:
    """S/N of 1e-12 erg s-1 cm-2 in 50 s at M3V, V = 9, everything known; numbers of two digits."""
    assert 1e-12 / error_of_change(counts(line, quiet), quiet, None) == pytest.approx(snr, abs=0.001)


def test_error_of_change_is_the_scatter_of_fits(quiet: Expectation) -> None:
    """Amplitudes fitted together with drawn unknowns; 4000 exposures give the scatter within 4 x 1.1 %."""
    n, delta = 4000, counts("320-700", quiet)
    unknown = Nuisances.of(quiet, {"dark": 0.1, "light": 0.02})
    rng = np.random.default_rng(2)
    sd = np.sqrt(quiet.variance_dn2)
    exposures = sd * rng.standard_normal((n, sd.size)) + (unknown.sd * rng.standard_normal((n, 2))) @ unknown.spectra
    # Least squares with the priors as additional observations.
    columns = np.vstack([delta, unknown.spectra]) / sd
    information = columns @ columns.T + np.diag([0.0, *unknown.sd**-2.0])
    fitted = (exposures / sd @ columns.T) @ np.linalg.inv(information)
    assert error_of_change(delta, quiet, unknown) == pytest.approx(fitted[:, 0].std(), rel=4 / np.sqrt(2 * n), abs=0)


def test_change_that_an_unknown_imitates_is_hidden(quiet: Expectation) -> None:
    unknown = Nuisances.of(quiet, {"light": np.inf})
    assert error_of_change(quiet.recorded_light_dn, quiet, unknown) == np.inf
    assert np.isfinite(error_of_change(counts("200-320", quiet), quiet, unknown))


def test_error_of_index_is_the_scatter_of_drawn_exposures(engine: Engine, quiet: Expectation) -> None:
    """All four indices of 10 000 drawn exposures: their scatter is known to 0.7 %, and may differ by 2 %."""
    raw = engine.realise(quiet, count=10_000, seed=3) - quiet.recorded_dn
    for index in INDICES.values():
        value = IndexValue.of(index, quiet, MAUVE, "paper")
        assert error_of_index(value.weights, quiet, None) == pytest.approx((raw @ value.weights).std(), rel=0.02, abs=0)


def test_unknowns_of_finite_spread_add_to_the_error_of_an_index(quiet: Expectation) -> None:
    value = IndexValue.of(INDICES["H alpha"], quiet, MAUVE, "paper")
    unknown = Nuisances.of(quiet, {"light": 0.05})
    # Light that grows by 5 % makes the index grow by 5 %.
    expected = np.hypot(error_of_index(value.weights, quiet, None), 0.05 * value.weights @ quiet.recorded_light_dn)
    assert error_of_index(value.weights, quiet, unknown) == pytest.approx(expected, rel=1e-12, abs=0)
    free = Nuisances.of(quiet, {"light": np.inf})
    assert error_of_index(value.weights, quiet, free) == np.inf


def spread(nm: np.ndarray, flux: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Convolve a spectrum with a top hat of 10.8 nm and a Gaussian of 10.5 nm on a fine grid, independently."""
    fine = np.arange(nm[0], nm[-1], 0.02)
    offset = np.arange(-45.0, 45.01, 0.02)
    gauss = np.exp(-4 * np.log(2) * (offset / 10.5) ** 2)
    kernel = np.convolve(gauss, np.ones(round(10.8 / 0.02)), mode="same")
    return np.interp(at, fine, np.convolve(np.interp(fine, nm, flux), kernel / kernel.sum(), mode="same"))


def _of(source: Source) -> tuple[np.ndarray, np.ndarray]:
    return source.wavelength_nm, source.flux_flam


@pytest.mark.parametrize("file", ["lp02123.txt", "lp09052.txt", "lp09126.txt"])
def test_indices_of_au_mic_are_those_of_a_direct_integration(file: str) -> None:
    table = np.loadtxt(AU_MIC / file, skiprows=19, usecols=(0, 1))
    # A library star of its type continues it; only 258-302 nm and the reach of the line function matter.
    nm, flux, other = table[:, 0] / 10, table[:, 1], Source.from_library("M1V")
    beyond = other.wavelength_nm > nm[-1]
    red = other.flux_flam[beyond] * flux[nm > 325].mean() / np.interp(nm[nm > 325], *_of(other)).mean()
    source = Source.from_arrays(
        np.concatenate([[170.0], nm, other.wavelength_nm[beyond]]), np.concatenate([flux[:1], flux, red]), name="AU Mic"
    )
    x = expect(source, MAUVE, exposure=50.0, sky=Sky.none())
    index = INDICES["Mg II"]
    value = IndexValue.of(index, x, MAUVE, "paper")
    nm = x.wavelength_nm
    # Per nm in place of per Angstrom; the pixel is far narrower than the line function.
    flux = 10 * spread(source.wavelength_nm, source.flux_flam, nm)
    windows = np.any([(nm >= low) & (nm <= high) for low, high in index.continuum_nm], axis=0)
    line = np.polyfit(nm[windows], flux[windows], 1)
    fine = np.linspace(*index.band_nm, 4001)
    direct = np.trapezoid(np.interp(fine, nm, flux) - np.polyval(line, fine), fine)
    assert value.value == pytest.approx(direct, rel=0.01, abs=0)
    # The index at the resolution of IUE, times the share that is captured, leaves the continuum's curvature.
    sharp = line_index(
        source.wavelength_nm,
        10 * source.flux_flam,
        band_nm=(278.5, 281.5),
        continuum_nm=((275.5, 278.0), (282.0, 284.5)),
    )
    assert 0.2 < value.value / (value.captured * float(sharp.flux)) < 5


def test_captured_share_is_that_of_a_line_of_flux_one(quiet: Expectation) -> None:
    value = IndexValue.of(INDICES["H beta"], quiet, MAUVE, "paper")
    lit = counts("H beta", quiet)
    assert value.captured == pytest.approx(float(value.weights @ lit), rel=1e-9)
    # A narrow line spread by the line function, in the band and in the continuum below it.
    nm = np.arange(380.0, 590.0, 0.05)
    profile = spread(nm, np.maximum(0, 1 - np.abs(nm - 486.269) / 0.1) / 0.1, nm)
    direct = line_index(nm, profile, band_nm=(478.0, 494.0), continuum_nm=((464.0, 476.0), (496.0, 508.0)))
    assert value.captured == pytest.approx(float(direct.flux), rel=0.01)


def test_spectrum_from_a_file_is_measured_in_its_band(quiet: Expectation) -> None:
    hot = Source.from_library("A0V").at_magnitude(3.0)
    own = counts("spectrum", quiet, hot)
    lit = expect(hot.at_magnitude(9.0), MAUVE, exposure=50.0, sky=Sky.none())
    np.testing.assert_allclose(own, lit.net_source_dn, rtol=1e-9)


def peaks(time: np.ndarray, values: np.ndarray, frequency: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the highest peaks of least-squares sinusoids with a free mean, fitted as a matrix product."""
    angle = 2 * np.pi * frequency[:, None] * time
    columns = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    basis, _ = np.linalg.qr(columns - columns.mean(axis=1, keepdims=True))
    centred = values - values.mean(axis=1, keepdims=True)
    sums = centred @ np.moveaxis(basis, 1, 0).reshape(time.size, -1)
    power = (sums.reshape(len(values), -1, 2) ** 2).sum(axis=2) / (centred**2).sum(axis=1)[:, None]
    best = power.argmax(axis=1)
    return power[np.arange(len(values)), best], frequency[best]


@pytest.mark.long
def test_recovered_periods_are_those_of_another_periodogram() -> None:
    """Six cells; the thresholds have errors of some 20 % of the false-alarm probability, which moves shares by 0.03.

    Beyond that, 4 standard errors of 100 and 1000 trials: a false failure once in 2500 seeds.
    """
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0, 40, 25))
    periods, amplitudes, fap, n = np.array([1.5, 7.0, 15.0]), np.array([1.0, 1.6]), 0.05, 1000
    found = recover_periods(time, periods, amplitudes, fap=fap, trials=100, seed=5, shortest_d=1.2, longest_d=20.0)
    base = np.ptp(time)
    frequency = np.arange(1 / 20, 1 / 1.2 + 0.5 / base, 1 / (5 * base))
    cut = np.quantile(peaks(time, rng.standard_normal((4000, time.size)), frequency)[0], 1 - fap)
    for k, amplitude in enumerate(amplitudes):
        for j, period in enumerate(periods):
            wave = amplitude * np.sin(2 * np.pi * time / period + rng.uniform(0, 2 * np.pi, (n, 1)))
            power, at = peaks(time, wave + rng.standard_normal((n, time.size)), frequency)
            other = float(np.mean((power > cut) & (np.abs(at - 1 / period) < 0.5 / base)))
            error = np.sqrt(max(other * (1 - other), 0.01) * (1 / 100 + 1 / n))
            assert abs(found.recovered[k][j].value - other) < 0.03 + 4 * error, (period, amplitude)


def test_visits_lie_in_windows() -> None:
    from mauvecl.host.orbit.visibility import Windows

    start = np.array([0.0, 5000.0, 9000.0])
    windows = Windows(start, start + np.array([1000.0, 200.0, 3000.0]), np.zeros(3))
    days = visit_times_d(windows, 500, 300.0, 1)
    seconds = days * 86_400
    inside = [(seconds >= a + 150) & (seconds <= b - 150) for a, b in ((0, 1000), (9000, 12_000))]
    assert np.all(inside[0] | inside[1])
    # By length: 700 of 3400 s; 4 standard errors of 500 visits.
    assert abs(inside[0].mean() - 700 / 3400) < 4 * np.sqrt(0.2059 * 0.7941 / 500)
    with refused("observation.exposure_s", expected="longest window, 3000 s"):
        visit_times_d(windows, 5, 4000.0, 1)


def test_answer_holds_every_change_and_magnitude() -> None:
    settings = ["star=[{library='M3V', magnitude=9}]", "sweep.axes=[{quantity='exposure', values=[50, 600]}]",
                "nuisances.dark=0.1"]  # fmt: skip
    answer = change(Study().with_settings(settings))
    names = list(dict.fromkeys(answer.table["change"]))
    assert len(answer.table) == 2 * len(names)
    short, long = (answer.table[answer.table["exposure"].value == seconds] for seconds in (50, 600))
    assert np.all(np.asarray(short["smallest"]) > np.asarray(long["smallest"]))
    assert len(answer.magnitude_table) == len(answer.table) * 17
    assert np.all(answer.table["error"] >= answer.table["error_known"])


def test_columns_of_a_change_are_its_errors_and_smallest_sizes(quiet: Expectation) -> None:
    """Two visits: the difference as of normal values, the scatter by the variance of one degree of freedom."""
    settings = ["star=[{library='M3V', magnitude=9}]", "change.of=['320-700']", "nuisances.light=0.02"]
    study = Study().with_settings(settings)
    assert (study.change.visits, study.observation.exposure_s) == (2, 50.0)
    (row,) = change(study).table
    fap, power = study.run.fap, study.limit.power
    delta = counts("320-700", quiet)
    errors = [error_of_change(delta, quiet, one) for one in (Nuisances.of(quiet, {"light": 0.02}), None)]
    assert errors[0] > 1.2 * errors[1]
    assert [row["error"], row["error_known"]] == pytest.approx(errors, rel=0.01)
    normal, chi2 = scipy.stats.norm, scipy.stats.chi2
    one = np.sqrt(2.0) * (normal.isf(fap / 2) + normal.ppf(power))
    scatter = np.sqrt(chi2.isf(fap, 1) / chi2.isf(power, 1) - 1)
    assert [row["smallest"], row["smallest_scatter"]] == pytest.approx(
        row["error"] * np.array([one, scatter]), rel=1e-4
    )


def test_rows_of_periods_are_those_of_their_cells() -> None:
    """Shares that state their amplitude and period in their digits."""
    periods, amplitudes = np.array([1.0, 2.0, 3.0]), np.array([0.4, 0.8])
    cells = [[Interval(a + p / 100, 0.0, 1.0) for p in periods] for a in amplitudes]
    star = Change("320-700", "", "", np.ones(3))
    row = PeriodRow("star", {}, star, 5.0, Recovery(periods, 0.5, periods, amplitudes, cells))
    table = table_of(PERIOD_COLUMNS, [row])
    np.testing.assert_allclose(table["recovered"], table["amplitude_errors"] + table["period"].value / 100)
    np.testing.assert_allclose(table["amplitude"], 5.0 * table["amplitude_errors"])


FLAT = Source(np.linspace(150.0, 760.0, 611), np.full(611, 1e-12), "flat", "test")


@pytest.mark.parametrize("limits", [(300.0, 301.0), (310.03, 317.58), (400.0, 500.0)])
def test_bands_have_the_light_between_their_edges(limits: tuple[float, float], quiet: Expectation) -> None:
    """Compare the share of a flat spectrum in each pixel, added up over wavelengths, with the width of the band."""
    part, whole = (
        Change.named(f"{low}-{high}", FLAT, quiet, MAUVE, "paper", None, "V").counts_dn
        for low, high in (limits, (150.0, 760.0))
    )
    # Each pixel has the band's share of its line function, whose sum over pixels is the band's width.
    share = part / whole * np.gradient(quiet.wavelength_nm)
    assert float(share.sum()) == pytest.approx(limits[1] - limits[0], rel=2e-4)
    centre = float(share @ quiet.wavelength_nm / share.sum())
    assert centre == pytest.approx(sum(limits) / 2, abs=1e-3)


@pytest.mark.parametrize(("name", "edge"), [("balmer jump", 364.6), ("colour", 450.0)])
def test_changes_below_an_edge_end_there(name: str, edge: float, quiet: Expectation) -> None:
    """Compare with the same change as a band, and find the edge where a pixel has half of the light."""
    below, band = counts(name, quiet), counts(f"150-{edge}", quiet)
    unit = 0.4 * np.log(10.0) if name == "colour" else 1.0
    np.testing.assert_allclose(below, unit * band, rtol=1e-12, atol=1e-12 * band.max())
    parts = [Change.named(one, FLAT, quiet, MAUVE, "paper", None, "V").counts_dn for one in (name, "150-760")]
    share = parts[0] / parts[1] / unit
    assert float(np.interp(0.5, share[::-1], quiet.wavelength_nm[::-1])) == pytest.approx(edge, abs=0.01)


@pytest.mark.parametrize(
    ("magnitude", "none", "marked"),
    [(-1.0, {"Ca II", "H beta", "H alpha", "320-700"}, {"Mg II", "balmer jump", "200-320", "colour"}),
     (0.75, set(), {"H beta", "320-700", "colour"}), (6.0, set(), set())],
)  # fmt: skip
def test_rows_with_saturated_pixels_are_marked(magnitude: float, none: set[str], marked: set[str]) -> None:
    """Check that rows without a pixel have no number, and that indices with a saturated pixel have none."""
    answer = change(Study().with_settings([f"star=[{{library='G2V', magnitude={magnitude}}}]"]))
    for row in answer.changes:
        name = row.change.name
        assert np.isnan(row.error) == (name in none)
        assert ("saturate" in row.note) == (name in none | marked), row.note
    for index in answer.indices:
        lost = index.value.index.name in none | marked
        assert np.isnan(index.value.value) == np.isnan(index.snr) == np.isnan(index.error) == lost
        assert bool(index.note) == lost
    assert not any("HIDDEN" in text for text in answer.messages)


def test_a_colour_of_magnitudes_is_not_linear() -> None:
    """Check that the faintest star's smallest colour is a few magnitudes, and that of a bright one proportional."""
    faint, bright = (
        change(Study().with_settings([f"star=[{{library='M3V', magnitude={v}}}]", "change.of=['colour', '150-450']"]))
        for v in (16.0, 6.0)
    )
    for answer in (faint, bright):
        colour, band = (row.smallest.one for row in answer.changes)
        assert colour == pytest.approx(2.5 * np.log10(1.0 + band), rel=1e-6)
    assert faint.changes[0].smallest.one < 10.0
