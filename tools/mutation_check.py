"""Break the noise on purpose, in a copy, and see the named test fail.

    python tools/mutation_check.py [NAME ...]

Most are made in the kernels and in their NumPy reference alike, so that a comparison of the two is not enough: known
answers, exact distributions or tests of chance must fail. The exit code is 0 if every mutation makes its test fail.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

PHILOX, NORMAL, POISSON = (f"kernels/{name}.cl.mako" for name in ("philox", "normal", "poisson"))
REFERENCE = "mauvecl/noise/reference.py"
RANDOM_NUMBERS = "mauvecl/noise/random_numbers.py"


@dataclass(frozen=True)
class Mutation:
    """Edits (file, from, to), and the test that must fail with them and passes without."""

    edits: tuple[tuple[str, str, str], ...]
    test: str


SWAPPED = (
    PHILOX,
    "w[${4 * i}] = c0[${i}]; w[${4 * i + 1}] = c1[${i}]",
    "w[${4 * i}] = c1[${i}]; w[${4 * i + 1}] = c0[${i}]",
)
CUMULANTS = "mauvecl/noise/cumulants.py"
SHAPE = "    g1, g2, g3 = c.shape()\n    sd ="

MUTATIONS = {
    "one unknown's row dropped": Mutation(
        (
            (
                "mauvecl/results/requests/channels.py",
                "nuisances.names if nuisances else ()))",
                "nuisances.names[1:] if nuisances else ()))",
            ),
        ),
        "tests/device/test_marginal.py::test_marginalised_statistics_keep_false_alarms_and_power[0.1]",
    ),
    "a sky that follows no level": Mutation(
        (("mauvecl/noise/pixel_tables.py", "factors.light * factors.sky * share / light", "0.0 * share / light"),),
        "tests/noise/test_processes.py::test_sky_follows_its_level[level0]",
    ),
    "unknowns marginalised without their prior": Mutation(
        (("mauvecl/statistics/nuisances.py", "np.diag(self.sd**-2.0) + ", "np.diag(0.0 * self.sd**-2.0) + "),),
        "tests/statistics/test_nuisances.py::test_subtracted_rows_give_the_inverse_covariance[chi2]",
    ),
    "sums of stares without their skewness": Mutation(
        (
            ("kernels/stare_sums.cl.mako", "x${a} = FMA(s${name(a, b, c)}, q${b}${c}, x${a});", ";"),
            ("mauvecl/lightcurve/stares/stare_reference.py", "total = fma(of(skew, a, b, d), q, total)", "pass"),
        ),
        "tests/lightcurve/test_draws.py::test_sums_by_cumulants_are_distributed_as_by_pixels[cold]",
    ),
    "jitter that a stare keeps": Mutation(
        (
            ("kernels/stare_sums.cl.mako", "(uintv)first_high, number,", "(uintv)first_high, number & (uintv)0u,"),
            (
                "mauvecl/lightcurve/stares/stare_reference.py",
                'words_at(numbers, int(scene.numbers[frame]), "stare_',
                'words_at(numbers, 0, "stare_',
            ),
        ),
        "tests/lightcurve/test_draws.py::test_moments_equal_those_of_the_recipe[cumulants]",
    ),
    "jitter and sums of stares from one stream": Mutation(
        (("mauvecl/noise/layout.py", '"stare_sums": 18', '"stare_sums": 17'),),
        "tests/lightcurve/test_draws.py::test_moments_equal_those_of_the_recipe[cumulants]",
    ),
    "a flare without photon noise": Mutation(
        (
            (
                "kernels/stare_pixels.cl.mako",
                "FMA(light, (floatv)m->photon_variance, FMA(strengths.dark",
                "FMA(0.0f * light, (floatv)m->photon_variance, FMA(strengths.dark",
            ),
            (
                "mauvecl/lightcurve/stares/stare_reference.py",
                'fma(light, m["photon_variance"], fma(',
                'fma(0 * light, m["photon_variance"], fma(',
            ),
        ),
        "tests/lightcurve/test_draws.py::test_sums_by_cumulants_are_distributed_as_by_pixels[cold]",
    ),
    "frames counted without their gaps": Mutation(
        (
            (
                "mauvecl/lightcurve/stares/stare_scene.py",
                "_padded(stare.numbers, np.uint32)",
                "_padded(np.arange(stare.n_frames), np.uint32)",
            ),
        ),
        "tests/lightcurve/test_stare_reference.py::test_splitting_changes_no_bit[cumulants]",
    ),
    "a shard's flares from the first": Mutation(
        (
            (
                "mauvecl/device/stare_engine.py",
                "request.flares.part(first - request.start,",
                "request.flares.part(done,",
            ),
        ),
        "tests/runs/test_stares.py::test_shards_of_stares_join_to_the_same_bits[None-cumulants]",
    ),
    "a shard under another's name": Mutation(
        (("mauvecl/runs/checkpoint.py", 'name.encode() + b"\\0" + body', "body"),),
        "tests/runs/test_pool.py::test_misplaced_shard_is_found",
    ),
    "foreign chunks unseen": Mutation(
        (("mauvecl/store/bulk.py", 'return "good" if digest(data) == known else "foreign"', 'return "good"'),),
        "tests/store/test_bulk.py::test_damage_is_found_and_repaired_to_the_bit",
    ),
    "half a failed shard kept": Mutation(
        (
            (
                "mauvecl/device/engine.py",
                "        tally, samples = Tally(plan.grids), plan.tails()\n",
                "        tally, samples = vars(request).setdefault('_kept', (Tally(plan.grids), plan.tails()))\n",
            ),
        ),
        "tests/runs/test_pool.py::test_failed_launch_is_repeated",
    ),
    "far values lost": Mutation(
        (("mauvecl/device/launches.py", "        self._add_far(tile, tally)\n", ""),),
        "tests/results/test_ends.py::test_numbers_equal_those_of_sorting[0]",
    ),
    "far S/N lost": Mutation(
        (("mauvecl/device/launches.py", "            self._add_far_snr(tile, counts, np.flatnonzero(outside))\n", ""),),
        "tests/results/test_ends.py::test_snr_equals_that_of_sorting[16-0]",
    ),
    "7 rounds": Mutation(
        ((PHILOX, "range(3, 10)", "range(3, 7)"), (RANDOM_NUMBERS, "for r in range(10):", "for r in range(7):")),
        "tests/kernels/test_philox.py::test_philox_gives_the_known_answers",
    ),
    "swapped words": Mutation(
        (
            (PHILOX, "Words out = {c0, c1, c2, c3};", "Words out = {c1, c0, c2, c3};"),
            SWAPPED,
            (RANDOM_NUMBERS, "return (c0.astype(np.uint32), c1.astype", "return (c1.astype(np.uint32), c0.astype"),
        ),
        "tests/kernels/test_philox.py::test_philox_gives_the_known_answers",
    ),
    "swapped words, production kernel alone": Mutation(
        (SWAPPED,), "tests/noise/test_extremes.py::test_extreme_words_in_production_kernel_equal_reference"
    ),
    "rounded normal for the dark": Mutation(
        (
            (POISSON, "nearest(FMA(z, FMA(z, curve, (floatv)slope), (floatv)offset))", "nearest(z * slope + offset)"),
            (REFERENCE, "nearest(fma(z, fma(z, curve, slope), offset))", "nearest(z * slope + offset)"),
        ),
        "tests/kernels/test_poisson.py::test_pearson_of_the_expansion",
    ),
    "rounded normal for the joint draw": Mutation(
        ((CUMULANTS, SHAPE, SHAPE.replace("c.shape()", "(0.0 * g for g in c.shape())")),),
        "tests/kernels/test_joint.py::test_pearson_of_raw_counts",
    ),
    "skew-only expansion of the dark": Mutation(
        (("mauvecl/noise/pixel_tables.py", "= -1 / (72 * root)", "= 0.0"),),
        "tests/kernels/test_poisson.py::test_expansion_cannot_be_distinguished_from_exact_draws",
    ),
    "joint draw allowed by its skew alone": Mutation(
        ((CUMULANTS, " & ~is_noticeable(truncation_distance(c, fourth_power=True), c.variance)", ""),),
        "tests/kernels/test_joint_bound.py::test_worst_draws_that_the_region_allows",
    ),
    "fourth power left out too early": Mutation(
        ((CUMULANTS, "345 * fourth**2", "34.5 * fourth**2"),),
        "tests/kernels/test_joint_bound.py::test_worst_draws_that_the_region_allows",
    ),
    "rounding taken for noise everywhere": Mutation(
        ((CUMULANTS, "return ~is_noticeable(loss, n * frame)", "return frame > 0"),),
        "tests/noise/test_stacks.py::test_auto_mode_stacks_only_where_moments_agree",
    ),
    "fifth cumulants of varying dark forgotten": Mutation(
        (
            ("kernels/detector.cl.mako", "dark * r->dark_fifth", "factors->dark * 0.0f"),
            (REFERENCE, 'dark * r["dark_fifth"]', "dark * np.float32(0)"),
        ),
        "tests/kernels/test_joint_bound.py::test_factors_follow_the_cumulants",
    ),
    "pairs of two ways": Mutation(
        (("mauvecl/noise/pixel_tables.py", "_both_of_a_pair(mean >= SMALLEST_EXPANDED)", "mean >= SMALLEST_EXPANDED"),),
        "tests/noise/test_correlations.py::test_draws_are_uncorrelated",
    ),
    "skew-only expansion of the joint draw": Mutation(
        ((CUMULANTS, SHAPE, SHAPE.replace("    sd =", "    g2, g3 = 0 * g2, 0 * g3\n    sd =")),),
        "tests/kernels/test_joint.py::test_joint_draws_cannot_be_distinguished_from_exact_ones",
    ),
    "24-bit uniforms": Mutation(
        (
            (NORMAL, "TO_FLOAT(w[${2 * i}]) + 0.5f", "TO_FLOAT(w[${2 * i}] & (uintv)0xffffff00u) + 0.5f"),
            (RANDOM_NUMBERS, "t = radius_word.astype", "t = (radius_word & np.uint32(0xFFFFFF00)).astype"),
        ),
        "tests/kernels/test_normal.py::test_thousand_million_draws",
    ),
    "the sky counted as signal": Mutation(
        (
            ("kernels/histogram.cl.mako", "        signal -= (floatv)element.sky;\n", ""),
            ("mauvecl/results/numpy_kernels.py", '        signal = signal - element["sky"]\n', ""),
        ),
        "tests/device/test_engine.py::test_snr_includes_photon_noise_of_sky",
    ),
    "carry of the index dropped between launches": Mutation(
        (("mauvecl/device/tiles.py", "np.uint32(self.first >> 32)", "np.uint32(0)"),),
        "tests/noise/test_extremes.py::test_draws_at_counter_boundaries_equal_reference",
    ),
    "carry of the index dropped within a launch": Mutation(
        (("mauvecl/device/tiles.py", "first = index - index % size", "first = index - index % self._step"),),
        "tests/noise/test_extremes.py::test_draws_at_counter_boundaries_equal_reference",
    ),
    "carry of the product dropped in odd lanes": Mutation(
        (
            (
                "kernels/portable.cl.mako",
                ">> (ulong${half})32UL) * (ulong${half})factor;",
                ">> (ulong${half})32UL) * (ulong${half})(factor & 0xffff0000u);",
            ),
        ),
        "tests/kernels/test_philox.py::test_philox_gives_the_known_answers",
    ),
    "alias table off by one word": Mutation(
        (("mauvecl/noise/poisson.py", "rich << shift | left[poor]", "rich << shift | max(left[poor] - 1, 0)"),),
        "tests/kernels/test_poisson.py::test_alias_table_has_the_probabilities_of_scipy",
    ),
    "alias table off by one count": Mutation(
        (("mauvecl/noise/poisson.py", "low + int(inside[0]))", "low + int(inside[0]) + 1)"),),
        "tests/kernels/test_joint.py::test_pearson_of_raw_counts",
    ),
    "two streams alike": Mutation(
        (("mauvecl/noise/layout.py", '"dark": 1', '"dark": 0'),),
        "tests/kernels/test_layout.py::test_streams_are_distinct_bytes",
    ),
    "priors' tables too coarse at their ends": Mutation(
        (("mauvecl/noise/layout.py", "PRIOR_BITS = 7", "PRIOR_BITS = 4"),),
        "tests/kernels/test_prior.py::test_drawn_factors_have_the_moments_of_the_prior",
    ),
    "priors' finer digits dropped": Mutation(
        (
            ("kernels/prior.cl.mako", "finer & (uintv)0x7fffffu", "finer & (uintv)0u"),
            ("mauvecl/noise/reference.py", "finer & np.uint32(0x7FFFFF)", "finer & np.uint32(0)"),
        ),
        "tests/kernels/test_prior.py::test_drawn_factors_have_the_tails_of_the_prior",
    ),
    "saturation at the ADC's end alone": Mutation(
        (("host/expectation.py", "min(self.saturation_dn, float(self.adc_max_dn))", "float(self.adc_max_dn)"),),
        "tests/noise/test_saturation.py::test_closed_forms_follow_simulation",
    ),
    "reference of what is not recorded": Mutation(
        (
            (
                "mauvecl/noise/scene.py",
                "mean_sum = reference.recorded_dn",
                "mean_sum = reference.n_frames * reference.mean_raw_dn",
            ),
        ),
        "tests/noise/test_saturation.py::test_closed_forms_follow_simulation",
    ),
    "noise of what is subtracted forgotten": Mutation(
        (("mauvecl/noise/scene.py", "return 1.0 + comparison.added_variance", "return 1.0"),),
        "tests/results/test_tails.py::test_sampled_tail_agrees_for_every_comparison",
    ),
    "quiescent exposures with the observed draws": Mutation(
        (("mauvecl/noise/layout.py", "REFERENCE = 64", "REFERENCE = 0"),),
        "tests/results/test_detection.py::test_null_follows_its_closed_form",
    ),
    "closed forms that follow a temperature by their means alone": Mutation(
        (("mauvecl/statistics/statistic.py", ", seen.variance + each @ variances)", ", seen.variance)"),),
        "tests/device/test_marginal.py::test_closed_forms_integrate_over_drawn_unknowns[half a degree]",
    ),
    "moved scores that count like others": Mutation(
        (("mauvecl/results/detection/tails.py", "np.log(2.0) - np.logaddexp(0.0, ratio)", "np.zeros(BLOCK)"),),
        "tests/results/test_tails.py::test_sampled_tail_with_unknowns_agrees_with_brute_force[half a degree]",
    ),
    "shifts forgotten in the closed form's phase": Mutation(
        (
            (
                "mauvecl/statistics/distributions.py",
                "(np.arctan(turn) * count).sum(axis=1) + (u[:, None] * pull / spread).sum(axis=1)",
                "(np.arctan(turn) * count).sum(axis=1) + 0.0 * u",
            ),
        ),
        "tests/statistics/test_statistics.py::test_equal_weights_are_a_scaled_non_central_chi_squared",
    ),
    "one smoothed value in four dropped": Mutation(
        (
            ("kernels/comparison.cl.mako", "[k][s + 3u] = d;", "[k][s + 3u] = 0.0f;"),
            (
                "mauvecl/results/numpy_kernels.py",
                "for centre, row in enumerate(self.rows):",
                "for centre, row in enumerate([]):",
            ),
        ),
        "tests/results/test_detection.py::test_null_follows_its_closed_form",
    ),
}


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
    for name in ("host", "kernels", "mauvecl", "tests", "pyproject.toml"):
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
        mutation, started = MUTATIONS[name], time.perf_counter()
        with tempfile.TemporaryDirectory(prefix="mauvecl-mutant-") as temporary:
            folder = Path(temporary)
            copy(folder)
            for file, old, new in mutation.edits:
                text = (folder / file).read_text(encoding="utf-8")
                if old not in text:
                    raise SystemExit(f"mutation {name!r} is out of date: {file} no longer holds {old!r}")
                (folder / file).write_text(text.replace(old, new), encoding="utf-8")
            noticed, line = fails(folder, mutation.test)
        unnoticed += not noticed
        verdict = "noticed" if noticed else "NOT NOTICED"
        print(f"{verdict:12s} {name}: {mutation.test} ({time.perf_counter() - started:.0f} s: {line})", flush=True)
    print(f"{len(wanted) - unnoticed} of {len(wanted)} mutations noticed")
    return 1 if unnoticed else 0


if __name__ == "__main__":
    sys.exit(main())
