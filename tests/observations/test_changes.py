"""Changes between visits against closed forms, drawn exposures, a direct integration and another periodogram."""

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from scenes import MG_II, analysed, noisy, paper, source
from scipy import ndimage, stats

from mauvecl import Engine, Expectation, Frames, Instrument, Nuisances, Sky, Source, Study, analyse, change, expect
from mauvecl.observations import visits

MAUVE = Instrument.load("mauvesim")


def asked(*settings: str, star: str = "library='M3V', magnitude=9") -> Any:
    return change(paper(f"star=[{{{star}}}]", *settings))


def written(star: Source, path: Path) -> str:
    columns = np.column_stack([star.wavelength_nm, star.flux_flam])
    np.savetxt(path, columns, "%.17g", ",", header="wavelength (nm),flux (erg/(s cm2 Angstrom))", comments="")
    return f"file='{path}'"


@pytest.fixture(scope="module")
def quiet() -> Expectation:
    return expect(source(), MAUVE, exposure=50.0, sky=Sky.of_brightness(22.1))


@pytest.mark.parametrize(("number", "fap", "power"), [(30, 0.01, 0.8), (2, 0.05, 0.5), (2, 0.001, 0.95)])
def test_smallest_changes_have_the_power(number: int, fap: float, power: float) -> None:
    """Draws of visits: 20 000 tests each, within 4 binomial standard errors (once in 16 000 times)."""
    n = 20_000
    (row,) = asked("change.of=['320-700']", f"run.fap={fap}", f"limit.power={power}", f"change.visits={number}").table
    rng = np.random.default_rng(1)
    noise = row["error"] * rng.standard_normal((n, number))
    one = noise.copy()
    one[:, 1] += row["smallest"]
    scattered = noise + row["smallest_scatter"] * rng.standard_normal((n, number))
    cut = stats.chi2.isf(fap, number - 1)
    for values, expected in ((noise, fap), (one, power), (scattered, power)):
        share = np.mean(values.var(axis=1) * number / row["error"] ** 2 > cut)
        assert abs(share - expected) < 4 * np.sqrt(expected * (1 - expected) / n)


def test_error_of_change_is_the_scatter_of_fits(quiet: Expectation) -> None:
    """Amplitudes fitted together with drawn unknowns; 4000 exposures give the scatter within 4 x 1.1 %."""
    n, (row,) = 4000, asked("change.of=['320-700']", "nuisances.dark=0.1", "nuisances.light=0.02").changes
    delta, unknown = row.change.counts_dn, Nuisances.of(quiet, {"dark": 0.1, "light": 0.02})
    rng = np.random.default_rng(2)
    sd = np.sqrt(quiet.variance_dn2)
    exposures = sd * rng.standard_normal((n, sd.size)) + (unknown.sd * rng.standard_normal((n, 2))) @ unknown.spectra
    # Least squares with the priors as additional observations.
    columns = np.vstack([delta, unknown.spectra]) / sd
    information = columns @ columns.T + np.diag([0.0, *unknown.sd**-2.0])
    fitted = (exposures / sd @ columns.T) @ np.linalg.inv(information)
    assert row.error == pytest.approx(fitted[:, 0].std(), rel=4 / np.sqrt(2 * n), abs=0)
    assert row.error_known == pytest.approx(1 / np.linalg.norm(delta / sd), rel=1e-6)
    assert row.error > 1.2 * row.error_known
    # Changes and indices that an unknown imitates are hidden.
    whole, part = asked("change.of=['150-760', '200-320']", "nuisances.light='free'", "sky={none=true}").table
    assert whole["error"] > 1e3 * whole["error_known"]
    assert part["error"] < 10 * part["error_known"]
    assert np.isinf(asked("change.of=['200-320']", "nuisances.light='free'").index_table["error"]).all()


def test_errors_of_indices_are_those_of_drawn_exposures(engine: Engine, quiet: Expectation) -> None:
    """All four indices of 10 000 drawn exposures: their scatter is known to 0.7 %, and may differ by 2 %."""
    raw = engine.realise(quiet, count=10_000, seed=3) - quiet.recorded_dn
    rows = asked("change.of=['320-700']", "nuisances.light=0.05").indices
    assert len(rows) == 4
    for row in rows:
        weights = row.weights
        assert row.error_known == pytest.approx((raw @ weights).std(), rel=0.02, abs=0)
        # Light that grows by 5 % makes the index grow by 5 %.
        expected = np.hypot(row.error_known, 0.05 * weights @ quiet.recorded_light_dn)
        assert row.error == pytest.approx(expected, rel=1e-6, abs=0)


def spread(nm: np.ndarray, flux: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Convolve a spectrum with a top hat of 10.8 nm and a Gaussian of 10.5 nm on a fine grid, independently."""
    fine = np.arange(nm[0], nm[-1], 0.02)
    square = ndimage.uniform_filter1d(np.interp(fine, nm, flux), round(10.8 / 0.02), mode="constant")
    return np.interp(at, fine, ndimage.gaussian_filter1d(square, 10.5 / np.sqrt(8 * np.log(2)) / 0.02, mode="constant"))


def test_index_and_captured_share_are_those_of_a_direct_integration() -> None:
    """H beta of a star, and a line of flux one, are spread by the line function, in the band and in the continuum."""
    table, star = asked("change.of=['H beta']", "sky={none=true}").index_table, source()
    (row,) = table[table["index"] == "H beta"]
    fine, pixels = np.arange(380.0, 590.0, 0.05), MAUVE.wavelength_nm
    line = spread(fine, np.maximum(0, 1 - np.abs(fine - 486.269) / 0.1) / 0.1, fine)
    # Per nm in place of per Angstrom; the pixel is far narrower than the line function.
    light = 10 * spread(star.wavelength_nm, star.flux_flam, pixels)
    for nm, profile, found in ((fine, line, row["captured"]), (pixels, light, row["flux"].value)):
        direct = visits.line_index(nm, profile, band_nm=(478.0, 494.0), continuum_nm=((464.0, 476.0), (496.0, 508.0)))
        assert found == pytest.approx(float(direct.flux), rel=0.01, abs=0)


def test_spectrum_from_a_file_is_measured_in_its_band(tmp_path: Path) -> None:
    hot = Source.from_library("A0V").at_magnitude(3.0)
    written(hot, tmp_path / "hot.csv")
    (row,) = asked("change.of=['spectrum']", f"change.file='{tmp_path / 'hot.csv'}'", "change.band='V'").changes
    lit = expect(hot.at_magnitude(9.0), MAUVE, exposure=50.0, sky=Sky.none())
    np.testing.assert_allclose(row.change.counts_dn, lit.net_source_dn, rtol=1e-6)


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
    """Thresholds differ by some 20 %, which moves shares by 0.03; beyond, 4 standard errors (once in 2500 seeds)."""
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0, 40, 25))
    periods, amplitudes, fap, n = np.array([1.5, 7.0, 15.0]), np.array([1.0, 1.6]), 0.05, 1000
    found = visits.recover_periods(
        time, periods, amplitudes, fap=fap, trials=100, seed=5, shortest_d=1.2, longest_d=20.0
    )
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


@pytest.mark.parametrize("limits", [(300.0, 301.0), (310.03, 317.58), (400.0, 500.0)])
def test_bands_have_the_light_between_their_edges(
    limits: tuple[float, float], quiet: Expectation, tmp_path: Path
) -> None:
    """Compare the share of a flat spectrum in each pixel, added up over wavelengths, with the width of the band."""
    flat = written(Source(np.linspace(150.0, 760.0, 611), np.full(611, 1e-12), "flat", "test"), tmp_path / "flat.csv")
    rows = asked(f"change.of=['{limits[0]}-{limits[1]}', '150-760']", star=flat).changes
    part, whole = (row.change.counts_dn for row in rows)
    # Each pixel has the band's share of its line function, whose sum over pixels is the band's width.
    share = part / whole * np.gradient(quiet.wavelength_nm)
    assert float(share.sum()) == pytest.approx(limits[1] - limits[0], rel=2e-4)
    centre = float(share @ quiet.wavelength_nm / share.sum())
    assert centre == pytest.approx(sum(limits) / 2, abs=1e-3)


@pytest.mark.parametrize(("name", "edge"), [("balmer jump", 364.6), ("colour", 450.0)])
def test_changes_below_an_edge_end_there(name: str, edge: float) -> None:
    """Compare with the same change as a band; a colour is not linear, and a few magnitudes on a faint star."""
    changes = asked(f"change.of=['{name}', '150-{edge}']", star="library='M3V', magnitude=16").changes
    (below, band), (change, light) = zip(*((row.change.counts_dn, row.smallest.one) for row in changes), strict=True)
    unit = 0.4 * np.log(10.0) if name == "colour" else 1.0
    np.testing.assert_allclose(below, unit * band, rtol=1e-9, atol=1e-9 * band.max())
    assert change == pytest.approx(2.5 * np.log10(1.0 + light) if name == "colour" else light, rel=1e-6)
    assert change < 10.0 or name != "colour"


@pytest.mark.parametrize(
    ("magnitude", "none", "marked"),
    [(-1.0, {"Ca II", "H beta", "H alpha", "320-700"}, {"Mg II", "balmer jump", "200-320", "colour"}),
     (0.75, set(), {"H beta", "320-700", "colour"}), (6.0, set(), set())],
)  # fmt: skip
def test_rows_with_saturated_pixels_are_marked(magnitude: float, none: set[str], marked: set[str]) -> None:
    answer = change(paper(f"star=[{{library='G2V', magnitude={magnitude}}}]"))
    for row in answer.changes:
        name = row.change.name
        assert np.isnan(row.error) == (name in none)
        assert ("saturate" in row.note) == (name in none | marked), row.note
    for index in answer.indices:
        lost = index.index.name in none | marked
        assert np.isnan(index.value) == np.isnan(index.error) == lost
        assert bool(index.note) == lost
    assert not any("HIDDEN" in text for text in answer.messages)


def test_straight_continuum_is_removed_exactly_and_a_batch_equals_single_spectra() -> None:
    nm = np.linspace(270.0, 290.0, 201)
    for slope in (0.0, 0.3):
        found = visits.line_index(nm, 5.0 + slope * (nm - 280) + 2 * stats.norm.pdf(nm, 280.0, 0.3), **MG_II)
        assert found.flux == pytest.approx(2.0, abs=2e-6)
        assert found.equivalent_width_nm == pytest.approx(0.4, abs=1e-5)
        assert np.isnan(found.error)
    rng = np.random.default_rng(1)
    flux, error = 5.0 + rng.normal(0, 0.1, (4, nm.size)), rng.uniform(0.05, 0.2, (4, nm.size))
    error[2, 60] = np.nan
    found = visits.line_index(nm * u.nm, flux, error, **MG_II)
    for k in range(4):
        one = visits.line_index(nm, flux[k], error[k], **MG_II)
        assert (found.flux[k], found.error[k]) == pytest.approx((one.flux, one.error), rel=1e-12)


def test_mg_ii_of_au_mic_lies_in_the_published_range() -> None:
    """20 IUE spectra: 0.6-3.5e-12 erg/s/cm2, median 3.0e-12; formal errors from 1e-13, of long exposures, to 5e-13."""
    found = []
    for path in sorted((Path(__file__).parents[1] / "data" / "flares" / "aumic_iue").glob("lp*.txt")):
        angstrom, flux, error = np.loadtxt(path, skiprows=19, usecols=(0, 1, 2)).T
        # Per nm, so that the index is a flux.
        one = visits.line_index(angstrom / 10, 10 * flux, 10 * error, **MG_II)
        found.append((float(one.flux), float(one.error)))
    flux, error = np.array(found).T
    assert flux.size == 20
    assert [round(float(1e12 * x), 1) for x in (flux.min(), np.median(flux), flux.max())] == [0.6, 3.0, 3.5]
    assert 7e-14 < error.min() < 1e-13
    assert error.max() < 5e-13


@pytest.mark.long
def test_the_answer_tells_a_flare_from_a_change_of_throughput() -> None:
    rng = np.random.default_rng(299)
    star, blue, shape, loss = np.linspace(100.0, 900.0, 40), np.linspace(300.0, 50.0, 40), np.zeros(300), np.ones(300)
    shape[80:100] = np.exp(-np.arange(20) / 6.0)
    loss[200:215] = 1.15
    mean = (star + shape[:, None] * blue) * loss[:, None]
    error, nm = np.full(mean.shape, 15.0), np.linspace(200.0, 700.0, 40)
    events = analysed(Frames.of(np.arange(300) * 60.0, rng.normal(mean, error), error, wavelength_nm=nm)).events
    flare, change = (next(row for row in events if row["istart"] <= at <= row["istop"]) for at in (82, 205))
    assert flare["blue_over_red"] > 2
    assert flare["p_no_colour"] < 1e-6
    assert abs(change["blue_over_red"] - 1) < 4 * change["blue_over_red_error"]
    assert change["p_no_colour"] > 1e-4


def test_analyse_lists_for_each_event_the_flares_that_raise_the_light_as_much(tmp_path: Path) -> None:
    """The light of a flare of unit amplitude on each star, made by hand, says how large it must be."""
    (tmp_path / "near.csv").write_text("name,separation,magnitude,spectral_type\nB,8,10,M4V\nC,30,12,G2V\nD,60,1,A0V\n")
    star = {"library": "M3V", "magnitude": 9.0, "neighbours": tmp_path / "near.csv", "neighbour_share": 0.8}
    study = Study.model_validate({"star": [star], "search": {"per": "day"}})
    light = np.full(400, 1000.0)
    light[200:206] += [400, 300, 200, 120, 60, 30]
    answer = analyse(study, frames=noisy(3, np.arange(400) * 60.0, light, 5.0))
    n, table = len(answer.events), answer.tables["neighbour-flares"]
    assert n >= 1
    assert table["star"].tolist() == ["M3V V = 9", "B", "C"] * n
    stars = [source(*one) for one in (("M3V", 9.0), ("M4V", 10.0), ("G2V", 12.0))]
    every, shares = (stars, [one.flaring(1.0) for one in stars]), np.array([1.0, 0.8, 0.8])
    light, lit = ([expect(one, MAUVE, exposure=50.0).source_electrons.sum() for one in some] for some in every)
    rise = shares * np.subtract(lit, light) / (shares @ light)
    np.testing.assert_allclose(table["amplitude"], table["ampl_rec"] / np.tile(rise, n), rtol=1e-9)
    duration = [one.fitted_s for one in answer.analysis.events for _ in stars]
    np.testing.assert_allclose(table["equivalent_duration"].to_value("s"), duration / np.tile(rise, n), rtol=1e-9)
    assert "neighbours.ecsv" in answer.files
    assert any("assumption: 80 % of it enters" in text for text in answer.messages)
