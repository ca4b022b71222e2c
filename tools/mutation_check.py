"""Break the code on purpose, in a copy, and see the named test fail.

    python tools/mutation_check.py [NAME ...]

A mutation names a text of the code, wherever it stands, and a function of the tests, wherever it is defined. Those of
the noise are made in the kernels and in their NumPy reference alike, so that a comparison of the two is not enough:
known answers, exact distributions or tests of chance must fail. The exit code is 0 if every mutation makes its test
fail.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
#: Folders of the code, without the links in mauvecl to the first two, and of its NumPy reference.
SOURCES = ("host", "kernels", "mauvecl", "tests/reference")

#: A text of the code and the one that replaces it.
Edit = tuple[str, str]
#: The function of the test that must fail with the edits and passes without, with its parameters, and the edits.
Mutation = tuple[str, *tuple[Edit, ...]]

SWAPPED = (
    "w[${4 * i}] = c0[${i}]; w[${4 * i + 1}] = c1[${i}]",
    "w[${4 * i}] = c1[${i}]; w[${4 * i + 1}] = c0[${i}]",
)
SHAPE = "    g1, g2, g3, *_ = c.over_sd()\n    sd ="

MUTATIONS: dict[str, Mutation] = {
    # Realistic and ideal answers, and files of version 1.
    "old studies read with today's unknowns": (
        "test_study_of_version_1_is_read_as_it_was[-mauvesim]",
        ('nuisances.setdefault("usual", False)', 'nuisances.setdefault("usual", True)'),
    ),
    "an ideal answer with the unknowns": (
        "test_ideal_answer_is_that_of_the_ideal_study[detect]",
        ("case.with_sections(nuisances=KNOWN).setting(case.quiet", "case.setting(case.quiet"),
    ),
    "an ideal limit with the unknowns": (
        "test_ideal_answer_is_that_of_the_ideal_study[limit]",
        ("study.nuisances.none, case.with_sections(nuisances=KNOWN)", "study.nuisances.none, case"),
    ),
    "jitters that cost a plan nothing": (
        "test_plan_by_the_closed_form_is_worse_than_the_ideal",
        ("power -= float(np.sum((rows @ light) ** 2))", "power -= 0.0"),
    ),
    "paper's conventions without its instrument": (
        "test_defaults_are_realistic_unlike_those_of_the_paper",
        ('self.ideal().with_value(("observation", "instrument"), FORMERLY_MAUVE)', "self.ideal()"),
    ),
    "an ideal answer of Python with the unknowns": (
        "test_keywords_ask_what_flags_ask[ideal]",
        ('        by_name["with_unknowns"] = False', "        pass"),
    ),
    "pairs of values without their units": (
        "test_studies_are_built_from_and_changed_by_the_same_keywords",
        (
            '((word, fields.with_unit(word, unit)) for word in text.split(":"))',
            '((word, fields.with_unit(word, "s")) for word in text.split(":"))',
        ),
    ),
    "unknowns fitted with the wrong sign": (
        "test_light_of_unknowns_is_separated_from_a_flare",
        ("amplitudes[:-1] @ self.spectra", "-amplitudes[:-1] @ self.spectra"),
    ),
    # Draws, statistics, stores and runs.
    "one unknown's row dropped": (
        "test_closed_forms_integrate_over_drawn_unknowns[half a degree]",
        ("begin + len(hypotheses.nuisances.names)", "begin + len(hypotheses.nuisances.names[1:])"),
    ),
    "a sky that follows no level": (
        "test_sky_follows_its_level[level0]",
        ("on_light * on_sky * sky_share(x) / light", "0.0 * sky_share(x) / light"),
    ),
    "photons of neighbours taken for noise": (
        "test_components_have_correct_sum_and_moments[mauve-apart]",
        ("counted) - source - sky - neighbours", "counted) - source - sky"),
    ),
    "estimated variances of less light": (
        "test_sampled_tail_agrees_with_brute_force[estimated from light]",
        ('+ estimate["net_offset"] for dn', '- estimate["net_offset"] for dn'),
    ),
    "neighbours taken off the light of a stare": (
        "test_spectra_summed_over_frames_equal_exposures_of_the_engine",
        ("drawn + first[0] + first[1] + first[3]", "drawn + first[0] + first[1] - first[3]"),
    ),
    "unknowns marginalised without their prior": (
        "test_cost_equals_that_of_the_methods[nuisances1-5.65-5.91-the dark level (+-0.003 deg C)]",
        ("np.diag(self.sd**-2.0) + ", "np.diag(0.0 * self.sd**-2.0) + "),
    ),
    "sums of stares without their skewness": (
        "test_sums_by_cumulants_are_distributed_as_by_pixels[cold]",
        ("x${a} = FMA(s${name(a, b, c)}, q${b}${c}, x${a});", ";"),
        ("total = fma(of(skew, a, b, d), q, total)", "pass"),
    ),
    "jitter that a stare keeps": (
        "test_moments_equal_those_of_the_recipe[cumulants]",
        (
            "const uintv number = LOAD(numbers + frame);\n        /* Normals",
            "const uintv number = LOAD(numbers + frame) & (uintv)0u;\n        /* Normals",
        ),
        ('int(scene.numbers[frame]), "stare_frame"', '0, "stare_frame"'),
        ("int(scene.numbers[frame]), stream", "0, stream"),
    ),
    "jitter and sums of stares from one stream": (
        "test_moments_equal_those_of_the_recipe[cumulants]",
        ('"stare_sums": 18', '"stare_sums": 17'),
    ),
    "a flare without photon noise": (
        "test_sums_by_cumulants_are_distributed_as_by_pixels[cold]",
        (
            "FMA(light, (floatv)m->photon_variance, FMA(strengths.dark",
            "FMA(0.0f * light, (floatv)m->photon_variance, FMA(strengths.dark",
        ),
        ('fma(light, m["photon_variance"], fma(', 'fma(0 * light, m["photon_variance"], fma('),
    ),
    "frames counted without their gaps": (
        "test_stares_depend_on_neither_scenarios_nor_gaps[cumulants]",
        ("_padded(stare.numbers, np.uint32)", "_padded(np.arange(stare.n_frames), np.uint32)"),
    ),
    "a shard's flares from the first": (
        "test_shards_of_stares_join_to_the_same_bits[None-cumulants]",
        ("request.flares.part(piece.begin - request.start,", "request.flares.part(done,"),
    ),
    "a shard under another's name": (
        "test_interrupted_run_is_resumed_whatever_happens_to_its_files[misplaced]",
        ('name.encode() + b"\\0" + body', "body"),
    ),
    "foreign chunks unseen": (
        "test_damage_is_found_and_repaired_to_the_bit",
        ('return "good" if digest(data) == listed else "foreign"', 'return "good"'),
    ),
    "half a failed shard kept": (
        "test_failed_launch_is_repeated",
        (
            "        tally = plan.tally()\n",
            "        tally = vars(request).setdefault('_kept', plan.tally())\n",
        ),
    ),
    "far values lost": (
        "test_numbers_equal_those_of_sorting[0]",
        ("for index in np.flatnonzero(outside).tolist():", "for index in ():"),
    ),
    "far S/N lost": (
        "test_snr_equals_that_of_sorting[16-0-net]",
        ("tile.pieces(RAW_BATCH) if outside.size else ()", "()"),
    ),
    "7 rounds": (
        "test_philox_gives_the_known_answers",
        ("range(3, 10):\n    PHILOX_ROUND", "range(3, 7):\n    PHILOX_ROUND"),
        ("range(3, 10):\n% for i", "range(3, 7):\n% for i"),
        ("for r in range(10):", "for r in range(7):"),
    ),
    "swapped words": (
        "test_philox_gives_the_known_answers",
        ("Words out = {c0, c1, c2, c3};", "Words out = {c1, c0, c2, c3};"),
        SWAPPED,
        ("return (c0.astype(np.uint32), c1.astype", "return (c1.astype(np.uint32), c0.astype"),
    ),
    "swapped words, production kernel alone": (
        "test_extreme_words_in_production_kernel_equal_reference",
        SWAPPED,
    ),
    "rounded normal for the dark": (
        "test_pearson_of_raw_counts[payload-apart]",
        ("nearest(FMA(z, FMA(z, curve, (floatv)slope), (floatv)offset))", "nearest(z * slope + offset)"),
        (
            'nearest(fma(z, fma(z, curve, source["slope"]), source["offset"]))',
            'nearest(z * source["slope"] + source["offset"])',
        ),
    ),
    "rounded normal for the joint draw": (
        "test_pearson_of_raw_counts",
        (SHAPE, SHAPE.replace("c.over_sd()", "(0.0 * g for g in c.over_sd())")),
    ),
    "skew-only expansion of the dark": (
        "test_expansion_cannot_be_distinguished_from_exact_draws",
        ("= -1 / (72 * root)", "= 0.0"),
    ),
    "joint draw allowed by its skew alone": (
        "test_worst_draws_that_the_region_allows",
        ("(over_sd[0] <= MAX_SKEW) & ~cut_off", "(over_sd[0] <= MAX_SKEW)"),
    ),
    "fourth power left out too early": (
        "test_worst_draws_that_the_region_allows",
        ("345 * fourth**2", "34.5 * fourth**2"),
    ),
    "rounding taken for noise everywhere": (
        "test_worst_allowed_stack_is_indistinguishable_from_frames",
        ("return ~is_noticeable(loss, n * frame)", "return frame > 0"),
    ),
    "fifth cumulants of varying dark forgotten": (
        "test_factors_follow_the_cumulants",
        ("dark * r->dark_fifth", "factors->dark * 0.0f"),
        ('dark * r["dark_fifth"]', "dark * np.float32(0)"),
    ),
    "pairs of two ways": (
        "test_draws_are_uncorrelated",
        ("_both_of_a_pair(mean >= SMALLEST_EXPANDED)", "mean >= SMALLEST_EXPANDED"),
    ),
    "skew-only expansion of the joint draw": (
        "test_joint_draws_cannot_be_distinguished_from_exact_ones",
        (SHAPE, SHAPE.replace("    sd =", "    g2, g3 = 0 * g2, 0 * g3\n    sd =")),
    ),
    "24-bit uniforms": (
        "test_thousand_million_draws",
        ("TO_FLOAT(w[${2 * i}]) + 0.5f", "TO_FLOAT(w[${2 * i}] & (uintv)0xffffff00u) + 0.5f"),
        ("t = radius_word.astype", "t = (radius_word & np.uint32(0xFFFFFF00)).astype"),
    ),
    "the sky counted as signal": (
        "test_snr_equals_that_of_sorting[16-3-net]",
        ("        signal -= (floatv)element.sky;\n", ""),
        ("    signal = signal - sky\n", ""),
    ),
    "carry of the index dropped between launches": (
        "test_raw_spectra_equal_reference[vectors-stack]",
        ("np.uint32(first >> 32)", "np.uint32(0)"),
    ),
    "carry of the index dropped within a launch": (
        "test_raw_spectra_equal_reference[vectors-stack]",
        ("min(size - index % size, count)", "min(size, count)"),
    ),
    "carry of the product dropped in odd lanes": (
        "test_philox_gives_the_known_answers",
        (
            ">> (ulong${half})32UL) * (ulong${half})factor;",
            ">> (ulong${half})32UL) * (ulong${half})(factor & 0xffff0000u);",
        ),
    ),
    "alias table off by one word": (
        "test_alias_table_has_the_probabilities_of_scipy",
        ("rich << shift | remaining[poor]", "rich << shift | max(remaining[poor] - 1, 0)"),
    ),
    "alias table off by one count": (
        "test_pearson_of_raw_counts",
        ("low + int(inside[0]))", "low + int(inside[0]) + 1)"),
    ),
    "two streams alike": (
        "test_draws_have_different_counters",
        ('\n    "dark": 1,', '\n    "dark": 0,'),
    ),
    "priors' tables too coarse at their ends": (
        "test_drawn_factors_have_the_moments_and_tails_of_the_prior",
        ("PRIOR_BITS = 7", "PRIOR_BITS = 4"),
    ),
    "priors' finer digits dropped": (
        "test_drawn_factors_have_the_moments_and_tails_of_the_prior",
        ("finer & (uintv)0x7fffffu", "finer & (uintv)0u"),
        ("finer & np.uint32(0x7FFFFF)", "finer & np.uint32(0)"),
    ),
    "saturation at the ADC's end alone": (
        "test_closed_forms_follow_simulation",
        ("min(self.saturation_dn, float(self.adc_max_dn))", "float(self.adc_max_dn)"),
    ),
    "reference of what is not recorded": (
        "test_closed_forms_follow_simulation",
        ("mean_sum = quiet.recorded_dn", "mean_sum = quiet.n_frames * quiet.mean_raw_dn"),
    ),
    "noise of what is subtracted forgotten": (
        "test_sampled_tail_agrees_with_brute_force[stack]",
        ("variance = (1.0 + comparison.added_variance) * quiet", "variance = quiet"),
        ("(1.0 + comparison.added_variance) / 2.0", "0.5"),
    ),
    "quiescent exposures with the observed draws": (
        "test_nominal_payload_is_gaussian",
        ("REFERENCE = 64", "REFERENCE = 0"),
    ),
    "closed forms that follow a temperature by their means alone": (
        "test_closed_forms_integrate_over_drawn_unknowns[half a degree]",
        (", seen.variance + amount @ variances)", ", seen.variance)"),
    ),
    "moved scores that count like others": (
        "test_sampled_tail_agrees_with_brute_force[half a degree]",
        ("np.log(2.0) - np.logaddexp(0.0, ratio)", "np.zeros(BLOCK)"),
    ),
    "shifts forgotten in the closed form": (
        "test_few_terms_and_far_tails_agree_with_scipy",
        ("(0.5 * (shifted - log))[..., 0]", "(-0.5 * log)[..., 0]"),
    ),
    "one smoothed value in four dropped": (
        "test_nominal_payload_is_gaussian",
        ("[k][s + 3u] = d;", "[k][s + 3u] = 0.0f;"),
        ("for centre, row in enumerate(rows):", "for centre, row in enumerate([]):"),
    ),
    # Fits of spectra.
    "fluxes per Angstrom": (
        "test_correct_model_covers_and_simple_model_is_rejected",
        ("10.0 * np.trapezoid(fluxes[:, inside]", "np.trapezoid(fluxes[:, inside]"),
    ),
    "errors of fluxes at a known temperature": (
        "test_correct_model_covers_and_simple_model_is_rejected",
        ('gradient[:, is_sum, m] = np.einsum("nql,nl->nq", spline(log_k, 1), linear)', "gradient[:, is_sum, m] = 0.0"),
    ),
    "errors of jumps at a known temperature": (
        "test_forecasts_of_balmer_jumps_and_of_wrong_blackbodies[jump-2.5]",
        ("ratio(log_k, 1) * linear[:, 1] / amplitude", "0.0 * amplitude"),
    ),
    "intervals clipped at a standard deviation": (
        "test_intervals_agree_with_minos",
        ("rise = np.maximum(rise, 0.0)", "rise = np.clip(rise, 0.0, 1.0)"),
    ),
    "intervals beyond their bounds": (
        "test_bounded_intervals_agree_with_brute_force",
        ("reaches = (low <= np.array(model.bounds)) & np.isfinite(model.bounds)", "reaches = low < -np.inf"),
    ),
    "the noise of a star for that of its flare": (
        "test_forecasts_of_balmer_jumps_and_of_wrong_blackbodies[jump-2.5]",
        (
            "constant + quiet.gain_dn_per_electron * photons_dn for photons_dn in (light, most)",
            "constant + quiet.gain_dn_per_electron * photons_dn for photons_dn in (quiet.light_dn, most)",
        ),
    ),
    "saturated pixels in use": (
        "test_rows_with_saturated_pixels_are_marked[0.75-none1-marked1]",
        (
            "NEAR_SIGMA * np.sqrt(scatter / quiet.n_frames) < quiet.ceiling_dn",
            "NEAR_SIGMA * np.sqrt(scatter / quiet.n_frames) < np.inf",
        ),
    ),
    "flare and factor on light correlated with the wrong sign": (
        "test_intervals_agree_with_brute_force[0.5-prior]",
        ("variance_of_factor + factor_at.variance, -covariance", "variance_of_factor + factor_at.variance, covariance"),
    ),
    "a factor on light without its own error": (
        "test_intervals_agree_with_brute_force[0.5-free]",
        (
            "Ratio(value, bottom, variance, variance_of_factor + factor_at.variance",
            "Ratio(value, bottom, variance, variance_of_factor",
        ),
    ),
    # Fits of events.
    "a prior of the number of flares that depends on the time since the start": (
        "test_flares_that_may_be_one_or_two_are_measured_alike_at_any_time",
        ("np.log(span[-1, 1] - span[0, 0])", "np.log(span[-1, 1] + span[0, 0])"),
    ),
    "intervals of events that are not truncated at zero": (
        "test_quantiles_of_many_parts_are_those_of_their_sum[0.1]",
        ("goal = _probability_above(0.0, weight, mean, sd, 0.0) * ", "goal = "),
    ),
    "a flare added to the level of its star": (
        "test_table_of_events_has_the_flare_in_its_units",
        (
            "float(window.values @ likelihood.level) - grid.amplitude * in_level",
            "float(window.values @ likelihood.level) + grid.amplitude * in_level",
        ),
    ),
    "durations without the error of their level": (
        "test_tables_of_default_questions_are_unchanged[analyse-counts]",
        (
            "unknown = likelihood.departure_variance + mean**2 * likelihood.level_variance",
            "unknown = likelihood.departure_variance",
        ),
    ),
    "brighter flares on a higher level": (
        "test_tables_of_default_questions_are_unchanged[analyse-counts]",
        ("along = per_amplitude + mean * in_level", "along = per_amplitude - mean * in_level"),
    ),
    "light summed above a known level": (
        "test_error_of_a_summed_duration_includes_that_of_its_level",
        ("variance += of_level + constant**2 / float(of_constant.sum())", "pass"),
    ),
    "a slow decay on top of the fast one": (
        "test_tables_of_default_questions_are_unchanged[analyse-rotating]",
        ("starts = np.eye(len(fast))[start] * (1.0 - share[decay, None])", "starts = np.eye(len(fast))[start]"),
    ),
    "published shapes that do not share their weight": (
        "test_tables_of_default_questions_are_unchanged[analyse-rotating]",
        ("(1 - GENERAL_WEIGHT) / len(shapes)", "(1 - GENERAL_WEIGHT)"),
    ),
    "likelihood without the information on the level": (
        "test_level_norms_and_covariances_are_those_of_the_matrices",
        ("covariance.log_determinant + np.log(information)", "covariance.log_determinant"),
    ),
    "steps taken for flares": (
        "test_steps_single_frames_and_dips_are_no_flares_and_three_frames_are_one",
        (
            "return constant - float(gain.max()) < least - STEP_GAIN",
            "return constant - float(gain.max()) > least - STEP_GAIN",
        ),
    ),
    # The level of observed light curves, and the search.
    "norms that end with their template": (
        "test_level_norms_and_covariances_are_those_of_the_matrices",
        ('total = np.einsum("jo,jo->o", state, (units / self._d[later, None]).T @ units @ state)', "total = 0.0"),
    ),
    "statistics of a known level": (
        "test_statistics_have_unit_variance_over_gaps_and_changing_noise[process0-300-0.05-0.02-0-at-once]",
        (
            "_correlate(on_grid, shape, first)[peaks] ** 2 / level_weights.sum()",
            "0.0 * _correlate(on_grid, shape, first)[peaks]",
        ),
    ),
    "a level without its process": (
        "test_level_norms_and_covariances_are_those_of_the_matrices",
        ("process = residual - self._noise[:, None] * self._covariance.solve(residual)", "process = 0.0 * residual"),
    ),
    "a level with the stated errors": (
        "test_level_norms_and_covariances_are_those_of_the_matrices",
        ("noise = variance * process.excess**2\n        self.weights", "noise = variance\n        self.weights"),
    ),
    "noise that falls with the counts": (
        "test_noise_at_the_level_is_that_of_its_counts",
        ("squared - slope * (flux - level)", "squared + slope * (flux - level)"),
    ),
    "flares of three frames taken for rays": (
        "test_steps_single_frames_and_dips_are_no_flares_and_three_frames_are_one",
        (" & (np.abs(sigmas[after]) < NEAR)", ""),
    ),
    "means that scatter like frames": (
        "test_tables_of_default_questions_are_unchanged[analyse-rotating]",
        ("scipy.stats.chi2.ppf([0.025, 0.975], dof) / dof / size", "scipy.stats.chi2.ppf([0.025, 0.975], dof) / dof"),
    ),
    "means over gaps": (
        "test_tables_of_default_questions_are_unchanged[analyse-rotating]",
        ("(place % size == 0) & (place + size <= length)", "place % size == 0"),
    ),
    "correlations over gaps": (
        "test_correlations_do_not_bridge_gaps",
        (
            "np.intersect1d(numbers, numbers - lag, assume_unique=True, return_indices=True)",
            "0, np.arange(len(numbers) - lag), np.arange(lag, len(numbers))",
        ),
    ),
    "losses that are never searched": (
        "test_losses_are_found_at_their_frames_and_a_flare_is_none",
        (
            "if survey.weighted or not (many or process.excess > MOST_EXCESS or fast):",
            "if survey.weighted or many is many:",
        ),
    ),
    "losses searched upright": (
        "test_losses_are_found_at_their_frames_and_a_flare_is_none",
        ("sums=-self.sums, flux=-self.flux", "sums=self.sums, flux=self.flux"),
    ),
    # Readers.
    "dates of TESS from noon": (
        "test_files_are_read_as_they_say[times unit btjd 1000 + (t - 100) / 14400 fits]",
        ('"btjd": 56_999.5, "bkjd"', '"btjd": 57_000.0, "bkjd"'),
    ),
    "starts of frames taken for their ends": (
        "test_files_are_read_as_they_say[times keywords of scale and place fits9]",
        (
            "frames.shifted((0.5 - system.at) * frames.exposure_s)",
            "frames.shifted((system.at - 0.5) * frames.exposure_s)",
        ),
    ),
    "days taken for seconds": (
        "test_files_are_read_as_they_say[extensions names that need no mapping fits1]",
        ("np.asarray(((middles - first) * unit).to_value(u.s)), ", "np.asarray(middles - first), "),
    ),
    "light that reaches the barycentre earlier": (
        "test_barycentric_times_are_those_of_erfa_and_of_the_satellites_place[2026-09-16T03:00:00-tle-along the track]",
        ("(when.tdb - first).to_value(u.s) + delay", "(when.tdb - first).to_value(u.s) - delay"),
    ),
    "wavelengths shorter in vacuum": (
        "test_files_are_read_as_they_say[media keyword AIRORVAC air txt]",
        ("vacuum[in_air] = air_nm[in_air] * index", "vacuum[in_air] = air_nm[in_air] / index"),
    ),
    "air in a unit overlooked": (
        "test_files_are_read_as_they_say[media unit Angstrom air 10 fits]",
        (
            'return match[1] or None, "air" if match[2].lower() == "air" else "vacuum"',
            'return match[1] or None, "vacuum"',
        ),
    ),
    "fluxes in the order of frequencies": (
        "test_files_are_read_as_they_say[spectrum_files text with its units txt11]",
        ("(nm[order], flam[order])", "(nm[order], flam)"),
    ),
    "fluxes per nm": (
        "test_files_are_read_as_they_say[media keyword AIRORVAC air txt]",
        ("FLUX_UNIT = u.erg / (u.s * u.cm**2 * u.AA)", "FLUX_UNIT = u.erg / (u.s * u.cm**2 * u.nm)"),
    ),
    "errors of another flux": (
        "test_the_errors_are_those_of_the_chosen_flux",
        ('flux = divided_unit(columns["flux"] or "")[0]', 'flux = "pdcsap_flux"'),
    ),
    "errors in a unit of their own": (
        "test_time_series_of_astropy_are_frames",
        ("error.mapped(lambda values: values * factor, unit)", "error.mapped(lambda values: values, unit)"),
    ),
    "inverse variances taken for errors": (
        "test_spectra_of_specutils_are_frames[InverseVariance]",
        ("uncertainty.represent_as(StdDevUncertainty).array", "uncertainty.array"),
    ),
    "quality flags without effect": (
        "test_files_are_read_as_they_say[extensions light curve of TESS fits]",
        ("np.asarray(quality, np.int64) & self.mask) != 0", "np.asarray(quality, np.int64) & self.mask) < 0"),
    ),
    # Calibration, changes of throughput and colour.
    "steps of two frames that scatter like one": (
        "test_two_exposure_times_give_the_bias_of_pixels_and_light_that_jitters_the_gain",
        (
            "np.sum(basis**2, axis=0)) * scale**2 / 2)",
            "np.sum(basis**2, axis=0)) * scale**2)",
        ),
    ),
    "a dark current without noise": (
        "test_two_exposure_times_give_the_bias_of_pixels_and_light_that_jitters_the_gain",
        (
            "photons = noise.dark_factor * level[",
            "photons = 0.0 * level[",
        ),
    ),
    "noise of a faint flare in a direction that rounding chooses": (
        "test_rounding_moves_no_interval[M3V]",
        (
            "np.dstack([slope, hot, *fixed]))[0].transpose(0, 2, 1)",
            "np.dstack([normal, slope, hot, *fixed]))[0].transpose(0, 2, 1)[:, 1:]",
        ),
    ),
    "one star without errors of its spectrum": (
        "test_one_star_determines_throughput_alone",
        ("unfitted_error * _linear_basis(nm)", "0.0 * _linear_basis(nm)"),
    ),
    "a wider line that is narrower": (
        "test_fit_recovers_values_and_throughput",
        ("slope, bend = (wide - narrow) / (2 * step)", "slope, bend = (narrow - wide) / (2 * step)"),
    ),
    "the light of a second for that of a frame": (
        "test_fit_recovers_values_and_throughput",
        ("self.transfer.noise.gain) * electrons * frames.exposure_s", "self.transfer.noise.gain) * electrons"),
    ),
    "a colour relative to a known star": (
        "test_tables_of_default_questions_are_unchanged[analyse-spectra]",
        ("/ n_event**2 + (error[quiet] ** 2).sum(axis=0) / n_quiet**2", "/ n_event**2"),
    ),
    "light lost taken for light gained": (
        "test_loss_and_return_are_found_at_their_frames_with_their_size",
        (
            "((total[k + width] - 2 * total[k] + total[k - width]) / width)[gapless]",
            "(-(total[k + width] - 2 * total[k] + total[k - width]) / width)[gapless]",
        ),
    ),
    # Answers.
    "unknowns that tell of a change": (
        "test_error_of_change_is_the_scatter_of_fits",
        ("information -= float(np.sum((unknown.rows(variance", "information += float(np.sum((unknown.rows(variance"),
    ),
    "errors of changes with everything known": (
        "test_error_of_change_is_the_scatter_of_fits",
        (
            "(visits.error_of_change(change.counts_dn, quiet, unknowns) for unknowns in (unknown, None))",
            "(visits.error_of_change(change.counts_dn, quiet, unknowns) for unknowns in (None, None))",
        ),
    ),
    "one visit against a known mean": (
        "test_smallest_changes_have_the_power[2-0.001-0.95]",
        ("error * np.sqrt(centre * visits / dof)", "error * np.sqrt(centre)"),
    ),
    "scatter in the column of differences": (
        "test_smallest_changes_have_the_power[2-0.001-0.95]",
        ('Column("smallest", "smallest.one"', 'Column("smallest", "smallest.scatter"'),
    ),
    "amplitudes of other cells": (
        "test_tables_of_default_questions_are_unchanged[change-periods]",
        (
            'Column("amplitude_errors", lambda row: row.recovery.amplitudes[:, None]',
            'Column("amplitude_errors", lambda row: np.resize(row.recovery.amplitudes, row.shares("value").shape)',
        ),
    ),
    "indices per Angstrom": (
        "test_index_and_captured_share_are_those_of_a_direct_integration",
        ("np.divide(10.0, per_flam", "np.divide(1.0, per_flam"),
    ),
    "indices of known light": (
        "test_errors_of_indices_are_those_of_drawn_exposures",
        ("variance += float(np.sum((moved[~free] * unknown.sd[~free]) ** 2))", "pass"),
    ),
    "coverage of upper ends alone": (
        "test_expected_regions_close_and_intervals_beside_the_truth_do_not_cover",
        ("(found.low[k] <= self.truth) & (self.truth <= found.high[k])", "self.truth <= found.high[k]"),
    ),
    "whole ranges for their halves": (
        "test_correct_model_covers_and_simple_model_is_rejected",
        ("return np.asarray((high - low) / 2 if", "return np.asarray(high - low if"),
    ),
    "exposures of a frame": (
        "test_exposure_inverts_snr[450.0-7-pixel]",
        ("*wanted, x.exposure_s, frames", "*wanted, x.exposure_s / x.n_frames, frames"),
    ),
    "durations in days and seconds": (
        "test_table_of_events_has_the_flare_in_its_units",
        ('frames.cadence_s\n           / DAY_S, "d"', 'frames.cadence_s, "d"'),
    ),
    "ends of intervals of two levels": (
        "test_table_of_events_has_the_flare_in_its_units",
        (
            "times * low, times * high, times * low_95, times * high_95",
            "times * low, times * high_95, times * low_95, times * high",
        ),
    ),
}


def files_of(folder: Path, *names: str) -> dict[Path, str]:
    """Return the texts of Python files and kernels in some folders of a project."""
    places = (place for name in names for ending in ("py", "mako") for place in (folder / name).rglob(f"*.{ending}"))
    # Links in mauvecl show some files twice.
    return {place: place.read_text(encoding="utf-8") for place in sorted({one.resolve() for one in places})}


def place_of(text: str, files: dict[Path, str]) -> Path:
    """Return the file that holds a text once; raises SystemExit if there is none, or if the text occurs again."""
    found = [place for place, content in files.items() for _ in range(content.count(text))]
    if len(found) != 1:
        where = ", ".join(sorted({place.name for place in found}))
        raise SystemExit(f"{text!r} occurs {len(found)} times{f' ({where})' if where else ''}, expected once")
    return found[0]


def node_of(test: str, files: dict[Path, str]) -> str:
    """Return the test for pytest; raises SystemExit unless one file defines its function."""
    name = re.escape(test.partition("[")[0])
    found = [place for place, content in files.items() if re.search(rf"^def {name}\(", content, re.MULTILINE)]
    if len(found) != 1:
        raise SystemExit(f"the test {test} is defined in {len(found)} files, expected one")
    return f"{found[0]}::{test}"


def fails(folder: Path, test: str) -> tuple[bool, str]:
    """Return whether a test fails in a copy of the project, and pytest's closing line."""
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", test],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    # 1: tests failed. Anything else but 0 is a broken mutation, not a noticed one.
    if run.returncode not in (0, 1):
        raise SystemExit(f"{test} could not be run:\n{run.stdout}{run.stderr}")
    return run.returncode == 1, run.stdout.strip().splitlines()[-1]


def copy(folder: Path) -> None:
    """Copy the project's own files, with links kept as links."""
    for name in (*SOURCES[:3], "tests", "pyproject.toml"):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)


def main() -> int:
    """Print a line for each mutation."""
    wanted = sys.argv[1:] or list(MUTATIONS)
    unnoticed = 0
    for name in wanted:
        if name not in MUTATIONS:
            raise SystemExit(f"mutation {name!r} is unknown, expected one of: {', '.join(MUTATIONS)}")
        (test, *edits), started = MUTATIONS[name], time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="mauvecl-mutant-") as temporary:
            folder = Path(temporary)
            copy(folder)
            files = files_of(folder, *SOURCES)
            for old, new in edits:
                place = place_of(old, files)
                files[place] = files[place].replace(old, new)
                place.write_text(files[place], encoding="utf-8")
            noticed, line = fails(folder, node_of(test, files_of(folder, "tests")))
        unnoticed += not noticed
        verdict = "noticed" if noticed else "NOT NOTICED"
        print(f"{verdict:12s} {name}: {test} ({time.perf_counter() - started:.0f} s: {line})", flush=True)
    print(f"{len(wanted) - unnoticed} of {len(wanted)} mutations noticed")
    return 1 if unnoticed else 0


if __name__ == "__main__":
    sys.exit(main())
