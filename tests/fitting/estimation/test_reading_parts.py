"""What readings are made of: units, limits of refusal, what dwells share, and what surrounds them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.estimation import readings as module
from adis_gonio.fitting.estimation.readings import (
    Unit,
    flicker_parts,
    from_means,
    mg_per_unit,
    quantized_means,
    readings_of,
    reduced,
)
from adis_gonio.fitting.estimation.spectrum import covariance_of_means
from adis_gonio.model.effects import Conditions
from adis_gonio.model.records import Dwell, Session
from fitting.estimation.turns import EIGHTHS, turn

MPS2_PER_MG = 9.80665e-3
QUARTERS = (0.0, 90.0, 180.0, 270.0)


def lengthened(session: Session, places: tuple[int, ...], factor: float) -> Session:
    dwells = [
        replace(dwell, accel=dwell.accel * (factor if k in places else 1.0))
        for k, dwell in enumerate(session.dwells)
    ]
    return replace(session, dwells=tuple(dwells))


def sampled(*dwells: Dwell, **more: object) -> Session:
    return Session(dwells, **{"accel_unit": "mg", "sensor": "generic", **more})


# -- what is refused, and from where ------------------------------------------------------------------


@pytest.mark.parametrize("length", [510.0, 1960.0])
def test_readings_within_a_factor_of_two_of_gravity_are_taken(length: float) -> None:
    assert len(readings_of(turn(length))) == 8


@pytest.mark.parametrize("length", [490.0, 2040.0])
def test_readings_beyond_a_factor_of_two_of_gravity_are_refused(length: float) -> None:
    with pytest.raises(DataError, match=r"^session: .* g long"):
        readings_of(turn(length))
    assert len(readings_of(turn(length, gravity_mps2=length * MPS2_PER_MG))) == 8, (
        "gravity is the session's"
    )


@pytest.mark.parametrize(("factor", "taken"), [(1.45, True), (1.55, False), (0.55, True), (0.45, False)])
def test_a_reading_may_be_off_the_median_by_half_of_it(factor: float, taken: bool) -> None:
    session = lengthened(turn(1200.0), (2,), factor)
    if taken:
        assert len(readings_of(session)) == 8
    else:
        with pytest.raises(DataError, match="readings of position 2 are not 1 g long"):
            readings_of(session)


def test_of_many_odd_readings_eight_are_named() -> None:
    angles = tuple(15.0 * k for k in range(24))
    with pytest.raises(
        DataError, match=r"^a\.csv: readings of positions 0, 1, 2, 3, 4, 5, 6, 7 and 2 more are not"
    ):
        readings_of(lengthened(turn(angles=angles, source="a.csv"), tuple(range(10)), 0.3))


def test_only_a_plane_that_reads_too_little_may_not_be_vertical() -> None:
    with pytest.raises(DataError) as caught:
        readings_of(turn(3000.0))
    assert "vertical" not in str(caught.value)
    rows = 0.3 * 1000 * np.eye(3)
    space = sampled(
        *(Dwell(k, np.array([10.0 * k]), row[None]) for k, row in enumerate(rows)), plane="none"
    )
    with pytest.raises(DataError) as caught:
        readings_of(space)
    assert "vertical" not in str(caught.value)


@pytest.mark.parametrize(
    ("length", "gravity", "refused"),
    # Half of the area that a perfect sensor of this gravity has.
    [(1000 * math.sqrt(0.51), 1000.0, True), (1000 * math.sqrt(0.49), 1000.0, False),
     (1020.0, 1400.0, True), (950.0, 1400.0, False)],
)  # fmt: skip
def test_a_turn_the_other_way_is_beyond_doubt_from_half_of_its_area(
    length: float, gravity: float, refused: bool
) -> None:
    session = turn(length, sign=-1.0, gravity_mps2=gravity * MPS2_PER_MG)
    if refused:
        with pytest.raises(DataError, match=r"^session: the readings turn the other way"):
            readings_of(session)
    else:
        assert len(readings_of(session)) == 8


@pytest.mark.parametrize(
    ("angles", "refused"),
    [
        (QUARTERS, True),
        (QUARTERS[:3], False),
        ((0.0, 35.0, 70.0, 105.0), True),
        ((0.0, 1.0, 2.0, 3.0), False),  # too small an arc to tell a turn from a zero
    ],
)
def test_a_turn_the_other_way_needs_positions_that_tell_it(
    angles: tuple[float, ...], refused: bool
) -> None:
    session = turn(sign=-1.0, angles=angles)
    if refused:
        with pytest.raises(DataError, match="the readings turn the other way"):
            readings_of(session)
    else:
        assert len(readings_of(session)) == len(angles)


def test_declared_angles_in_radians_are_named_as_the_cause() -> None:
    sound = turn()
    radians = replace(
        sound, dwells=tuple(replace(d, angle_deg=math.radians(d.angle_deg or 0.0)) for d in sound.dwells)
    )
    with pytest.raises(DataError, match=r"as if the declared angles, up to 5\.\d+, were radians"):
        readings_of(radians)
    few = (0.0, 1.0, 2.0, 3.0, 6.0)  # a small arc in degrees, as in the examples above
    assert len(readings_of(turn(angles=few))) == len(few)


def test_free_attitudes_and_counts_have_no_sense_of_rotation() -> None:
    assert len(readings_of(turn(sign=-1.0, fixture_sigma_deg=math.inf))) == 8
    assert len(readings_of(turn(sign=-1.0, accel_unit="counts", reading_u_mg=None))) == 8


def test_a_zero_and_unequal_gains_do_not_change_the_sense_of_rotation() -> None:
    back = turn(sign=-1.0)
    dwells = tuple(replace(d, accel=d.accel * [1.3, 0.75] + [150.0, -100.0]) for d in back.dwells)
    with pytest.raises(DataError, match="turn the other way"):
        readings_of(replace(back, dwells=dwells))


# -- units ---------------------------------------------------------------------------------------------


def test_a_value_in_mg_is_its_distance_from_zero_by_its_gain() -> None:
    unit = Unit("counts", np.array([100.0, 200.0]), np.array([2.0, 4.0]), 3.0)
    values = np.array([[40.0, 80.0, 7.0], [100.0, 0.0, 7.0]])
    np.testing.assert_allclose(unit.mg(values), [[(120 - 100) / 2, (240 - 200) / 4], [100.0, -50.0]])
    assert not unit.known
    plain = Unit("counts", np.array([100.0, 200.0]), np.array([2.0, 4.0]))
    np.testing.assert_allclose(plain.mg(values), [[-30.0, -30.0], [0.0, -50.0]])
    assert Unit("dps", np.zeros(2), np.ones(2)).known


def test_counts_have_the_zero_and_the_gain_of_their_ellipse() -> None:
    angle = np.radians(EIGHTHS)
    rows = np.array([3000.0, 2500.0]) + np.stack([400 * np.cos(angle), 500 * np.sin(angle)], axis=1)
    dwells = [Dwell(k, np.array([10.0 * k]), row[None], EIGHTHS[k]) for k, row in enumerate(rows)]
    data = reduced(sampled(*dwells, accel_unit="counts", gravity_mps2=980.0 * MPS2_PER_MG))
    np.testing.assert_allclose(data.unit.zero, [3000.0, 2500.0], rtol=1e-9)
    np.testing.assert_allclose(data.unit.per_mg, [400 / 980, 500 / 980], rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(data.mean, axis=1), 980.0)


def test_an_lsb_has_the_size_of_its_sensor() -> None:
    for name, variant in VARIANTS.items():
        assert mg_per_unit(turn(accel_unit="lsb", sensor=name)) == variant.accel_mg_per_lsb


# -- noise ---------------------------------------------------------------------------------------------


def test_averages_beside_sampled_dwells_have_their_stated_uncertainty_each_its_own() -> None:
    rng = np.random.default_rng(4)
    rows = rng.normal(1000.0, 2.0, (3, 50, 2))
    dwells = [Dwell(k, 100.0 * k + np.arange(50) / 10, own) for k, own in enumerate(rows)]
    dwells[1] = replace(dwells[1], time_s=np.array([100.0]), accel=np.array([[1000.0, 1001.0]]))
    mixed = reduced(sampled(*dwells, reading_u_mg=0.7, sensor="adis16354"))
    assert mixed.noise_known
    assert np.isinf(mixed.dof).tolist() == [False, True, False]
    np.testing.assert_allclose(mixed.own_covariance[1], 0.49 * np.eye(2))
    assert not mixed.slow[1].any(), "an average tells no time over which it would share 1/f noise"
    assert mixed.slow[[0, 2]].any(axis=(1, 2)).all()
    white = (rows[[0, 2]].var(axis=1, ddof=1)).mean(axis=0) / 50
    own = np.diagonal(mixed.own_covariance, axis1=1, axis2=2)[[0, 2]] - mixed.flicker[[0, 2]]
    # The dwells' own spectrum is used in part only: within a factor of 1.7 it is the textbook's variance.
    assert (np.abs(np.log(own / white)) < math.log(1.7)).all()
    unknown = reduced(sampled(*dwells))
    assert not unknown.noise_known
    np.testing.assert_allclose(unknown.own_covariance, np.tile(np.eye(2), (3, 1, 1)))
    assert (unknown.slow.size, unknown.flicker, unknown.quantization) == (0, None, None)
    assert unknown.notes[0].startswith("1 dwell of one sample without a stated noise")


def test_one_over_f_noise_of_dwells_is_that_of_their_times_axis_by_axis() -> None:
    begin, end = np.array([0.0, 5.0, 30.0, 41.0]), np.array([4.0, 9.0, 36.0, 44.0])
    allan = np.array([0.3, 0.0, 0.02])
    own, slow = flicker_parts(begin, end, allan)
    whole = np.einsum("iak,jbk->abij", slow, slow)
    for axis in range(3):
        whole[axis, axis] += np.diag(own[:, axis])
    expected = covariance_of_means(begin, end)
    for a in range(3):
        for b in range(3):
            np.testing.assert_allclose(whole[a, b], expected * allan[a] * (a == b), atol=1e-12)
    assert slow.any(axis=(0, 1)).all(), "no mode that moves nothing"


def test_dwells_that_are_too_many_or_but_one_have_the_scatter_of_their_means_each(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "MOST_SHARED", 4)
    begin = 10.0 * np.arange(5)
    allan = np.array([0.3, 0.1])
    own, slow = flicker_parts(begin, begin + 8, allan)
    assert not slow.size
    np.testing.assert_allclose(own, np.tile(allan * 5 * math.log(5) / (8 * math.log(2)), (5, 1)))
    assert flicker_parts(begin[:4], begin[:4] + 8, allan)[1].size
    assert flicker_parts(begin[:2], begin[:2] + 8, allan)[1].size
    one, none = flicker_parts(begin[:1], begin[:1] + 8, allan)
    assert not none.size
    np.testing.assert_allclose(one, allan[None])
    nothing, none = flicker_parts(begin[:4], begin[:4] + 8, np.zeros(2))
    assert not none.size
    assert not nothing.any()


def test_counts_have_no_figure_of_one_over_f_noise_and_a_known_sensor_has() -> None:
    rng = np.random.default_rng(8)
    angle = np.radians(QUARTERS)
    level = 1000 * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    dwells = [
        Dwell(k, 10.0 * k + np.arange(200) / 100, rng.normal(level[k], 4.0, (200, 2)), QUARTERS[k])
        for k in range(4)
    ]
    counts = reduced(sampled(*dwells, accel_unit="counts", sensor="adis16354"))
    assert not counts.slow.size
    assert not counts.flicker.any()
    sheet = reduced(sampled(*dwells, sensor="adis16354"))
    figure = VARIANTS["adis16354"].performance.bias_instability_mg ** 2
    found = (sheet.slow[:, 0] ** 2).sum(axis=1) + sheet.flicker[:, 0]
    length = 2.0
    begin = 10.0 * np.arange(4)
    expected = figure * np.diagonal(covariance_of_means(begin, begin + length))
    np.testing.assert_allclose(found, expected, rtol=0.01)
    assert not sheet.flicker_shown
    # A level that the session states replaces the figure, and gives one to a sensor without a data sheet.
    for sensor in ("adis16354", "generic"):
        stated = reduced(sampled(*dwells, sensor=sensor, bias_instability_mg=0.3))
        found = (stated.slow[:, 0] ** 2).sum(axis=1) + stated.flicker[:, 0]
        np.testing.assert_allclose(found, expected * 0.3**2 / figure, rtol=0.01)


def test_noise_that_still_rises_at_the_lowest_frequencies_is_remarked_on() -> None:
    rng = np.random.default_rng(120)
    box = np.ones(32) / 32
    weights = np.convolve(box, box)
    angle = np.radians(EIGHTHS)
    level = 1000 * np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    dwells = []
    for k in range(8):
        noise = [np.convolve(rng.normal(0, 5, 120 + 62), weights, "valid") for _ in range(2)]
        dwells.append(
            Dwell(k, 10.0 * k + np.arange(120) / 819.2, level[k] + np.stack(noise, 1), EIGHTHS[k])
        )
    assert [note for note in reduced(sampled(*dwells)).notes if "dwell longer" in note]
    long = [replace(d, accel=level[k] + rng.normal(0, 5, (120, 2))) for k, d in enumerate(dwells)]
    assert not reduced(sampled(*long)).notes


def test_words_of_a_quiet_converter_have_a_step_of_one_at_least() -> None:
    """Words that never change still come from a converter that rounds to whole ones."""
    lsb = VARIANTS["adis16354"].accel_mg_per_lsb
    rows = [np.tile([1500.0 + 7 * k, 900.0 - 11 * k], (40, 1)) for k in range(2)]
    dwells = [Dwell(k, 10.0 * k + np.arange(40) / 100, own) for k, own in enumerate(rows)]
    data = reduced(sampled(*dwells, accel_unit="lsb", sensor="adis16354"))
    np.testing.assert_allclose(data.quantization, lsb**2 / 12, rtol=1e-2)
    # In a unit in which nothing is known of the step the same dwells are averages without a noise.
    assert not reduced(sampled(*dwells)).noise_known


def test_a_step_is_the_axis_own_and_a_noise_of_a_step_leaves_nothing() -> None:
    # Of a uniform spread of one step nothing is noise: the whole of q²/12 is left.
    found = quantized_means(np.array([[4.0 / 12, 25.0 / 12]]), np.array([2.0, 5.0]))
    np.testing.assert_allclose(found, [[4.0 / 12, 25.0 / 12]], rtol=5e-3)
    assert quantized_means(np.array([[0.0]]), np.array([0.0])) == 0
    noisy = quantized_means(np.array([[9.0 + 0.75, 0.75]]), np.array([3.0, 3.0]))
    assert noisy[0, 0] < 1e-12
    assert noisy[0, 1] == pytest.approx(0.75, rel=5e-3)


# -- conditions ----------------------------------------------------------------------------------------


def conditions_of(session: Session) -> Conditions:
    return reduced(session).conditions


def test_conditions_are_means_of_each_dwell_counted_from_the_first_sample() -> None:
    rng = np.random.default_rng(5)
    dwells = []
    for k, angle in enumerate((0.0, 90.0, 200.0)):
        time = 50.0 + 20.0 * k + np.arange(6) / 2
        dwells.append(
            Dwell(
                k, time, rng.normal(1.0, 0.002, (6, 2)), angle,
                temperature_c=20 + k + np.arange(6.0), supply_v=5 + 0.1 * k + np.zeros(6),
            )
        )  # fmt: skip
    own = conditions_of(sampled(*dwells, accel_unit="g"))
    np.testing.assert_allclose(own.time_s, [1.25, 21.25, 41.25])
    np.testing.assert_allclose(own.temperature_c, [22.5, 23.5, 24.5])
    np.testing.assert_allclose(own.supply_v, [5.0, 5.1, 5.2])
    np.testing.assert_allclose(own.order, [0, 1, 2])
    np.testing.assert_allclose(own.angle_rad, np.radians([0, 90, 200]))
    np.testing.assert_allclose(own.previous_angle_rad, np.radians([0, 0, 90]))
    spread = [((d.accel * 1000 - (d.accel * 1000).mean(axis=0)) ** 2).mean(axis=0) for d in dwells]
    np.testing.assert_allclose(own.variance_mg2, spread)
    time, history = own.temperature_history
    np.testing.assert_allclose(time, np.concatenate([d.time_s for d in dwells]) - 50.0)
    np.testing.assert_allclose(history, np.concatenate([d.temperature_c for d in dwells]))
    broken = replace(dwells[1], supply_v=np.array([5.0, np.nan, 5.0, 5.0, 5.0, 5.0]))
    assert conditions_of(sampled(dwells[0], broken, dwells[2], accel_unit="g")).supply_v is None
    swapped = [dwells[1], dwells[0], dwells[2]]
    assert conditions_of(sampled(*swapped, accel_unit="g")).temperature_history is None
    free = replace(dwells[1], angle_deg=None)
    open_ = conditions_of(sampled(dwells[0], free, dwells[2], accel_unit="g"))
    assert open_.angle_rad is open_.previous_angle_rad is None


def test_a_long_history_of_temperature_is_kept_as_means_of_neighbours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "HISTORY_POINTS", 10)
    rng = np.random.default_rng(6)

    def history(samples: int) -> tuple[Floats, Floats, Floats]:
        dwells = [
            Dwell(
                k, 100.0 * k + np.arange(float(samples)), rng.normal(1000.0, 2.0, (samples, 2)),
                temperature_c=rng.normal(20.0, 1.0, samples),
            )
            for k in range(2)
        ]  # fmt: skip
        time, kept = conditions_of(sampled(*dwells)).temperature_history
        return time, kept, np.concatenate([d.temperature_c for d in dwells])

    time, kept, whole = history(15)
    np.testing.assert_allclose(kept, whole.reshape(10, 3).mean(axis=1))
    np.testing.assert_allclose(time, [1, 4, 7, 10, 13, 101, 104, 107, 110, 113])
    _, kept, whole = history(5)
    np.testing.assert_allclose(kept, whole)
    _, kept, whole = history(8)  # sixteen in ten: none is lost, none counts twice
    assert len(kept) == 10


# -- readings ------------------------------------------------------------------------------------------


def test_declared_angles_turn_the_other_way_and_the_others_carry_nothing() -> None:
    dwells = [replace(dwell, angle_deg=None if k == 1 else dwell.angle_deg) for k, dwell in
              enumerate(turn().dwells)]  # fmt: skip
    data = reduced(replace(turn(), dwells=tuple(dwells), fixture_sigma_deg=0.2))
    expected = -np.radians(EIGHTHS)
    expected[1] = 0.0
    np.testing.assert_allclose(data.turn_rad, expected)
    assert np.isinf(data.fixture).tolist() == [k == 1 for k in range(8)]
    np.testing.assert_allclose(np.delete(data.fixture, 1), math.radians(0.2))
    assert data.fixture_stated
    assert not data.free
    unstated = reduced(turn())
    assert not unstated.fixture_stated
    assert not unstated.fixture.any()


def test_rows_have_all_that_their_dwells_have() -> None:
    rng = np.random.default_rng(7)
    covariance = np.stack([np.diag(pair) for pair in rng.uniform(1, 2, (4, 2))])
    data = from_means(
        rng.normal(size=(4, 2)),
        covariance,
        Conditions(time_s=np.arange(4.0)),
        slow=rng.normal(size=(4, 2, 3)),
        quantization=rng.uniform(size=(4, 2)),
        flicker=rng.uniform(size=(4, 2)),
    )
    kept = data.rows(np.array([3, 1]))
    for name in ("mean", "own_covariance", "position", "slow", "quantization", "flicker"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(data, name)[[3, 1]])
    assert kept.conditions.time_s.tolist() == [3.0, 1.0]
    whole = covariance + np.stack([np.diag((own**2).sum(axis=1)) for own in data.slow])
    np.testing.assert_allclose(data.covariance, whole)
    np.testing.assert_allclose(data.root.transpose(0, 2, 1) @ data.root, np.linalg.inv(whole))
    np.testing.assert_allclose(data.own_root.transpose(0, 2, 1) @ data.own_root, np.linalg.inv(covariance))


def test_readings_are_reduced_once_a_session() -> None:
    session = turn()
    assert readings_of(session) is readings_of(session)
    assert readings_of(session).unit.scale == 1.0
    assert reduced(turn(1.0, accel_unit="g")).unit.scale == 1000.0
