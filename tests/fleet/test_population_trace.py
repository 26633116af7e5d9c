"""The population trace: what it names, and what it does not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.special import logsumexp

from adis_gonio.base.errors import UsageError
from adis_gonio.fleet.population_likelihood import grid_of, inflations, log_factors
from adis_gonio.fleet.population_trace import PopulationResult, trace_population
from fleet.units import drawn, estimate, evidence_with
from tracing.named_truth import catalogued_term

HYSTERESIS = "hysteresis||x|hysteresis_x|mg"
CUBIC = "cubic||y|k3_y|mg/g³"


def names(result: PopulationResult) -> list[tuple[str, ...]]:
    return [one.effects for one in (*result.found, *result.sets)]


def test_the_factor_of_a_unit_is_the_integral_over_its_amplitude() -> None:
    """Against adaptive quadrature of likelihood times density (QUADPACK), one amplitude and two."""
    s, g, mean, spread = 1.7, 2.1, 0.6, 0.8

    def density(a: float, m: float) -> float:
        return float(np.exp(-0.5 * ((a - m) / spread) ** 2) / (spread * np.sqrt(2 * np.pi)))

    direct = quad(lambda a: np.exp(s * a - 0.5 * g * a * a) * density(a, mean), -12, 12)[0]
    factors = log_factors(np.array([[s]]), np.array([[[g]]]), np.array([[mean]]), spread)
    assert factors[0, 0] == pytest.approx(np.log(direct), abs=1e-7)

    score, info, centre = np.array([0.8, -1.2]), np.array([[1.5, 0.9], [0.9, 1.2]]), np.array([0.3, -0.4])

    def both(b: float, a: float) -> float:
        x = np.array([a, b])
        return float(np.exp(score @ x - 0.5 * x @ info @ x)) * density(a, centre[0]) * density(b, centre[1])

    direct = dblquad(both, -6, 6, -6, 6, epsabs=1e-8)[0]
    own = log_factors(score[None], info[None], centre[None], spread)
    assert own[0, 0] == pytest.approx(np.log(direct), abs=1e-5)


def test_the_expectation_of_the_average_over_the_grid_is_one_without_an_effect() -> None:
    """What makes it an e-value: by simulation of one unit's factor, cut or not."""
    rng = np.random.default_rng(5)
    score = rng.normal(size=(200_000, 1))
    information = np.ones((len(score), 1, 1))
    for size, spread in ((0.0, 0.7), (0.7, 0.25)):
        factors = np.exp(log_factors(score, information, np.array([[size]]), spread))
        assert factors.mean() == pytest.approx(1.0, abs=0.02)
    assert logsumexp(grid_of(2).log_prior) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("key", "sign"), [(HYSTERESIS, "random"), (CUBIC, "common")])
def test_an_effect_that_no_session_shows_is_named(key: str, sign: str) -> None:
    """Half a detection limit, 2.6 u, in three sessions of ten: in one session nothing, in 200 a name."""
    rng = np.random.default_rng(11)
    sizes = 2.6 * (rng.choice([-1, 1], 60) if sign == "random" else np.ones(60))
    result = trace_population(drawn(rng, 200, key, sizes))
    name, _, axis, *_ = key.split("|")
    assert names(result) == [(name,)]
    found = result.found[0]
    assert "".join(found.axes) == axis
    assert found.p_value < 1e-6
    assert found.heldout_gain > 5
    assert found.common_sign == (sign == "common")
    hit = {f"{i}.csv" for i in range(60)}
    assert np.mean([unit.source in hit for unit in found.affected[:20]]) > 0.75
    assert any(name in line for line in result.summary())


def test_share_and_mean_are_within_their_intervals() -> None:
    rng = np.random.default_rng(31)
    result = trace_population(drawn(rng, 100, HYSTERESIS, rng.normal(7.0, 2.0, 40)))
    found = result.found[0]
    assert found.share["low"] <= 0.4 <= found.share["high"]
    assert found.share["high"] - found.share["low"] < 0.25
    assert len(found.affected) == pytest.approx(40, abs=4)


def test_sessions_from_their_samples_agree() -> None:
    """Whole sessions by the tests' own physics, 0.45 mg of hysteresis in every second one."""
    rng = np.random.default_rng(21)
    term = catalogued_term("hysteresis", "y", 0.0).scaled(0.12)
    every = [evidence_with(rng, [term] if i % 2 else []) for i in range(40)]
    result = trace_population([replace(one, source=f"{i}") for i, one in enumerate(every)])
    assert names(result) == [("hysteresis",)]
    value = result.found[0].mean["hysteresis_y"]
    assert value.U is not None
    if not result.found[0].relative:
        assert abs(value.value - 0.12) < 2 * value.U


def test_populations_without_an_effect_give_no_name() -> None:
    for seed in range(3):  # their rate: scripts/population_statistics.py
        result = trace_population(drawn(np.random.default_rng(seed), 100))
        assert not names(result)
        assert not result.unnamed


def test_noise_stated_too_small_is_no_effect() -> None:
    """Each session scatters by another factor up to 2 more than it says."""
    rng = np.random.default_rng(4)
    every = [drawn(rng, 1, noise=float(rng.uniform(1, 2)))[0] for _ in range(100)]
    every = [replace(one, digest=f"{i:05d}") for i, one in enumerate(every)]
    result = trace_population(every)
    assert not names(result)
    assert result.inflation["median"] > 1.3
    assert "scatter more" in result.notes[0]


def test_one_gross_session_names_nothing() -> None:
    result = trace_population(drawn(np.random.default_rng(9), 100, HYSTERESIS, [60.0]))
    assert not names(result)


def test_an_effect_of_one_stage_is_named_with_its_stage() -> None:
    rng = np.random.default_rng(13)
    key = "stage_eccentricity|||ecc_sin|deg"
    every = drawn(rng, 90, key, 2.5 * np.ones(30))
    every = [replace(one, stage="A" if i < 30 else "BC"[i % 2]) for i, one in enumerate(every)]
    found = trace_population(every).found
    assert [(one.effects, one.by, one.value) for one in found] == [(("stage_eccentricity",), "stage", "A")]
    assert found[0].share["low"] > 0.5


def test_the_amplitude_is_that_of_the_affected_sessions_where_these_are_the_noisier_ones() -> None:
    """A large eccentricity is scatter to the fit without it: u of that stage are many times the others."""
    rng = np.random.default_rng(21)
    key = "stage_eccentricity|||ecc_sin|deg"
    every = drawn(rng, 60, key, 4.0 * np.ones(20))
    every = [
        replace(one, stage="A", length=one.length / 10) if i < 20 else replace(one, stage="B")
        for i, one in enumerate(every)
    ]
    planted = 4.0 * np.median([estimate(one, key)[1] for one in every[:20]])
    (found,) = trace_population(every).found
    assert (found.effects, found.value) == (("stage_eccentricity",), "A")
    value = found.mean["ecc_sin"]
    assert value.U is not None
    assert abs(value.value - planted) < 1.5 * value.U
    assert 0.3 * planted > value.U


def test_names_that_are_one_column_are_a_set() -> None:
    """In one plane a_x² is 1 − a_y²: beside a bias nobody can tell K2 from Kpp."""
    rng = np.random.default_rng(15)
    result = trace_population(drawn(rng, 200, "quadratic||x|k2_x|mg/g²", 3.5 * np.ones(100)))
    assert [set(one) for one in names(result)] == [{"quadratic", "cross_quadratic"}]
    assert not result.found


def test_order_does_not_matter_and_a_session_counts_once() -> None:
    rng = np.random.default_rng(17)
    every = drawn(rng, 60, HYSTERESIS, 3.0 * np.ones(25))
    first = trace_population(every)
    second = trace_population([*reversed(every), every[3]])
    assert {**first.as_dict(), "notes": []} == {**second.as_dict(), "notes": []}
    assert "count once" in second.notes[0]


def test_a_ratio_that_the_common_noise_cannot_explain_is_taken_as_it_is() -> None:
    every = drawn(np.random.default_rng(2), 50)
    odd = replace(every[0], scatter=tuple(p._replace(chi2=25 * p.dof) for p in every[0].scatter))
    factors = inflations([odd, *every[1:]])
    assert factors[0] == pytest.approx(25)
    assert np.median(factors[1:]) < 1.2


def test_too_few_sessions_are_refused() -> None:
    every = drawn(np.random.default_rng(2), 4)
    with pytest.raises(UsageError, match="at least 5"):
        trace_population(every)
