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
#: Folders of the code, without the links in mauvecl to the first two.
SOURCES = ("host", "kernels", "mauvecl")

#: A text of the code and the one that replaces it.
Edit = tuple[str, str]
#: The function of the test that must fail with the edits and passes without, with its parameters, and the edits.
Mutation = tuple[str, *tuple[Edit, ...]]

SWAPPED = (
    "w[${4 * i}] = c0[${i}]; w[${4 * i + 1}] = c1[${i}]",
    "w[${4 * i}] = c1[${i}]; w[${4 * i + 1}] = c0[${i}]",
)
SHAPE = "    g1, g2, g3 = c.shape()\n    sd ="

MUTATIONS: dict[str, Mutation] = {
    "one unknown's row dropped": (
        "test_marginalised_statistics_keep_false_alarms_and_power[0.1]",
        ("nuisances.names if nuisances else ()))", "nuisances.names[1:] if nuisances else ()))"),
    ),
    "a sky that follows no level": (
        "test_sky_follows_its_level[level0]",
        ("factors.light * factors.sky * share / light", "0.0 * share / light"),
    ),
    "unknowns marginalised without their prior": (
        "test_subtracted_rows_give_the_inverse_covariance[chi2]",
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
        ('int(scene.numbers[frame]), "stare_sums"', '0, "stare_sums"'),
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
        "test_splitting_changes_no_bit[cumulants]",
        ("_padded(stare.numbers, np.uint32)", "_padded(np.arange(stare.n_frames), np.uint32)"),
    ),
    "a shard's flares from the first": (
        "test_shards_of_stares_join_to_the_same_bits[None-cumulants]",
        ("request.flares.part(first - request.start,", "request.flares.part(done,"),
    ),
    "a shard under another's name": (
        "test_misplaced_shard_is_found",
        ('name.encode() + b"\\0" + body', "body"),
    ),
    "foreign chunks unseen": (
        "test_damage_is_found_and_repaired_to_the_bit",
        ('return "good" if digest(data) == known else "foreign"', 'return "good"'),
    ),
    "half a failed shard kept": (
        "test_failed_launch_is_repeated",
        (
            "        tally, samples = Tally(plan.grids), plan.tails()\n",
            "        tally, samples = vars(request).setdefault('_kept', (Tally(plan.grids), plan.tails()))\n",
        ),
    ),
    "far values lost": (
        "test_numbers_equal_those_of_sorting[0]",
        ("        self._add_far(tile, tally)\n", ""),
    ),
    "far S/N lost": (
        "test_snr_equals_that_of_sorting[16-0]",
        ("            self._add_far_snr(tile, counts, np.flatnonzero(outside))\n", ""),
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
        "test_pearson_of_the_expansion",
        ("nearest(FMA(z, FMA(z, curve, (floatv)slope), (floatv)offset))", "nearest(z * slope + offset)"),
        ("nearest(fma(z, fma(z, curve, slope), offset))", "nearest(z * slope + offset)"),
    ),
    "rounded normal for the joint draw": (
        "test_pearson_of_raw_counts",
        (SHAPE, SHAPE.replace("c.shape()", "(0.0 * g for g in c.shape())")),
    ),
    "skew-only expansion of the dark": (
        "test_expansion_cannot_be_distinguished_from_exact_draws",
        ("= -1 / (72 * root)", "= 0.0"),
    ),
    "joint draw allowed by its skew alone": (
        "test_worst_draws_that_the_region_allows",
        (" & ~is_noticeable(truncation_distance(c, fourth_power=True), c.variance)", ""),
    ),
    "fourth power left out too early": (
        "test_worst_draws_that_the_region_allows",
        ("345 * fourth**2", "34.5 * fourth**2"),
    ),
    "rounding taken for noise everywhere": (
        "test_auto_mode_stacks_only_where_moments_agree",
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
        "test_snr_includes_photon_noise_of_sky",
        ("        signal -= (floatv)element.sky;\n", ""),
        ('        signal = signal - element["sky"]\n', ""),
    ),
    "carry of the index dropped between launches": (
        "test_draws_at_counter_boundaries_equal_reference",
        ("np.uint32(self.first >> 32)", "np.uint32(0)"),
    ),
    "carry of the index dropped within a launch": (
        "test_draws_at_counter_boundaries_equal_reference",
        ("first = index - index % size", "first = index - index % self._step"),
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
        ("rich << shift | left[poor]", "rich << shift | max(left[poor] - 1, 0)"),
    ),
    "alias table off by one count": (
        "test_pearson_of_raw_counts",
        ("low + int(inside[0]))", "low + int(inside[0]) + 1)"),
    ),
    "two streams alike": (
        "test_streams_are_distinct_bytes",
        ('\n    "dark": 1,', '\n    "dark": 0,'),
    ),
    "priors' tables too coarse at their ends": (
        "test_drawn_factors_have_the_moments_of_the_prior",
        ("PRIOR_BITS = 7", "PRIOR_BITS = 4"),
    ),
    "priors' finer digits dropped": (
        "test_drawn_factors_have_the_tails_of_the_prior",
        ("finer & (uintv)0x7fffffu", "finer & (uintv)0u"),
        ("finer & np.uint32(0x7FFFFF)", "finer & np.uint32(0)"),
    ),
    "saturation at the ADC's end alone": (
        "test_closed_forms_follow_simulation",
        ("min(self.saturation_dn, float(self.adc_max_dn))", "float(self.adc_max_dn)"),
    ),
    "reference of what is not recorded": (
        "test_closed_forms_follow_simulation",
        ("mean_sum = reference.recorded_dn", "mean_sum = reference.n_frames * reference.mean_raw_dn"),
    ),
    "noise of what is subtracted forgotten": (
        "test_sampled_tail_agrees_for_every_comparison",
        ("return 1.0 + comparison.added_variance", "return 1.0"),
    ),
    "quiescent exposures with the observed draws": (
        "test_null_follows_its_closed_form",
        ("REFERENCE = 64", "REFERENCE = 0"),
    ),
    "closed forms that follow a temperature by their means alone": (
        "test_closed_forms_integrate_over_drawn_unknowns[half a degree]",
        (", seen.variance + each @ variances)", ", seen.variance)"),
    ),
    "moved scores that count like others": (
        "test_sampled_tail_with_unknowns_agrees_with_brute_force[half a degree]",
        ("np.log(2.0) - np.logaddexp(0.0, ratio)", "np.zeros(BLOCK)"),
    ),
    "shifts forgotten in the closed form's phase": (
        "test_equal_weights_are_a_scaled_non_central_chi_squared",
        (
            "(np.arctan(turn) * count).sum(axis=1) + (u[:, None] * pull / spread).sum(axis=1)",
            "(np.arctan(turn) * count).sum(axis=1) + 0.0 * u",
        ),
    ),
    "one smoothed value in four dropped": (
        "test_null_follows_its_closed_form",
        ("[k][s + 3u] = d;", "[k][s + 3u] = 0.0f;"),
        ("for centre, row in enumerate(self.rows):", "for centre, row in enumerate([]):"),
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
    for name in (*SOURCES, "tests", "pyproject.toml"):
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
