"""Shapes, energies and rates of flares, and the closed form of completeness: published values, integrals, frames."""

import itertools
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy import constants
from astropy.modeling.models import BlackBody
from scenes import through
from scipy import stats
from scipy.integrate import quad
from scipy.special import erfc

from mauvecl import SHAPES, Cooling, EnergyScale, Event, Source, Study, TableShape, plan
from mauvecl.search import completeness

#: A shape whose height and length follow from its equivalent duration.
FIDUCIAL: Any = SHAPES["fiducial"]
#: Where each shape has a kink or a step.
KINKS = {"davenport2014": [-1.0, 0.0], "tovarmendoza2022": [0.0], "fiducial": [0.0, FIDUCIAL.BOX], "table": [0.0, 1.0]}
TABLE = TableShape(np.array([-1.0, 0.0, 1.0, 4.0]), np.array([0.0, 3.0, 1.0, 0.0]))
every_shape = pytest.mark.parametrize("shape", [*SHAPES.values(), TABLE], ids=lambda shape: shape.name)


def between(function, first: float, last: float, kinks: list[float]) -> float:
    ends = [first, *(k for k in kinks if first < k < last), last]
    return sum(quad(function, a, b, epsabs=1e-14, epsrel=1e-12, limit=400)[0] for a, b in itertools.pairwise(ends))


def test_shapes_equal_the_published_formulas_and_small_integrals_keep_their_digits():
    # Tovar Mendoza et al. 2022 as printed, with plain exp and erfc.
    shape, tau = SHAPES["tovarmendoza2022"], np.linspace(-1.2, 30, 500)
    a, b, c = shape.A, shape.B, shape.C
    printed = sum(
        np.sqrt(np.pi) / 2 * a * c * f * np.exp(-d * tau + (b / c + d * c / 2) ** 2) * erfc((b - tau) / c + c * d / 2)
        for f, d in shape.DECAY
    )
    np.testing.assert_allclose(shape.at(tau), printed, rtol=1e-10, atol=1e-15)
    with np.errstate(all="raise", under="ignore"):
        far = shape.at(np.array([-1e4, -50.0, 1e4]))
    assert (far == 0).all()
    # The fiducial flare has its equivalent duration.
    for delta in (100.0, 1000.0, 1e5):
        amplitude, half_width = FIDUCIAL.of(delta)
        assert amplitude == pytest.approx(0.3 * delta**0.6)
        assert amplitude * half_width * FIDUCIAL.equivalent_duration == pytest.approx(delta, rel=1e-12)
        assert amplitude * half_width * FIDUCIAL.BOX == pytest.approx(delta / 1.5, rel=1e-12)
    # Against quadrature in units of the shape's own value at the end, down to where doubles end.
    shape = SHAPES["tovarmendoza2022"]
    for tau in (-0.2513, -0.4, -1.0, -2.0, -4.0, -6.0):
        scale = float(shape.at(tau))
        exact, _ = quad(lambda t, unit: float(shape.at(t)) / unit, tau - 1.0, tau, scale, epsrel=1e-12, limit=400)
        assert float(shape.before(tau)) / scale == pytest.approx(exact, rel=1e-8)
    # The difference of two integrals from the beginning would have none left here.
    shape = SHAPES["davenport2014"]
    exact = sum(a / b * (np.exp(-b * 100) - np.exp(-b * 101)) for a, b in shape.DECAY)
    assert float(shape.integral(100, 101)) == pytest.approx(exact, rel=1e-10)


@every_shape
def test_integrals_agree_with_quadrature_and_peaks_with_a_fine_scan(shape):
    kinks = KINKS[shape.name]
    top = max(kinks) + 3.0
    tail = quad(lambda t: float(shape.at(t)), top, np.inf, epsabs=1e-14)[0] if shape is not TABLE else 0.0
    whole = between(lambda t: float(shape.at(t)), -3.0, top, kinks) + tail
    assert shape.equivalent_duration == pytest.approx(whole, abs=1e-11)
    squares = between(lambda t: float(shape.at(t)) ** 2, -3.0, top + 100, [*kinks, top, top + 10, top + 30])
    assert shape.square_integral == pytest.approx(squares, abs=1e-11)
    # Pieces anywhere, of any length.
    edges = np.array([-2.5, -1.3, -1.0, -0.7, -0.2, 0.0, 0.1, 0.6, 0.9, 3.0, 3.5, 9.0])
    exact = [between(lambda t: float(shape.at(t)), a, b, kinks) for a, b in itertools.pairwise(edges)]
    np.testing.assert_allclose(shape.integral(edges[:-1], edges[1:]), exact, atol=1e-12)
    tau = np.linspace(-2, 5, 700_001)
    values = shape.at(tau)
    # Davenport's peak is a step's upper edge.
    assert values.max() == pytest.approx(shape.peak, abs=1e-8)
    assert (values > shape.peak / 2).sum() * 1e-5 == pytest.approx(shape.width, abs=3e-5)
    assert Event(0.0, 1.0, 0.4, shape=shape).peak == pytest.approx(0.4 * values.max(), abs=1e-8)


@every_shape
def test_frames_sum_to_the_fluence_and_conserve_light_of_any_flare(shape):
    edges = np.arange(-100, 30_001) * 5.0
    means = shape.mean_over(edges, 777.7, 33.0)
    assert 5.0 * means.sum() == pytest.approx(33.0 * shape.equivalent_duration, rel=1e-12)
    pairs = np.column_stack([edges[:-1], edges[1:]])[[3, 255, 256, 900]]
    np.testing.assert_array_equal(shape.mean_over(pairs, 777.7, 33.0), means[[3, 255, 256, 900]])
    several = shape.mean_over(edges, np.array([[777.7], [900.0]]), np.array([[33.0], [10.0]]))
    np.testing.assert_array_equal(several[0], means)
    # Whole stares about 400 random flares: scipy's erfc underflows to 0 before a product with an exponential does.
    rng = np.random.Generator(np.random.Philox(26))
    for _ in range(400):
        peak, half = rng.uniform(-2000.0, 8000.0), 10 ** rng.uniform(-2.0, 6.0)
        with np.errstate(all="raise", under="ignore"):
            assert (shape.mean_over(np.arange(1201) * 5.0, peak, half) >= 0).all(), (peak, half)


@pytest.mark.parametrize("start", [0.0, -4.0])
def test_cooling_flare_of_a_table_has_all_of_its_energy_in_any_unit_of_time(start: float) -> None:
    energies = []
    for unit_s in (100.0, 0.1):
        shape = TableShape((TABLE.tau + start) * 100.0 / unit_s, TABLE.values)
        event = Event(0.0, unit_s, 0.1, Cooling(12_000.0, 6000.0, 150.0), shape)
        energies.append(event.total_energy(lambda kelvin: EnergyScale("Kepler", "bolometric", kelvin, "any star")))
    assert energies[1] == pytest.approx(energies[0], rel=1e-5)


SUN_CM, NM = 6.957e10, np.linspace(200.0, 1200.0, 40_001)
#: erg/s of Shibayama et al. 2013's formula by other tables of the bands, for flares of 9000 and 10 000 K.
ELSEWHERE = [
    ("Kepler", 5778, 1.0, 1.1774e33, 1.3289e33),
    ("Kepler", 4830, 0.755, 2.9825e32, 3.3663e32),
    ("Kepler", 3200, 0.2, 1.9525e30, 2.2037e30),
    ("TESS", 5778, 1.0, 1.5365e33, 1.8197e33),
]


def planck(kelvin: float) -> np.ndarray:
    """Return the flux at the surface of a blackbody at `NM`, by astropy, erg s-1 cm-2 A-1."""
    scale = 1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr)
    return np.asarray(np.pi * BlackBody(kelvin * u.K, scale=scale)(NM * u.nm).value)


@pytest.mark.parametrize(("name", "star_k", "radius", "cool", "hot"), ELSEWHERE)
def test_energies_agree_with_direct_integration_and_other_band_tables(
    name: str, star_k: float, radius: float, cool: float, hot: float
) -> None:
    # The embedded bands are those of pyphot; with another table of Kepler's or TESS's energies differ by up to 1.4 %.
    sphere = 4 * np.pi * (radius * SUN_CM) ** 2
    for flare_k, elsewhere in ((9000.0, cool), (10_000.0, hot)):
        bolometric = sphere * 5.670374419e-5 * flare_k**4
        star, flare = planck(star_k), planck(flare_k)
        bodies, weighted = (through(name, NM, by * star) / through(name, NM, by * flare) for by in (NM, 1.0))
        published = EnergyScale.shibayama2013(radius, star_k, band=name, flare_k=flare_k).erg_per_s
        assert published == pytest.approx(bolometric / 4 * weighted, rel=2e-6)
        assert published == pytest.approx(elsewhere, rel=0.015)
        exact = {"bolometric": bolometric * bodies, "band": sphere * bodies * through(name, NM, flare)}
        for kind, value in exact.items():
            scale = EnergyScale.of_blackbody(radius, star_k, band=name, flare_k=flare_k, kind=kind)  # type: ignore[arg-type]
            assert scale.erg_per_s == pytest.approx(value, rel=2e-6)


def planned(targets: dict[str, dict[str, Any]], kind: str = "K5V", **changes: Any) -> Any:
    """Return the plan of stars of V = 8 in 10 pc that differ in their rates."""
    star = {"coordinates": "10.5 -3.0", "spectral_type": kind, "magnitude": 8.0, "distance_pc": 10.0}
    rows = [{"name": name, **star, **rates} for name, rates in targets.items()]
    asked = {"completeness": "closed form", "targets": rows} | changes.pop("plan", {})
    return plan(Study.build({"plan": asked, "orbit": {"days": 3.0}} | changes, "test"))


def rate(answer: Any, name: str, energy: Any) -> Any:
    """Return the flares per day above an energy, of a power law between the energies of the table."""
    table = answer.by_energy[answer.by_energy["target"] == name]
    above = table["rate_above"].value
    seen = above > 0
    grid = np.log(table["energy"].value[seen])
    return np.exp(np.interp(np.log(energy), grid, np.log(above[seen])))


@pytest.fixture(scope="module")
def answer(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("rates") / "own.csv"
    path.write_text("energy,rate\n1e31,2.0\n1e32,0.5\n1e34,0.001\n")
    return planned({
        "young": {"mass_msun": 0.5, "age_myr": 100.0}, "old": {"mass_msun": 0.5, "age_myr": 5000.0},
        "G": {"rates": "G"}, "K": {"rates": "K"}, "M": {"rates": "M"},
        "own": {"alpha": 1.8, "rate_per_day": 0.2, "at_erg": 1e33},
        "rare": {"alpha": 2.0, "rate_per_day": 1e-3, "at_erg": 1e33},
        "table": {"rates_file": path}, "TESS": {"rates_file": path, "rates_band": "TESS"},
    })  # fmt: skip


def test_rates_equal_published_values_and_the_convention_of_altaipony(answer: Any) -> None:
    """Davenport et al. 2019 (TIME.md, section 3), whose energies are those of the star's light in the Kepler band."""
    star = Source.from_library("K5V").at_magnitude(8.0)
    light = EnergyScale.of_star(star, 10.0, flare_k=10_000.0).erg_per_s
    luminosity = 4 * np.pi * (10 * u.pc).to_value(u.cm) ** 2 * through("Kepler", star.wavelength_nm, star.flux_flam)
    assert rate(answer, "young", 1e33 * light / luminosity) == pytest.approx(0.074131, rel=2e-5)
    # Fewer flares of older stars.
    assert rate(answer, "old", 1e33) < rate(answer, "young", 1e33)
    # Flares between two energies are the integral of dN/dE = beta E^-alpha.
    energy = np.geomspace(1e33, 1e34, 200_001)
    beta = 0.2 * 0.8 * 1e33**0.8
    between = np.trapezoid(beta * energy**-1.8, energy)
    found = rate(answer, "own", np.array([1e33, 1e34]))
    assert found[0] == pytest.approx(0.2, rel=1e-9)
    assert found[0] - found[1] == pytest.approx(between, rel=1e-6)
    exponents = [1 - np.log10(rate(answer, name, 1e33) / rate(answer, name, 1e32)) for name in "GKM"]
    assert 1.5 < exponents[0] < exponents[1] < exponents[2] < 2.1


@pytest.mark.parametrize(("kind", "factor"), [("M3V", 1.187), ("G2V", 1.049)])
def test_energies_of_patches_become_those_of_light(kind: str, factor: float) -> None:
    """One flare of 7e33 erg in 3000 years (Maehara et al. 2012), of a patch seen face on, weighted with energies."""
    found = planned({"sunlike": {"rates": "sunlike"}}, kind)
    assert rate(found, "sunlike", 4 * factor * 7e33) == pytest.approx(1 / (3000 * 365.25), rel=2e-3)


def test_rates_of_a_table_are_converted_from_its_band(answer: Any) -> None:
    nm = np.linspace(550.0, 1150.0, 60_001)
    flux = np.pi * BlackBody(10_000 * u.K, scale=1 * u.erg / (u.s * u.cm**2 * u.AA * u.sr))(nm * u.nm).value
    whole = (constants.sigma_sb * (10_000 * u.K) ** 4).to_value(u.erg / (u.s * u.cm**2))
    for name, factor in (("table", 1.0), ("TESS", whole / through("TESS", nm, flux))):
        table = answer.by_energy[answer.by_energy["target"] == name]
        energy, above = table["energy"].value / factor, table["rate_above"].value
        inside = energy <= 1e34
        expected = np.exp(np.interp(np.log(energy), np.log([1e31, 1e32, 1e34]), np.log([2.0, 0.5, 0.001])))
        np.testing.assert_allclose(above[inside], expected[inside], rtol=1e-4)
        # Beyond the table there are no flares, and below it no more.
        assert (above[~inside] == 0).all()
        assert above.max() == pytest.approx(2.0)


def test_yields_are_those_of_poisson_and_of_scattered_rates(answer: Any) -> None:
    """Compare with 200 000 draws, whose quantiles are known to half a per cent."""
    rng, scatter = np.random.default_rng(11), {star["target"]: star["scatter"] for star in answer.stars}
    assert (scatter["own"], scatter["young"]) == (0.0, 0.5)
    for row in answer.table:
        mean, sd = float(row["expected"]), float(scatter[row["target"]])
        if sd == 0:
            assert (row["low"], row["high"]) == tuple(stats.poisson.ppf([0.025, 0.975], mean))
            assert row["at_least_one"] == pytest.approx(-np.expm1(-mean))
            continue
        draws = rng.poisson(mean * 10 ** (sd * rng.standard_normal(200_000)))
        assert row["at_least_one"] == pytest.approx((draws > 0).mean(), abs=0.004)
        assert [row["low"], row["high"]] == pytest.approx(np.quantile(draws, [0.025, 0.975]), rel=0.03, abs=1)


def test_closed_form_completeness_agrees_with_white_noise() -> None:
    """Compare with matched filters of the correct width in 2000 drawn stretches; a test in 70 fails by chance."""
    answer = planned({"own": {"alpha": 1.8, "rate_per_day": 0.2, "at_erg": 1e33}}, plan={"scatter_dex": 0.0})
    (star,), table, shape = answer.stars, answer.by_energy, SHAPES["davenport2014"]
    window, signal = star["window"].to_value("s"), float(star["signal_per_frame"])
    # One false alarm per star-month of the default bank, by the closed form.
    threshold, per_second = 4.72, star["energy_per_second"].to_value("erg / s")
    rng, n = np.random.default_rng(3), round(window / 5.0)
    edges, line = np.arange(n + 1) * 5.0, np.linalg.qr(np.stack([np.ones(n), np.arange(n)], axis=1))[0]
    first = int(np.argmax(table["recovered"] > 0.05))
    for row in table[first : first + 10 : 2]:
        energy = row["energy"].to_value("erg")
        half = 100.0 * (energy / 1e33) ** 0.39
        amplitude = energy / per_second / (half * shape.equivalent_duration)
        flare = signal * amplitude * shape.mean_over(edges, rng.uniform(0, window, 2000)[:, None], half)
        template = flare - (flare @ line) @ line.T
        size = np.linalg.norm(template, axis=1)
        y = flare + rng.standard_normal(flare.shape)
        statistic = np.sum(y * template, axis=1) / np.maximum(size, 1e-12)
        found = ((statistic > threshold) & (size > threshold / 2)).mean()
        assert row["recovered"] == pytest.approx(found, abs=0.035)


@pytest.mark.long
@pytest.mark.parametrize("alpha", [1.6, 2.1])
def test_power_law_is_recovered_from_drawn_flares(alpha: float) -> None:
    """Fit 350 campaigns of some 60 recovered flares: 68 +- 5 % are within one sigma; a count in 22 fails by chance."""
    rng, error, campaigns = np.random.default_rng(19), 0.1, 350
    table = planned({"own": {"alpha": alpha, "rate_per_day": 0.2, "at_erg": 1e33}}).by_energy
    form = completeness.Completeness(table["energy"].value, np.asarray(table["recovered"]), "bolometric", "a plan")

    def per_day(energy: Any) -> Any:
        return 0.2 * (energy / 1e33) ** (1 - alpha)

    steps = np.geomspace(form.energy_erg[0], form.energy_erg[-1], 100_001)
    days = 60 / float(-np.diff(per_day(steps)) @ form.at(np.sqrt(steps[1:] * steps[:-1])))
    # Below nothing is recovered.
    least = float(form.energy_erg[np.argmax(form.probability > 1e-6)])
    inside = np.zeros((campaigns, 2), bool)
    for k in range(campaigns):
        energy = least * (1 - rng.random(rng.poisson(per_day(least) * days))) ** (1 / (1 - alpha))
        energy = energy[rng.random(energy.size) < form.at(energy)]
        blurred = energy * 10 ** (error * rng.standard_normal(energy.size))
        fit = completeness.fit_power_law(blurred, form, days, error_dex=error)
        truth = np.log10(per_day(fit.pivot_erg))
        inside[k] = abs(fit.alpha - alpha) < fit.alpha_sd, abs(fit.log10_rate - truth) < fit.log10_rate_sd
    assert inside.mean(axis=0) == pytest.approx([0.68, 0.68], abs=0.05)
