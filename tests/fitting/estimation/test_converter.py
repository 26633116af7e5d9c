"""Limits and steps of the converter: named and left out, never taken for noise, nor for a stuck sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from adis_gonio import fit, trace
from adis_gonio.base.errors import DataError
from adis_gonio.fitting.estimation import screening as module
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.screening import converter_of, is_lively, steps_of
from adis_gonio.model.records import Dwell, Session

LSB_MG = 0.4672


def dwells(rng: np.random.Generator, step: float, limit: float | None = None) -> list[Dwell]:
    made = []
    for k, level in enumerate((990.0, 300.0, -700.0)):
        rows = rng.normal([level, 50.0], 5.0, (400, 2))
        rows = step * np.round(rows / step)
        if limit is not None:
            rows = np.clip(rows, -limit, limit)
        made.append(Dwell(k + 1, 10.0 * k + np.arange(400) / 100, rows))
    return made


def turn(
    rng: np.random.Generator, n: int = 24, noise: float = 3.0, bias: tuple[float, float] = (20.0, -30.0)
) -> list[np.ndarray]:
    """Samples in words of a part turned in steps of 15°, with a bias; angles are 15° k."""
    angle = np.radians(15.0 * np.arange(n) + 3.0)
    level = 1000.0 / LSB_MG * np.stack([np.cos(-angle), np.sin(-angle)], axis=1) + np.array(bias)
    return [np.round(rng.normal(row, noise, (200, 2))) for row in level]


def session(rows: list[np.ndarray]) -> Session:
    return Session(
        tuple(
            Dwell(k, 5.0 * k + np.arange(len(r)) / 100, r.astype(float), angle_deg=15.0 * k % 360)
            for k, r in enumerate(rows)
        ),
        fixture_sigma_deg=0.01,
    )


@pytest.mark.parametrize("step", [0.01, LSB_MG, 2.5, 9.0, 25.0])
def test_noise_is_no_limit_however_coarse_the_converter(step: float) -> None:
    assert not any(converter_of(dwells(np.random.default_rng(seed), step)).limits for seed in range(100))


def test_samples_at_a_limit_are_counted_and_their_position_named() -> None:
    (limit,) = converter_of(dwells(np.random.default_rng(1), LSB_MG, limit=992.0)).limits
    assert (limit.axis, limit.value, limit.positions, limit.spoiled) == (0, 992.0, (1,), (1,))
    assert limit.samples > 100


def test_the_step_is_the_common_divisor_of_words_and_not_one_that_chance_may_give() -> None:
    rng = np.random.default_rng(2)
    rows = [np.round(rng.normal(100, 20, (50, 1))) for _ in range(4)]
    assert steps_of(rows) == [1.0]
    assert steps_of([4 * own for own in rows]) == [4.0]
    assert steps_of([np.array([[0.0], [2.0]]), np.array([[4.0], [6.0]])]) == [1.0]
    assert steps_of([np.array([[0.5], [0.5]])]) == [0.0]


@pytest.mark.parametrize("seed", range(6))
def test_dwells_that_stand_at_a_limit_take_no_part_and_saturation_is_found(seed: int) -> None:
    words = 1900.0
    cut = session([np.clip(rows, -words, words) for rows in turn(np.random.default_rng(seed))])
    # What is clear of the limit by the noise stays; what stands above it goes.
    readings = readings_of(cut)
    assert {0, 6, 12, 18} & set(readings.position.tolist()) == set()
    assert {3, 9, 15, 21} <= set(readings.position.tolist())
    result = fit(cut)
    assert abs(result["bias_x"].value - 20 * LSB_MG) < 5 * (result["bias_x"].u or 0)
    assert abs(result["delta_k"].value) < 5 * (result["delta_k"].u or 0)
    assert any("a limit was reached" in line for line in result.warnings)
    found = {finding.effect: finding for finding in trace(cut).found}
    limit = found["saturation"].parameters["limit"]
    assert abs(limit.value - words * LSB_MG) <= 2 * (limit.u or 0)


def test_a_limit_at_count_zero_has_a_size_and_an_uncertainty() -> None:
    from adis_gonio.tracing.within.faults import saturation

    rows = [np.clip(own + 2137, 0, None) for own in turn(np.random.default_rng(1), bias=(0.0, 99.0))]
    cut = replace(session(rows), accel_unit="counts", sensor="generic")
    found = saturation(cut, readings_of(cut))
    assert found is not None
    limit = found.parameters["limit"]
    assert limit.value == pytest.approx(2137 * LSB_MG, rel=0.03)
    assert 0 < (limit.u or np.nan) < 30


def test_one_dwell_at_either_end_of_the_same_range_is_a_limit_and_none_of_them_stuck() -> None:
    rows = turn(np.random.default_rng(5), bias=(0.0, 0.0))
    for own in rows:
        own[:, 0] = np.clip(own[:, 0], -2120, 2120)
    assert [k for k, own in enumerate(rows) if np.ptp(own[:, 0]) == 0] == [0, 12]
    assert set(readings_of(session(rows)).position.tolist()) == set(range(24)) - {0, 12}


@pytest.mark.parametrize("where", [0, 3])
def test_an_axis_that_is_stuck_is_no_limit_wherever_it_stuck(where: int) -> None:
    rows = turn(np.random.default_rng(3))
    word = rows[where][-1, 0]
    for later in rows[where + 1 :]:
        later[:, 0] = word
    with pytest.raises(DataError, match="stuck data"):
        readings_of(session(rows))


@pytest.mark.parametrize("bits", [16, 32])
def test_words_that_have_lost_bits_are_quantization_and_not_stuck(bits: int) -> None:
    coarse = session([bits * np.round(rows / bits) for rows in turn(np.random.default_rng(4))])
    found = {finding.effect: finding for finding in trace(coarse).found}
    assert found["quantization"].parameters["lsb"].value == pytest.approx(bits * LSB_MG)


def test_uncertainties_of_words_that_have_lost_bits_hold() -> None:
    z = []
    for seed in range(25):
        rng = np.random.default_rng(100 + seed)
        bias = rng.uniform(0, 16, 2)  # another place on the staircase each time
        rows = turn(rng, bias=(float(bias[0]), float(bias[1])))
        result = fit(session([16 * np.round(own / 16) for own in rows]))
        z.append((result["bias_x"].value - bias[0] * LSB_MG) / (result["bias_x"].u or np.nan))
    # 1 in expectation; without the lost bits' share u would be eight times too small.
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.6


@pytest.mark.parametrize("noise", [1.0, 3.0, 10.0])
def test_the_step_of_a_healthy_sensor_is_no_finding(noise: float) -> None:
    from adis_gonio.tracing.within.faults import quantization, saturation
    from adis_gonio.tracing.within.samples import samples_of
    from adis_gonio.tracing.within.second_pass import correlation_reach

    for seed in range(30):
        whole = session(turn(np.random.default_rng(200 + seed), noise=noise))
        data = readings_of(whole)
        samples = samples_of(whole, data)
        assert samples is not None
        assert saturation(whole, data) is None
        assert quantization(samples, correlation_reach(samples)) is None


def piled(at_limit: int, inside: int, sign: float = 1.0, values: int = 40) -> list[Dwell]:
    """One axis of two: a slope of values with so many samples at its end and at the value before it."""
    steps = np.repeat(np.arange(values, dtype=float), 2)
    column = np.concatenate([steps, np.full(inside, values + 0.0), np.full(at_limit, values + 1.0)])
    rows = np.stack([sign * column, np.zeros(len(column))], axis=1)
    return [Dwell(3, np.arange(len(rows)) / 100, rows)]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("at_limit", "inside", "found"),
    [
        (20, 4, True),
        (19, 1, False),
        (20, 5, False),
        (24, 5, False),
        (25, 5, True),
        (60, 12, True),
        (59, 12, False),
    ],
)
def test_a_pile_of_twenty_five_times_as_high_as_its_neighbour_is_a_limit(
    at_limit: int, inside: int, sign: float, found: bool
) -> None:
    limits = converter_of(piled(at_limit, inside, sign)).limits
    assert bool(limits) == found
    if found:
        (limit,) = limits
        assert (limit.axis, limit.value, limit.samples, limit.inside) == (0, sign * 41, at_limit, inside)
        assert limit.positions == (3,)


def test_noise_counts_only_if_it_is_larger_than_an_edge_between_two_codes_can_show() -> None:
    edge = np.tile([0.0, 4.0], 100)  # half of the samples on each side: half a step rms
    noise = np.tile([-4.0, 0.0, 0.0, 4.0, 0.0], 40)  # 0.63 steps
    steps = np.array([4.0, 4.0, 0.0])
    samples = np.column_stack([edge, noise, np.zeros(200)])
    assert is_lively([samples], steps).tolist() == [False, True, False]
    # The median of the dwells decides.
    still = np.zeros((200, 3))
    assert is_lively([samples, samples, still], steps).tolist() == [False, True, False]
    assert is_lively([samples, still, still], steps).tolist() == [False, False, False]


def test_few_values_show_no_limit() -> None:
    assert not converter_of(piled(40, 2, values=18)).limits
    assert converter_of(piled(40, 2, values=20)).limits


def test_a_limit_may_be_reached_by_all_samples_but_those_of_other_dwells() -> None:
    rng = np.random.default_rng(3)
    free = np.stack([rng.normal(0, 10, 60), rng.normal(0, 10, 60)], axis=1)
    stands = np.stack([np.full(60, 99.0), rng.normal(0, 10, 60)], axis=1)
    made = [
        Dwell(k, 10.0 * k + np.arange(60) / 100, rows) for k, rows in enumerate((free, stands, free + 1))
    ]
    (limit,) = converter_of(made).limits
    assert (limit.value, limit.samples, limit.positions, limit.spoiled) == (99.0, 60, (1,), (1,))
    assert converter_of(made).spoiled == {1}


@pytest.mark.parametrize("share", [0.0001, 0.001, 0.005, 0.02])
def test_a_limit_moves_a_mean_by_what_it_cuts_off_a_normal_distribution(share: float) -> None:
    z = norm.isf(share)
    cut = quad(lambda x: (x - z) * norm.pdf(x), z, 12)[0]
    # A tenth of the mean's standard uncertainty is reached with so many samples.
    n = (0.1 / cut) ** 2
    assert module._moves(share, int(n * 1.02) + 1)
    assert not module._moves(share, int(n * 0.98))


def test_half_of_the_samples_at_a_limit_always_move_the_mean() -> None:
    assert module._moves(0.5, 2)
    assert module._moves(1.0, 1)


@pytest.mark.parametrize(("gaps", "step"), [(9, 1.0), (10, 4.0)])
def test_a_divisor_counts_where_chance_would_give_it_once_in_a_million(gaps: int, step: float) -> None:
    # Each gap is divided by four with a chance of a quarter: 4⁻¹⁰ is just below a millionth.
    assert steps_of([4.0 * np.arange(gaps + 1.0)[:, None]]) == [step]


def test_the_step_of_other_numbers_is_the_smallest_difference_but_for_rounding() -> None:
    rows = np.array([[1.0], [1.25], [3.0], [3.0 + 1e-12]])
    assert steps_of([rows, np.array([[5.0], [5.125]])]) == [0.125]
    whole = np.array([[0.0], [2.0], [6.0]])
    assert steps_of([whole, rows]) == [0.25]
    assert steps_of([rows, whole]) == [0.25]
    both = steps_of([np.column_stack([whole, whole / 8])])
    assert both.tolist() == [1.0, 0.25]


@pytest.mark.parametrize("coarse", [0, 1])
def test_a_step_is_the_finding_of_the_axis_whose_noise_does_not_hide_it(coarse: int) -> None:
    from adis_gonio.tracing.within.faults import quantization
    from adis_gonio.tracing.within.samples import samples_of
    from adis_gonio.tracing.within.second_pass import correlation_reach

    for seed in range(5):
        rng = np.random.default_rng(300 + seed)
        noise = np.full(2, 4.0)  # 0.6 steps hide the staircase, 0.27 do not
        noise[coarse] = 1.8
        angle = np.radians(15.0 * np.arange(24) + 3.0)
        level = 1000.0 * np.stack([np.cos(-angle), np.sin(-angle)], axis=1)
        rows = [6.7 * np.round(rng.normal(row, noise, (200, 2)) / 6.7) for row in level]
        whole = replace(session(rows), accel_unit="mg", sensor="generic")
        samples = samples_of(whole, readings_of(whole))
        assert samples is not None
        found = quantization(samples, correlation_reach(samples))
        assert found is not None
        assert found.axes == ("xy"[coarse],)
        assert found.p_value < 1e-6
        assert found.parameters["lsb"].value == pytest.approx(6.7)
