"""Spectra of the instrument with a known truth: noise, bad values, look-alikes, false alarms, limits, measurements."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
import scenes
from scipy import stats

from mauvecl import SHAPES, Frames, Study, analyse, read_frames, stare
from mauvecl.answers.analyse import frame_model
from mauvecl.observations import events, light_curve, spectra
from mauvecl.observations import frame_model as models
from mauvecl.observations import search as searches

N, FRAME_S = 720, 5.0
TIME = (np.arange(N) + 0.5) * FRAME_S
# Ten false alarms per star-day need few simulated frames.
OFTEN: Any = {"false_alarms": 10.0, "per": "day"}
STAR: Any = [{"library": "M3V", "magnitude": 9.0, "distance_pc": 5.0}]
STUDY = Study(star=STAR, search=OFTEN)


def element_frames(flux: np.ndarray, error: np.ndarray | None = None) -> Frames:
    nm = np.arange(205.25, 700.0, 10.5)[: flux.shape[1]]
    return Frames.of(TIME[: len(flux)], flux, error, exposure_s=FRAME_S, wavelength_nm=nm, unit="adu / s", name="M3V")


@cache
def model() -> Any:
    return frame_model(STUDY, element_frames(np.ones((N, 48))))


@cache
def light() -> np.ndarray:
    return np.asarray(model().bins @ model().quiet.light_dn * model().per_dn)


def flare(peak_s: float, half_width_s: float, size: float, kelvin: float = 10_000.0) -> np.ndarray:
    """Return the light of a flare whose peak adds `size` times the star's light, summed over wavelength."""
    spectrum = model().flares((kelvin,))[0]
    course = scenes.flare(TIME, FRAME_S, peak_s, half_width_s)
    return np.outer(course, size * light().sum() / spectrum.sum() * spectrum)


def drawn(rng: np.random.Generator, added: np.ndarray | float = 0.0, scale: float | np.ndarray = 1.0) -> Frames:
    """Draw frames with normal noise of the instrument's model, times a factor that the stated errors leave out."""
    mean = light() + np.broadcast_to(np.asarray(added, np.float64), (N, light().size))
    quiet = np.sqrt(model().variance(light()))
    photons = np.sqrt(quiet**2 + model().gain * np.maximum(mean - light(), 0.0))
    return element_frames(mean + photons * scale * rng.standard_normal(mean.shape), np.tile(quiet, (N, 1)))


def prepared(frames: Frames, **how: Any) -> tuple[Any, Any, Any]:
    survey, series, _ = spectra.survey_spectra(frames, model(), SHAPES["davenport2014"], 3, 1, **how)
    return series.cleaned, survey, series


def survey_of_spectra(rng: np.random.Generator) -> Any:
    return prepared(drawn(rng))[1]


def survey_of_light(rng: np.random.Generator) -> Any:
    """Return a survey of 600 frames of a minute with white noise."""
    frames = scenes.noisy(rng, np.arange(600) * 60.0, np.full(600, 1000.0), 5.0)
    return light_curve.survey_light_curve(frames, SHAPES["davenport2014"], 1)[0]


@cache
def threshold_of(survey_of: Any, rate: float) -> float:
    """Return the threshold above which noise has a rate of events per star-day."""
    survey = survey_of(np.random.default_rng(1))
    rates = searches.simulated_rates(survey, np.ones(survey.stare.n_frames, np.bool_), rate, 1)
    return max(one.threshold(rate) for one in rates)


@cache
def analysed_counts() -> tuple[Frames, Any]:
    frames = drawn(np.random.default_rng(4), flare(1800.0, 60.0, 0.5))
    return frames, analyse(STUDY, frames=frames)


@pytest.mark.long
@pytest.mark.parametrize("unit", ["W / (m2 um)", "Jy"])
def test_flux_densities_are_searched_by_their_spectrum_as_counts_are(unit: str) -> None:
    """Calibrated by a hot standard star; the same draws have the same S/N to 2 %, as only the templates differ."""
    counts, one = analysed_counts()
    nm = counts.wavelength_nm
    standard = Study(star=[{"library": "B2IV", "magnitude": 9.0}])
    there = frame_model(standard, counts)
    source = standard.star[0].source()
    edges = np.column_stack([nm - 5.25, nm + 5.25])
    mean = [np.interp(np.linspace(*edge, 200), source.wavelength_nm, source.flux_flam).mean() for edge in edges]
    values = (np.array(mean) * u.Unit("erg / (s cm2 Angstrom)")).to_value(u.Unit(unit), u.spectral_density(nm * u.nm))
    electrons = there.quiet.n_frames * there.quiet.source_electrons
    factor = values / (there.bins @ (electrons * there.quiet.gain_dn_per_electron) * there.per_dn)
    fluxes = replace(counts, flux=counts.flux * factor, error=counts.error * factor, unit=unit)
    other = analyse(STUDY, frames=fluxes)
    row, same = (max(answer.rows, key=lambda each: each.event.value) for answer in (one, other))
    assert row.verdict == same.verdict == "detected"
    assert same.event.value == pytest.approx(row.event.value, rel=0.02)
    assert abs(same.event.brightest - row.event.brightest) <= 1
    for name in ("temperature", "energy bolometric"):
        _, low, high = row.quantity(name)
        assert low < same.quantity(name)[0] < high, name


@pytest.mark.parametrize(
    ("unit", "same", "factor"),
    [("DN/sec", "adu / s", 1.0), ("ADU s^-1", "adu / s", 1.0), ("adu.s-1", "adu/s", 1.0), ("adu/min", "adu / s", 60.0),
     ("erg/s/cm2/A", "erg / (s cm2 Angstrom)", 1.0), ("FLAM", "erg / (s cm2 Angstrom)", 1.0), ("JY", "Jy", 1.0)],
)  # fmt: skip
def test_units_of_spectra_may_have_any_usual_spelling(unit: str, same: str, factor: float) -> None:
    frames = drawn(np.random.default_rng(4))
    one, other = (frame_model(STUDY, replace(frames, unit=name)) for name in (same, unit))
    np.testing.assert_allclose(other.per_dn, factor * one.per_dn, rtol=1e-12)


def test_spectra_in_magnitudes_are_no_flux_densities() -> None:
    assert "unit must be one of" in frame_model(STUDY, replace(drawn(np.random.default_rng(4)), unit="ABmag"))


@pytest.mark.long
def test_noise_per_pixel_lies_within_its_range_and_sums_have_covariance_one_however_errors_are_stated() -> None:
    """95 % of pixels are within their ranges; the binomial bound fails by chance once in ten thousand times.

    In the last frames the noise is 1.4 times what is stated. Covariances have standard errors of 0.05, 5 allowed.
    """
    rng = np.random.default_rng(300)
    found = [prepared(drawn(rng, scale=scale)) for scale in (*np.ones(12), 1.4)]
    noises = [series.noise for *_, series in found[:-1]]
    outside = sum(int(((one.measured < one.low) | (one.measured > one.high)).sum()) for one in noises)
    low, high = stats.binom.ppf([5e-5, 1 - 5e-5], sum(one.measured.size for one in noises), 0.05)
    assert low <= outside <= high
    for _, survey, _ in found[-2:]:
        steps = np.diff(survey.sums / np.sqrt(survey.variance)[:, None], axis=0) / np.sqrt(2)
        np.testing.assert_allclose(steps.T @ steps / len(steps), np.eye(steps.shape[1]), atol=5 * 0.05)
    searched = [rho for _, survey, _ in found[:5] for _, rho in survey.search.values(survey.sums[None])]
    # The mean square of all statistics has a standard error of 0.06.
    assert np.mean(np.concatenate([rho[np.isfinite(rho)] for rho in searched]) ** 2) == pytest.approx(1.0, abs=0.3)
    scale = np.where(np.arange(light().size) == 20, 1.5, 1.0)
    noise = prepared(drawn(rng, scale=scale))[2].noise
    assert np.flatnonzero(noise.departs).tolist() == [20]
    assert noise.used[20] / noise.stated[20] == pytest.approx(1.5, rel=0.1)


def test_jitter_of_the_dark_current_and_drifts_are_measured_and_marginalised_over() -> None:
    """Next to changes of the light, which are ten times as large and not taken for it."""
    rng, unknown = np.random.default_rng(302), model().unknowns(light())
    added = sum(np.outer(sd * rng.standard_normal(N), unknown[of]) for of, sd in (("dark", 0.2), ("light", 0.3)))
    _, survey, series = prepared(drawn(rng, added))
    assert set(series.jitters) == {"light", "dark"}
    # A standard deviation of 720 values has a standard error of 2.6 %, and of the noise next to it.
    assert series.jitters["dark"] == pytest.approx(0.2, rel=0.25)
    # What is marginalised over moves the sums no more than their unit variance says.
    assert survey.sums.std(axis=0).max() < 1.15
    # Drifts next to a short event, of which one part of eight lacks its frames, have the same standard errors.
    _, survey, series = prepared(drawn(np.random.default_rng(320)))
    short = np.isin(survey.stare.numbers, range(200, 210))
    without, with_event = (spectra.drifts(survey, series, taken, N // 8) for taken in (short & False, short))
    for name in ("light", "dark"):
        assert with_event[name] == pytest.approx(without[name], rel=0.3)


@pytest.mark.parametrize("loss", [0.0005, 0.1])
def test_statistics_do_not_depend_on_changes_of_the_light_however_small(loss: float) -> None:
    """The noise model and the mean spectrum are estimated from the frames and differ by some of the loss."""
    at, frames = np.random.default_rng(317).random(N) < 0.3, drawn(np.random.default_rng(318))
    maxima = []
    for lost in (0.0, loss):
        flux = frames.flux - lost * np.outer(at, light())
        _, survey, series = prepared(element_frames(flux, frames.error))
        assert series.jitters == {"light": np.inf}
        maxima.append(survey.search.largest(survey.sums[None])[0])
        # Two amplitudes, of flare and star, are fitted to a frame: the closed form of their covariance.
        flares = model().flares(survey.templates.temperatures_k) / series.noise.used
        star = series.light / series.noise.used
        correlations = flares @ star / np.linalg.norm(flares, axis=1) / np.linalg.norm(star)
        assert series.snr_kept == pytest.approx(np.median(np.sqrt(1 - correlations**2)), abs=1e-9)
    assert maxima[1] == pytest.approx(maxima[0], abs=0.01 + 2 * loss)
    assert prepared(frames, jitters={"light": 1e-6})[2].snr_kept == pytest.approx(1.0, abs=1e-6)


def test_cosmic_rays_are_replaced_and_counted_and_flares_are_not() -> None:
    rng = np.random.default_rng(303)
    clean = drawn(rng, flare(2000.0, 60.0, 0.8))
    flux, sd = clean.flux.copy(), clean.error[0]  # type: ignore[index]
    hits = rng.choice(N, 30, replace=False)
    pixels = rng.integers(light().size, size=30)
    flux[hits, pixels] += rng.uniform(12, 80, 30) * sd[pixels]
    cleaned = models.clean_spectra(element_frames(flux, clean.error), model())
    # Pixels next to one another in time are light, not rays.
    assert 28 <= (cleaned.rays[hits] > 0).sum() <= cleaned.rays.sum() <= 31
    assert models.clean_spectra(clean, model()).rays.sum() <= 1
    left = np.abs(cleaned.frames.flux - clean.flux)[hits, pixels] / sd[pixels]
    assert np.median(left) < 2.0


def raw_counts(seed: int, n: int) -> np.ndarray:
    quiet = model().quiet
    size = (n, quiet.wavelength_nm.size)
    return np.random.default_rng(seed).normal(quiet.recorded_dn, np.sqrt(quiet.variance_dn2), size)


def raw_frames(flux: np.ndarray) -> Frames:
    how: Any = {"exposure_s": FRAME_S, "wavelength_nm": model().quiet.wavelength_nm, "unit": "adu"}
    return Frames.of(TIME[: len(flux)], flux, **how)


@pytest.mark.long
def test_saturated_pixels_and_missing_errors_of_raw_frames_are_stated() -> None:
    raw, quiet = raw_counts(304, 120), model().quiet
    raw[50:53, 900] = quiet.ceiling_dn
    answer = analyse(STUDY, frames=raw_frames(raw))
    reasons = [str(text) for text in answer.frames["reason"]]
    assert [k for k, text in enumerate(reasons) if "saturated" in text] == [50, 51, 52]
    assert any("state no errors" in message for message in answer.messages)
    # The noise that the instrument's model states is that of the draws: its mean over pixels to half a per cent.
    ratio = np.asarray(answer.pixels["measured"] / answer.pixels["stated"])
    assert ratio.mean() == pytest.approx(1.0, abs=0.005)


def test_counts_with_and_without_bias_and_dark_current_are_distinguished() -> None:
    """Relative sizes of flares depend on it: bias and dark current are a hundred times the light of this star."""
    raw, quiet, levels = raw_counts(312, 40), model().quiet, list[float]()
    elements = np.add.reduceat(raw, np.flatnonzero(np.diff(quiet.element, prepend=-1)), axis=1)
    summed = replace(raw_frames(raw), flux=elements, wavelength_nm=quiet.element_wavelength_nm)
    for frames in (raw_frames(raw), summed, raw_frames(raw - quiet.bias_dn - quiet.dark_dn)):
        found = frame_model(STUDY, frames)
        assert found.raw == (np.median(frames.flux) > np.median(quiet.bias_dn))
        levels.append(float(np.median(models.clean_spectra(frames, found).frames.white_light[0])))
        # A star far brighter than bias and dark current, which are known to be subtracted.
        assert not frame_model(STUDY, replace(frames, net=True)).raw
    assert levels[1:] == pytest.approx(levels[:2], rel=1e-6)
    # The noise of 40 frames is 1 % of the light.
    assert levels[0] == pytest.approx(quiet.light_dn.sum(), rel=0.06)


@pytest.mark.parametrize("exposure_s", [3.0, 5.00002, 12.0, 50.0])
def test_light_of_a_second_is_that_of_frames_of_any_exposure(exposure_s: float) -> None:
    """Also where an exposure is no multiple of the instrument's frames, such as by the rounding of its times."""
    frames = element_frames(np.ones((N, 48)))
    other = frame_model(STUDY, replace(frames, exposure_s=np.full(N, exposure_s)))
    quiet = other.bins @ other.quiet.light_dn * other.per_dn
    assert quiet == pytest.approx(light(), rel=1e-9)
    # The variance of two exposures, and what a raw one has besides the star.
    two = other.exposure(quiet, other.variance(quiet), 2)
    assert two.variance_dn2 * other.per_dn**2 == pytest.approx(2 * other.variance(quiet), rel=1e-9)
    raw = replace(other, raw=True)
    dark = other.quiet.recorded_dn - other.quiet.light_dn
    assert raw.offset == pytest.approx(other.bins @ dark * other.per_dn, rel=1e-9)
    # A degree warms the dark current of all the time.
    assert raw.unknowns(quiet)["dark"] == pytest.approx(model().unknowns(light())["dark"], rel=1e-9)


@pytest.mark.long
def test_dark_current_one_pixel_of_several_frames_and_single_frames_are_no_flares() -> None:
    """A detector that is warm for five minutes; only weighted sums show the single frame of ultraviolet light."""
    shape = flare(1800.0, 90.0, 1.0).sum(axis=1) / light().sum()
    added, ultraviolet = 1.5 * np.outer(shape, model().unknowns(light())["dark"]), model().flares((30_000.0,))[0]
    added[100:106, 5] += 12 * np.sqrt(model().variance(light())[5])
    added[650] += 9 / np.sqrt((ultraviolet**2 / model().variance(light())).sum()) * ultraviolet
    study = Study(star=STAR, search=OFTEN | {"frame": {"light": 1e-6}})
    answer = analyse(study, frames=drawn(np.random.default_rng(305), added))
    analysis = answer.analysis
    event, found = max(zip(analysis.events, analysis.event_spectra, strict=True), key=lambda pair: pair[0].value)
    assert abs(analysis.survey.time_s[event.brightest] - 1800.0) < 60
    assert event.kind == found.cause == "dark current"
    assert found.reason
    assert [event.kind for event in analysis.events if event.first <= 105 and event.last >= 100] == ["cosmic ray"]
    assert str(answer.frames["reason"][650]) == "spike"


@pytest.mark.long
@pytest.mark.parametrize(("survey_of", "rate", "number", "seed"), [
    (survey_of_spectra, 20.0, 60, 308), (survey_of_light, 2.0, 250, 290),
], ids=["spectra", "light"])  # fmt: skip
def test_false_alarms_are_as_many_as_promised(survey_of: Any, rate: float, number: int, seed: int) -> None:
    """Level, noise and jitters are estimated from the frames; fails by chance once in a thousand times."""
    rng, count, days = np.random.default_rng(seed), 0, 0.0
    for _ in range(number):
        survey = survey_of(rng)
        count += len(events.detect_events(survey, threshold_of(survey_of, rate))[0])
        days += survey.stare.observed_s / 86_400
    # The threshold has a standard error of some 3 %, and an estimated noise makes alarms more frequent: by
    # exp(u^2 s^2 / 2) u^2 of 4 % in the noise.
    low, high = stats.poisson.ppf([0.0005, 0.9995], rate * days)
    assert 0.9 * low < count < 1.15 * high


@pytest.mark.long
def test_intervals_of_temperature_and_energy_cover() -> None:
    """Flares of S/N 20-100 on a star that drifts by 5 % an hour; each bound fails once in a thousand times."""
    # Intervals allow for drifts that noise may hide: those of 68 % may cover 90 %; without, 53 % held the truth.
    rng = np.random.default_rng(310)
    number, pulls = 24, {"temperature": list[float](), "energy bolometric": list[float]()}
    inside = {name: np.zeros(2) for name in pulls}
    for _ in range(number):
        kelvin, size = rng.uniform(7000, 15_000), rng.uniform(0.5, 2.0)
        added = flare(rng.uniform(900, 2700), rng.uniform(30, 90), size, kelvin)
        drift = rng.choice([-0.05, 0.05]) * (TIME - TIME.mean()) / 3600
        _, survey, series = prepared(drawn(rng, added + np.outer(drift, light())))
        found, taken = events.detect_events(survey, threshold_of(survey_of_spectra, 20.0))
        one = max(found, key=lambda each: each.value)
        assert spectra.event_spectrum(survey, series, taken, one).cause == "flare"
        measured = spectra.measure_flare(survey, series, taken, one)
        # What the flare adds in the frames of the event: its part of the amplitude, of the model's energy of a frame.
        flares = model().flare.values(kelvin, [1.0])
        frame = model().flares((kelvin,))[0].sum()
        kept = np.isin(TIME, survey.time_s[one.first : one.last + 1])
        truth = {"temperature": kelvin,
                 "energy bolometric": flares["energy bolometric"] * added[kept].sum() / frame}  # fmt: skip
        for name, value in truth.items():
            k = measured.column(name)
            lows, highs, estimate = measured.low[:2, 0, k], measured.high[:2, 0, k], measured.estimates[0, k]
            inside[name] += (lows <= value) & (value <= highs)
            pulls[name].append((value - estimate) / abs((highs if value > estimate else lows)[0] - estimate))
    low = stats.binom.ppf(0.0005, number, [0.6827, 0.95])
    high = stats.binom.ppf(0.9995, number, [0.9, 1.0])
    assert all(((low <= count) & (count <= high)).all() for count in inside.values()), inside
    most = stats.chi2.ppf(0.999, number)
    assert all(np.sum(np.square(values)) < most for values in pulls.values()), pulls


@pytest.mark.parametrize(("degrees", "reason"), [(0.1, ""), (0.3, "a change of the instrument alone fits")])
def test_flare_of_one_temperature_fits_while_the_dark_current_drifts(degrees: float, reason: str) -> None:
    drift = np.outer(degrees * ((TIME - 900.0) / 900.0) ** 2, model().unknowns(light())["dark"])
    _, survey, series = prepared(drawn(np.random.default_rng(331), flare(1800.0, 60.0, 2.0) + drift))
    found, taken = events.detect_events(survey, 5.0)
    one = max(found, key=lambda each: each.value)
    assert spectra.event_spectrum(survey, series, taken, one).reason[: len(reason) or None] == reason


@pytest.mark.long
def test_answer_states_measurements_or_why_there_are_none() -> None:
    frames, answer = analysed_counts()
    # Frames of other wavelengths or units are searched in white light.
    for key, changed in (("unit", {"unit": "K"}), ("wavelength", {"wavelength_nm": frames.wavelength_nm + 7})):
        white = analyse(STUDY, frames=replace(frames, **changed))  # type: ignore[arg-type]
        assert white.analysis.spectra is None
        (line,) = (one for one in white.messages if "searched as their sum over wavelength" in one)
        assert key in line
    k = int(np.argmax([row.event.value for row in answer.rows]))
    # The printed table of events fits into 80 columns, with the lines of a terminal.
    assert max(map(len, str(answer.views[0]).splitlines()[1:])) <= 73
    unnamed = analyse(Study(search=OFTEN), frames=frames)
    event = unnamed.events[k]
    assert np.isnan(event["energy"])
    assert "distance" in event["unmeasured"]
    assert "amplitude" in set(answer.measured["quantity"]) - set(unnamed.measured["quantity"]), "of which star"
    # The flux of a flare does not depend on the star.
    assert event["temperature"].value == pytest.approx(answer.events["temperature"][k].value, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize(("rise", "search", "expected", "said"), [
    (0.3, {}, {900.0: None, 2900.0: "detected"}, "search.frame.light states"),
    (0.0, {"frame": {"light": 1e-6}}, {900.0: None, 1800.0: "detected", 2900.0: "detected"}, ""),
    (0.3, {"frame": {"light": 1e-6}}, {900.0: "rejected", 1800.0: "candidate", 2900.0: "detected"}, '= "free"'),
], ids=["free by default", "kept", "kept where it changes"])  # fmt: skip
def test_verdicts_on_a_rise_of_the_throughput_and_on_flares(rise: float, search: Any, expected: Any, said: str) -> None:
    """A rise at 900 s, a cool flare that resembles it at 1800 s, and a hot flare at 2900 s."""
    added = flare(1800.0, 60.0, 0.3, 5000.0) + flare(2900.0, 60.0, 1.0)
    added += rise * flare(900.0, 60.0, 1.0).sum(axis=1, keepdims=True) * light() / light().sum()
    answer = analyse(Study(star=STAR, search=OFTEN | search), frames=drawn(np.random.default_rng(312), added))
    # Noise has candidates of a smaller S/N.
    rows = [row for row in answer.rows if row.event.value > 5.0]
    found = {round(float(row.analysis.survey.time_s[row.event.brightest]), -2): row.verdict for row in rows}
    assert {at: found.get(at) for at in expected} == expected
    causes = {"rejected": "throughput", "detected": "flare"}
    assert all(row.event.kind == causes[row.verdict] for row in rows if row.verdict in causes)
    assert [said in line for line in answer.messages if "search.frame.light" in line] == [True] * bool(said)


@pytest.mark.long
def test_flare_in_a_stare_with_a_drifting_detector_has_its_time_and_duration(tmp_path: Path) -> None:
    """The dark current exceeds star and flare in the sum over wavelength; an interval fails for one seed in 20."""
    drawn = stare(star="AD Leo", amplitude=0.9, duration=3600, seed=1)
    light = drawn.stares[0].light
    assert np.ptp(light.flux[:, 0]) > 2 * light.mean[:, 0].mean()
    drawn.write(tmp_path)
    frames = read_frames(tmp_path / "light-curve-1.fits")
    known, unknown = (analyse(frames=frames, **star) for star in ({"star": "AD Leo"}, {}))
    for answer in (known, unknown):
        assert any("dark current changes the sum over wavelength" in line for line in answer.messages)
        (flare,) = answer.events[answer.events["kind"] == "flare"]
        assert flare["tpeak"].to_value("s") == pytest.approx(drawn.events["peak_time"][0].to_value("s"), abs=10)
        assert np.isnan(flare["ampl_rec"])
        assert np.isnan(flare["ed"]) == (answer is unknown)
        assert len({"limits", "completeness"} & set(answer.tables)) == (0 if answer is unknown else 2)
    model = frame_model(Study.of(star="AD Leo"), frames)
    star_dn = model.quiet.n_frames * model.quiet.gain_dn_per_electron * model.quiet.source_electrons
    all_light = float(model.flares((1e4,)).sum() / (model.bins @ star_dn * model.per_dn).sum())
    truth_s = all_light * drawn.events["equivalent_duration"][0].to_value("s")
    (flare,) = known.events[known.events["kind"] == "flare"]
    assert flare["ed_low_95"].to_value("s") < truth_s < flare["ed_high_95"].to_value("s")
    assert flare["ed_high_95"] < 1.3 * flare["ed_low_95"]


#: Of sudden changes of the light that all pixels share.
PIXELS, EVERY = 48, np.arange(N)
NM = np.linspace(205.0, 700.0, PIXELS)
RED = 20.0 * np.exp((NM - 700.0) / 100.0)
OTHERS = np.array([np.exp((450.0 - NM) / 150.0), (NM / 450.0) ** -2, np.ones(PIXELS)])
SD = np.full(PIXELS, 2.0)


def changes(rng: Any, added: np.ndarray | float = 0.0, numbers: Any = EVERY, frames: Any = EVERY) -> list[Any]:
    excess = added + SD * np.random.default_rng(rng).standard_normal((N, PIXELS))
    return models.light_changes(excess, frames, numbers, RED, OTHERS, SD)


def lost(start: int, stop: int, share: float) -> np.ndarray:
    return -share * np.isin(EVERY, range(start, stop))[:, None] * RED


def test_noise_feigns_changes_as_rarely_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 0.3 expected changes in a series; fails by chance once in a thousand times."""
    monkeypatch.setattr(models, "CHANCE", 0.3)
    # A change of noise alone has the colour of anything.
    monkeypatch.setattr(models, "CLEARLY", -np.inf)
    rng, many = np.random.default_rng(400), 100
    count = sum(bool(changes(rng)) for _ in range(many))
    # Neighbouring frames and widths share noise, so that the bound of independent values is not reached.
    assert 0 < count <= stats.binom.ppf(0.999, many, 0.3)


def test_loss_and_return_are_found_at_their_frames_with_their_size() -> None:
    """Changes of 14 standard errors; within 5 standard errors, one seed in a million fails."""
    down, up = changes(401, lost(200, 400, 0.3))
    assert down.change < 0 < up.change
    for one, truth in ((down, 200), (up, 400)):
        assert abs(one.frame - truth) <= 2
        assert abs(one.change) == pytest.approx(0.3, abs=5 * one.error)
    # Changes of another colour, over gaps and in frames that are left out are none.
    course = np.exp(-np.maximum(EVERY - 300.0, 0) / 40.0) * (EVERY >= 300)
    for other in OTHERS:
        assert changes(402, 5 * float(RED.sum() / other.sum()) * np.outer(course, other)) == []
    assert changes(403, lost(400, N, 0.3), numbers=EVERY + 1000 * (EVERY >= 400)) == []
    assert changes(403, lost(398, 402, 0.9), frames=np.delete(EVERY, slice(398, 402))) == []
    # Neither have few frames.
    assert models.light_changes(np.zeros((5, PIXELS)), np.arange(5), np.arange(5), RED, OTHERS, SD) == []
