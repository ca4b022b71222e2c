"""Injections, compared with flares put into pixels by NumPy, with the theory's gains, and by recovery."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from scipy import special
from searches import DAVENPORT, KNOWN, ONE, consecutive_alarms, spectra, survey

from mauvecl import CosmicRays, Processes, Stare, Stares
from mauvecl.lightcurve.search import injection_sites
from mauvecl.lightcurve.search.bank import Bank, Baseline
from mauvecl.lightcurve.search.counted_rate import consecutive_alarm_rate
from mauvecl.lightcurve.search.flare_fit import SingleFlareFit
from mauvecl.lightcurve.search.importance_sampling import sample_rate
from mauvecl.lightcurve.search.injection_sites import OVERLAP, sites_of
from mauvecl.lightcurve.search.injections import Injections
from mauvecl.lightcurve.search.search import Search
from mauvecl.results.requests.requests import Shard
from mauvecl.runs.shards import fingerprint

#: What a bank's weakest found flares are, in sigma of a frame; half of them are found (C; +-5 %).
TABLE = {10.0: (7.58, 5.43), 30.0: (4.39, 2.66), 60.0: (3.65, 1.90), 300.0: (2.91, 0.844)}


@pytest.fixture(scope="module")
def day():
    """Return the bank of the theory's table and its threshold at the rate of three points above three sigma."""
    # A hundred draws: 0.015 of standard error.
    bank = Bank(tuple(30.0 * 2**k for k in range(8)), ONE, DAVENPORT, 5.0, KNOWN)
    return bank, sample_rate(Search(bank, Stare.of(86_400.0)), seed=1, draws=100).threshold(
        consecutive_alarm_rate(3, 3.0, 5.0)
    ).value  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("half_width", TABLE)
def test_half_are_found_at_the_critical_amplitude(day, half_width):
    """Compare with the table to 5 %; the median of 1000 amplitudes is known to 0.7 %, which fails once in 10^6."""
    bank, cut = day
    rng = np.random.default_rng(int(half_width))
    n, frames = 1000, 300 if half_width < 100 else 700
    peaks = 500.0 + 5.0 * rng.random(n)
    flares = DAVENPORT.mean_over(np.arange(frames + 1) * 5.0, peaks[:, None], half_width)
    noise = rng.standard_normal((n, frames))
    # Three consecutive points: the amplitude from which on the lowest of them is above.
    with np.errstate(divide="ignore"):
        each = np.where(flares > 1e-12, (3.0 - noise) / flares, np.inf)
    run = np.maximum(np.maximum(each[:, :-2], each[:, 1:-1]), each[:, 2:])[:, 90:]
    in_row = np.median(np.maximum(run.min(axis=1), 0))
    assert consecutive_alarms(noise[0] + 1.001 * max(run[0].min(), 0) * flares[0], 3, 3.0).any()
    # The bank: values are linear in the amplitude.
    search = Search(bank, Stare.of(frames * 5.0))
    critical = np.full(n, np.inf)
    for (row, a), (_, b) in zip(search.values(noise[:, :, None]), search.values(flares[:, :, None]), strict=True):
        near = (row.per_amplitude > 0) & (np.abs(row.peaks * 5.0 - 500) < 2 * max(half_width, 60))
        if not near.any():
            continue
        rise = b[:, 0, near]
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.where(rise > 0.1 * rise.max(), (cut - a[:, 0, near]) / rise, np.inf)
        critical = np.minimum(critical, root.min(axis=1))
    assert in_row == pytest.approx(TABLE[half_width][0], rel=0.05)
    assert np.median(critical) == pytest.approx(TABLE[half_width][1], rel=0.05)


STARE = Stare.of(900.0, gaps=[(600, 640)], jitters={"light": 0.01})
LEVEL = Baseline(window_s=400.0)
#: Rays that add about as much noise again as the frames have.
RAYS = CosmicRays(rate_per_cm2_s=200.0)
#: Half-widths and amplitudes.
CELLS = [(15.0, 0.055), (15.0, 0.07), (40.0, 0.035), (40.0, 0.05), (90.0, 0.034)]
POSITIONS, DRAWS = 60, 40


@pytest.fixture(scope="module")
def stares():
    return Stares()


@pytest.fixture(scope="module")
def injections():
    """Return injections into a jittered stare with a gap, for a bank of three half-widths."""
    one, _ = survey(STARE, LEVEL, (15.0, 40.0, 110.0), part=True)
    return Injections(one, 0, (15.0, 40.0, 90.0), 5.2, 3, POSITIONS, DRAWS)


def pixel_injection(one, half_width, amplitude, peaks, rng, rays):
    """Draw sums of frames with a flare pixel by pixel from the instrument's means, with NumPy alone."""
    quiet, (flare,) = spectra("G2V", 7.4, (10_000.0,), part=True)
    edges = np.column_stack([STARE.start_s, STARE.start_s + 5])
    shape = (STARE.n_frames, quiet.dark_dn.size)
    rows = []
    for peak in peaks:
        course = DAVENPORT.mean_over(edges, peak, half_width)[:, None]
        level = 1 + 0.01 * rng.standard_normal((STARE.n_frames, 1))
        light = level * (quiet.light_dn + amplitude * course * flare)
        dark = rng.poisson(quiet.dark_dn, shape)
        noise = np.sqrt(quiet.gain_dn_per_electron * light + quiet.read_noise_dn**2)
        hits = np.zeros(shape)
        if rays is not None:
            rate = rays.rate_per_cm2_s * 5.0 * rays.area_cm2 / rays.pixels
            where = rng.choice(hits.size, rng.poisson(rate * hits.size))
            np.add.at(hits.ravel(), where, rng.integers(500, 1000, where.size, endpoint=True))
        hits *= quiet.gain_dn_per_electron
        raw = np.rint(light + dark + noise * rng.standard_normal(shape, np.float32) + hits + quiet.bias_dn)
        rows.append((raw - quiet.mean_raw_dn) @ one.components.weights.T)
    return np.array(rows)


def all_filters(one):
    """Compute every template of the bank by least squares, shape (n_filter, n_frame)."""
    bank, numbers = one.bank, STARE.numbers
    found = []
    for t in bank.templates:
        for phase, p in enumerate(t.phases):
            whole = t.shapes[phase] - np.polyval(np.polyfit(t.time, t.shapes[phase], 1), t.time)
            for peak in range(0, int(numbers[-1]) + 1, t.stride):
                at = numbers - peak
                inside = (at >= t.first) & (at < t.first + t.time.size)
                edges = np.column_stack([at, at + 1])[inside] * 5.0
                line = np.vander(at[inside] / 100.0, 2)
                shape = DAVENPORT.mean_over(edges, p * 5.0, t.half_width_s)
                left = shape - line @ np.linalg.lstsq(line, shape, rcond=None)[0]
                if left @ left >= 0.25 * (whole @ whole):
                    row = np.zeros(numbers.size)
                    row[inside] = left / np.linalg.norm(left)
                    found.append(row)
    return np.array(found)


@pytest.mark.long
@pytest.mark.parametrize("rays", [None, RAYS], ids=["no rays", "cosmic rays"])
def test_completeness_of_five_cells_agrees_with_numpy(injections, stares, rays):
    """Compare single cells and all together with NumPy alone; six times 4 standard errors fail once in 10^3 runs.

    All together notice flares that come out a sixth too bright, and frames without the rays.
    """
    one, injections = injections.survey, replace(injections, processes=Processes(cosmic_rays=rays))
    rng = np.random.default_rng(9)
    n = 100
    critical = np.stack([stares.reduced(injections.request(p))["critical"] for p in range(POSITIONS)])
    filters = all_filters(one)
    scale = np.sqrt(one.variance.mean())
    edges = np.column_stack([STARE.start_s, STARE.start_s + 5])
    along = one.bank.directions @ injections.response
    off, spread = [], []
    for half_width, amplitude in CELLS:
        peaks = rng.choice(STARE.start_s, n) + 5 * rng.random(n)
        sums = pixel_injection(one, half_width, amplitude, peaks, rng, rays)
        values = np.einsum("ft,ntk,dk->nfd", filters, sums / scale, one.bank.directions, optimize=True)
        clean = DAVENPORT.mean_over(edges, peaks[:, None], half_width) @ filters.T
        # What counts as this flare's: templates with a share of what the best one would see of it.
        overlap = clean[:, :, None] * along
        counts = overlap >= OVERLAP * overlap.max(axis=(1, 2), keepdims=True)
        theirs = np.mean(np.where(counts, values, -np.inf).max(axis=(1, 2)) >= injections.threshold)
        each = np.mean(critical[:, :, injections.half_widths_s.index(half_width)] <= amplitude, axis=1)
        ours = each.mean()
        assert 0.02 < ours < 0.98
        off.append(ours - theirs)
        spread.append(np.hypot(np.sqrt(ours * (1 - ours) / n), each.std(ddof=1) / np.sqrt(POSITIONS)))
    assert (np.abs(off) < 4 * np.array(spread)).all(), off
    assert abs(np.sum(off)) < 4 * np.linalg.norm(spread), off


def test_draws_are_common_and_addressed_by_counter(injections, stares):
    """Check that draws depend neither on the half-widths nor on the part of the stares, to the last bit."""
    asked = injections.request(4)
    every = stares.reduced(asked)["critical"]
    alone = stares.reduced(replace(injections, half_widths_s=(40.0,)).request(4))["critical"]
    assert np.abs(every[:, 1] / alone[:, 0] - 1).max() < 1e-4
    parts = [
        stares.reduced(asked, Shard(0, asked.start + a, b - a))["critical"] for a, b in ((0, 1), (1, 23), (23, 40))
    ]
    np.testing.assert_array_equal(np.concatenate(parts), every)
    assert fingerprint(pickle.loads(pickle.dumps(asked))) == fingerprint(injections.request(4))
    assert fingerprint(asked) != fingerprint(replace(injections, threshold=5.3).request(4))


@pytest.mark.parametrize("seed", range(6))
def test_filters_of_all_flares_equal_those_of_each_alone(injections, seed, monkeypatch):
    """Filter random flares together, and each in the frames around it."""
    rng = np.random.default_rng([26, seed])
    widths = tuple(np.sort(10 ** rng.uniform(0.8, 2.5, 4)))
    peak = float(rng.uniform(-50.0, 950.0))
    together = sites_of(injections.survey, widths, peak, injections.response)
    monkeypatch.setattr(injection_sites, "WHOLE", 0)
    for width, site in zip(widths, together, strict=True):
        (alone,) = sites_of(injections.survey, (width,), peak, injections.response)
        assert (site.half_width_s, site.peak_s, site.first) == (width, peak, alone.first)
        np.testing.assert_array_equal(site.counts, alone.counts)
        np.testing.assert_array_equal(site.widths_s, alone.widths_s)
        np.testing.assert_array_equal(site.peaks_s, alone.peaks_s)
        np.testing.assert_array_equal(site.mean, alone.mean)
        # Filters are rounded to multiples of a step: sums in another order may round one to the next.
        np.testing.assert_allclose(site.filters, alone.filters, rtol=0, atol=1.01 * injection_sites.STEP)


@dataclass(frozen=True)
class Kept:
    """Reduction that keeps its arguments."""

    adds: ClassVar[bool] = False

    def __call__(self, values, first, glow):
        return {"values": values.copy(), "glow": glow.copy()}


def drawn_at(injections, stares, position):
    """Return the outcome of a position's stares and their draws."""
    asked = injections.request(position)
    held = stares.reduced(replace(asked, reduction=Kept()))
    return asked.reduction, asked.reduction.frame_noise(held["values"], held["glow"])


def test_critical_amplitude_agrees_with_the_search(injections, stares):
    """Check that the largest value reaches the threshold just above this amplitude, but not just below it."""
    injecting, drawn = drawn_at(injections, stares, 11)
    critical = stares.reduced(injections.request(11))["critical"].T
    for site, roots in zip(injecting.sites, critical, strict=True):
        for k, root in enumerate(roots):
            above, below = (injecting.best(site, drawn, np.array([root * f]))[0][0, k] for f in (1.001, 0.999))
            assert (above >= injections.threshold > below) or root == 0


def test_sums_equal_those_of_the_values(injections, stares):
    """Check that the frames given to fits have the values of the search."""
    injecting, drawn = drawn_at(injections, stares, 7)
    site, amplitudes = injecting.sites[1], np.array([0.01, 0.03])
    value, direction, template = injecting.best(site, drawn, amplitudes)
    sums = injecting.sums(site, drawn, amplitudes)
    again = np.einsum("ft,antk,dk->andf", site.filters, sums, injecting.directions, optimize=True)
    rows = np.take_along_axis(again.reshape(2, DRAWS, -1), (direction * len(site.filters) + template)[:, :, None], 2)
    assert np.abs(rows[:, :, 0] - value).max() < 2e-3


@pytest.mark.long
def test_flares_equal_those_drawn_by_the_engine(injections, stares):
    """Compare means and variances of templates with frames that have the flare in every pixel.

    A flare whose own photons, and the jitter of its light, are most of the noise. Fails by chance once in 10^3 runs:
    4 standard errors of both at three half-widths.
    """
    one, injections, amplitude = injections.survey, replace(injections, draws=400), 5.0
    injecting, drawn = drawn_at(injections, stares, 20)
    window = slice(*np.searchsorted(STARE.start_s, [injecting.start_s[0], injecting.start_s[-1] + 1]))
    edges = np.column_stack([injecting.start_s, injecting.start_s + 5])
    for site in injecting.sites:
        course = amplitude * DAVENPORT.mean_over(edges, site.peak_s, site.half_width_s)
        asked = injections.request(20)
        sums = stares.frames(
            one.components, asked.stare, course[:, None], first=asked.start, count=400, seed=3, method="pixels"
        )
        net = (sums - one.known[window])[:, site.frames]
        a, b, c = injecting.values(site, drawn)
        ours = (a + amplitude * b + np.sqrt(amplitude) * c)[1]
        theirs = np.einsum("ft,ntk,k->nf", site.filters, net, one.bank.directions[1], optimize=True)
        best = int(b[1].mean(axis=0).argmax())
        x, y = ours[:, best], theirs[:, best]
        assert abs(x.mean() - y.mean()) < 4 * np.sqrt((x.var() + y.var()) / 400)
        assert abs(np.log(x.var() / y.var())) < 4 * np.sqrt(2 * 2 / 400)
        assert x.var() > 1.5 * a[1, :, best].var()


def test_sums_over_frames_are_exact(injections, stares):
    """Check that sums in float64 are exact, so that their order cannot matter."""
    injecting, drawn = drawn_at(injections, stares, 30)
    for site in injecting.sites:
        filters = site.filters.T.astype(np.float64)
        values = drawn.noise[:, :, site.frames].astype(np.float64)
        forth, back = values @ filters, values[:, :, ::-1] @ filters[::-1]
        assert len(filters) > 50
        np.testing.assert_array_equal(forth, back)
        rounded = (
            values.astype(np.float32) @ site.filters.T,
            values.astype(np.float32)[:, :, ::-1] @ site.filters.T[::-1],
        )
        assert (rounded[0] != rounded[1]).any()


@pytest.mark.long
@pytest.mark.parametrize(("half_width", "snr"), [(30.0, 30.0), (200.0, 30.0)])
def test_recovered_flares_have_their_parameters(half_width, snr):
    """Check pulls and coverage of all parameters within 4 standard errors; fails once in 10^4 runs."""
    stare = Stare.of(9000.0)
    one, templates = survey(stare, Baseline(), (12.0, 40.0, 150.0, 400.0))
    rng = np.random.default_rng(31)
    n = 150
    peaks = 4000 + 50 * rng.random(n)
    edges = np.column_stack([stare.start_s, stare.start_s + 5])
    response = Injections(one, 0, (half_width,), 5.0, 1, 1, 1).response
    amplitude = snr / np.sqrt(DAVENPORT.square_integral * half_width / 5) / np.linalg.norm(response)
    course = amplitude * DAVENPORT.mean_over(edges, peaks[:, None], half_width)
    sums = rng.standard_normal((n, stare.n_frames, response.size)) + course[:, :, None] * response + 3.0
    sums += 0.01 * stare.start_s[:, None]
    start = one.search.largest(sums)
    found = SingleFlareFit(one.bank, templates).run(
        sums, stare.start_s, peak_s=start.peak_s, half_width_s=start.half_width_s
    )
    duration = amplitude * half_width * DAVENPORT.equivalent_duration
    pulls = {
        "peak": (found.peak_s - peaks) / found.peak_error_s,
        "amplitude": np.log(found.amplitude / amplitude) * found.amplitude / found.amplitude_error,
        "half_width": np.log(found.half_width_s / half_width) * found.half_width_s / found.half_width_error_s,
        "temperature": np.log(found.temperature_k / 10_000) * found.temperature_k / found.temperature_error_k,
        "energy": np.log(found.equivalent_duration_s / duration)
        * found.equivalent_duration_s
        / found.equivalent_duration_error_s,
    }
    for name, pull in pulls.items():
        # Second order in 1 / S/N, a bias of a third of an error is allowed.
        assert abs(np.median(pull)) < 0.33 + 4 * 1.25 / np.sqrt(n), name
        covered = np.mean(np.abs(pull) < 1)
        assert abs(covered - (1 - 2 * special.ndtr(-1))) < 4 * np.sqrt(0.68 * 0.32 / n) + 0.05, name
    assert found.snr.mean() == pytest.approx(snr, rel=0.2)
