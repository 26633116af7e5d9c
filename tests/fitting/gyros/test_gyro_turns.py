"""Turns between dwells: their integrals against the simulated truth, and what they are compared with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.gyros.gyro_fit import alignment, fit_gyro, rotation_and_skews_deg
from adis_gonio.fitting.gyros.gyro_readings import rate_intervals
from adis_gonio.fitting.gyros.turn_integration import Integral, Path, Sampling, integral_over, integrate
from adis_gonio.model.records import Dwell, Session, Turn
from adis_gonio.sim import World, WorldSettings
from fitting.gyros.simulated import PERIOD_S, Recorder, planar

QUIET = {
    "gyro_noise_dps": 0.0,
    "gyro_instability_dps": 0.0,
    "gyro_g_dps_per_g": 0.0,
    "gyro_bias_x_dps": 0.0,
    "gyro_bias_y_dps": 0.0,
    "gyro_bias_z_dps": 0.0,
}


def sampling(filter_m: int = 2, noise_dps: float = 1e-3, range_dps: float = 300.0) -> Sampling:
    return Sampling(PERIOD_S, filter_m, range_dps, noise_dps**2 * np.eye(3), np.full(3, 0.015))


def path_of(recorder: Recorder) -> Path:
    """The only turn with the edges of its dwells."""
    turn, (before, after) = recorder.turns[0], recorder.dwells
    joined = [
        np.concatenate([one[-1:], middle, other[:1]])
        for one, middle, other in (
            (before.time_s, turn.time_s, after.time_s),
            (before.gyro, turn.gyro, after.gyro),
            (before.accel, turn.accel, after.accel),
        )
    ]
    zero = np.array([dwell.gyro.mean(axis=0) for dwell in recorder.dwells])
    lay = 1e-3 * np.array([dwell.accel.mean(axis=0) for dwell in recorder.dwells])
    return Path(joined[0], joined[1], 1e-3 * joined[2], zero, lay)


def rows_of(path: Path, rows: np.ndarray) -> Path:
    """Some of the samples."""
    return replace(path, time_s=path.time_s[rows], rate_dps=path.rate_dps[rows], force_g=path.force_g[rows])


def quadrature(world: World, begin_s: float, end_s: float) -> Floats:
    """True angle (3,) in degrees by a plain sum of rates at steps of 50 µs; nothing of the package's."""
    edges = np.linspace(begin_s, end_s, round((end_s - begin_s) / 50e-6) + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    return world.stage.at(middles).rate_dps.sum(axis=0) * (edges[1] - edges[0])


@pytest.mark.parametrize("filter_m", [0, 2, 6])
def test_integral_is_that_of_the_true_rate(filter_m):
    recorder = planar(5, [0.0, 90.0], **QUIET)
    recorder = _again(recorder, filter_m)
    found = integrate(path_of(recorder), sampling(filter_m))
    assert isinstance(found, Integral)
    true = quadrature(recorder.world, found.begin_s, found.end_s)
    assert found.angle_deg == pytest.approx(true, abs=2e-3)  # rounding to an LSB of 0.073 °/s
    assert abs(true[2]) > 80


def _again(like: Recorder, filter_m: int) -> Recorder:
    world = World(like.world.settings, seed=like.world.seed)
    recorder = Recorder(world, filter_m)
    recorder.dwell(2.0, 0.0)
    recorder.turn(lambda at: world.stage.move_to(at, 90.0))
    recorder.dwell(2.0, 90.0)
    return recorder


def test_interval_is_earlier_than_the_samples_by_the_filter_and_no_other_delay_fits():
    filter_m = 4
    recorder = _again(planar(5, [0.0, 90.0], **QUIET), filter_m)
    path = path_of(recorder)
    turning = np.flatnonzero(np.abs(path.rate_dps[:, 2]) > 20.0)
    begin, end = int(turning[0]), int(turning[len(turning) // 2])
    found = integral_over(path, sampling(filter_m), begin, end)
    assert isinstance(found, Integral)
    assert path.time_s[begin] - found.begin_s == pytest.approx(15 * PERIOD_S)
    true = quadrature(recorder.world, found.begin_s, found.end_s)
    tolerance = 0.01  # the smearing of the ends, second order in the filter's length
    assert found.angle_deg[2] == pytest.approx(true[2], abs=tolerance)
    for wrong in (-2 * PERIOD_S, 2 * PERIOD_S, 15 * PERIOD_S):
        shifted = quadrature(recorder.world, found.begin_s + wrong, found.end_s + wrong)
        assert abs(found.angle_deg[2] - shifted[2]) > tolerance


def test_lost_scans_are_bridged_and_their_u_holds_what_they_cost():
    recorder = planar(6, [0.0, 90.0], gyro_instability_dps=0.0)
    path = path_of(recorder)
    whole = integrate(path, sampling(noise_dps=0.6))
    assert isinstance(whole, Integral)
    rng = np.random.default_rng(1)
    off, u = [], []
    turning = np.flatnonzero(np.abs(path.rate_dps[:, 2]) > 5.0)
    for _ in range(60):
        keep = np.ones(len(path.time_s), dtype=bool)
        for start in rng.choice(turning[:-150], 3, replace=False):
            keep[start : start + int(rng.integers(20, 120))] = False
        lossy = rows_of(path, keep)
        found = integrate(lossy, sampling(noise_dps=0.6))
        assert isinstance(found, Integral)
        assert found.samples == whole.samples - (~keep).sum()
        off.append(found.angle_deg[2] - whole.angle_deg[2])
        u.append(np.sqrt(found.covariance_deg2[2, 2] - whole.covariance_deg2[2, 2]))
    assert 0.5 < np.std(off) / np.mean(u) < 1.5
    assert np.std(off) > 0.01


def test_noise_of_a_part_at_rest_that_lost_scans_is_within_its_u():
    """Lost scans make no integral surer: its noise is of the whole time."""
    rng = np.random.default_rng(2)
    off = []
    for _ in range(300):
        kept = np.flatnonzero(np.r_[True, rng.random(298) > 0.3, True])
        rate = rng.standard_normal((len(kept), 3))
        path = Path(PERIOD_S * kept, rate, np.zeros((len(kept), 3)), np.zeros((2, 3)), np.zeros((2, 3)))
        found = integral_over(path, sampling(noise_dps=1.0), 0, len(kept) - 1)
        if isinstance(found, Integral):
            off.append(found.angle_deg / np.sqrt(np.diagonal(found.covariance_deg2)))
    assert len(off) > 250
    assert np.std(off) == pytest.approx(1.0, abs=0.07)


def test_a_gap_too_long_for_a_bridge_refuses_the_turn_and_says_so():
    path = path_of(planar(6, [0.0, 90.0]))
    middle = int(np.abs(path.rate_dps[:, 2]).argmax())
    keep = np.ones(len(path.time_s), dtype=bool)
    keep[middle : middle + 400] = False
    lossy = rows_of(path, keep)
    found = integrate(lossy, sampling(noise_dps=0.6))
    assert isinstance(found, str)
    assert "no samples for 0.49 s while it was turned" in found


def test_a_gap_at_rest_before_the_motion_only_shortens_the_interval():
    path = path_of(planar(6, [0.0, 90.0]))
    keep = np.ones(len(path.time_s), dtype=bool)
    keep[20:300] = False
    lossy = rows_of(path, keep)
    found, whole = integrate(lossy, sampling(noise_dps=0.6)), integrate(path, sampling(noise_dps=0.6))
    assert isinstance(found, Integral)
    assert isinstance(whole, Integral)
    assert found.bridged_deg2 == 0
    assert found.begin_s > whole.begin_s
    assert found.turned_deg[2] == pytest.approx(whole.turned_deg[2], abs=0.5)


def test_a_recording_that_begins_in_the_middle_of_the_turn_is_refused():
    path = path_of(planar(6, [0.0, 90.0]))
    late = int(np.abs(path.rate_dps[:, 2]).argmax())
    rows = np.r_[0:1, late : len(path.time_s)]
    cut = rows_of(path, rows)
    found = integrate(cut, sampling(noise_dps=0.6))
    assert isinstance(found, str)
    assert "no samples for" in found


def test_a_part_of_the_turn_that_was_not_recorded_shows_in_gravity():
    world = World(WorldSettings(), seed=4)
    recorder = Recorder(world)
    recorder.dwell(2.0, 0.0)
    recorder.now_s = world.stage.move_to(recorder.now_s, 30.0) + 1.0
    recorder.turn(lambda at: world.stage.move_to(at, 90.0), before_s=1.0)
    recorder.dwell(2.0, 90.0)
    assert integrate(path_of(recorder), sampling(noise_dps=0.6)) == ("a part of the turn was not recorded")


def test_a_turn_of_which_nothing_was_recorded_is_not_taken_for_rest():
    world = World(WorldSettings(), seed=4)
    recorder = Recorder(world)
    recorder.dwell(2.0, 0.0)
    recorder.turn(lambda at: at + 1.0)
    recorder.now_s = world.stage.move_to(recorder.now_s, 90.0) + 1.0
    recorder.dwell(2.0, 90.0)
    assert integrate(path_of(recorder), sampling(noise_dps=0.6)) == (
        "the part was turned while nothing was recorded"
    )


def test_a_turn_beyond_the_range_is_refused_with_its_rate():
    path = path_of(planar(6, [0.0, 90.0]))
    found = integrate(path, sampling(range_dps=50.0))
    assert isinstance(found, str)
    assert "beyond its range of ±50 °/s" in found
    assert "more slowly" in found


def test_a_part_that_lay_still_is_no_turn():
    recorder = planar(6, [0.0])
    recorder.turn(lambda at: at + 2.0)
    recorder.dwell(2.0, 0.0)
    assert rate_intervals(recorder.session()).refused == ("turn to dwell 1: the part was not turned",)


def test_long_rests_are_left_out_of_the_interval():
    world = World(WorldSettings(), seed=4)
    recorder = Recorder(world)
    recorder.dwell(2.0, 0.0)
    recorder.turn(lambda at: world.stage.move_to(at, 90.0), before_s=8.0, after_s=6.0)
    recorder.dwell(2.0, 90.0)
    found = integrate(path_of(recorder), sampling(noise_dps=0.6))
    assert isinstance(found, Integral)
    assert found.length_s < 2.0 + 2 * 1.2
    true = quadrature(world, recorder.dwells[0].time_s[-1], recorder.dwells[1].time_s[0])
    assert quadrature(world, found.begin_s, found.end_s) == pytest.approx(true, abs=1e-6)


# -- references ------------------------------------------------------------------------------------


def test_turns_of_a_planar_session_know_their_rotation_by_gravity_within_its_u():
    off = []
    for seed in range(3):
        recorder = planar(seed, [0, 90, 180, 270, 180, 90, 0], dwell_s=2.0)
        found = rate_intervals(recorder.session(fixture_sigma_deg=0.02))
        assert found.column("turn").sum() == 6
        assert (np.diff(found.column("begin_s")) > 0).all()
        for k in np.flatnonzero(found.column("turn")):
            true = quadrature(recorder.world, *_times(found, k)) / found.column("length_s")[k]
            off.append(
                (found.column("rotation_dps")[k] - true)[2]
                / np.sqrt(found.column("rotation_covariance_dps2")[k, 2, 2])
            )
            assert np.abs(true[:2]).max() < 1e-9
    assert 0.6 < np.std(off) < 1.4


def _times(found, k: int) -> tuple[float, float]:
    return found.column("begin_s")[k], found.column("end_s")[k]


def test_more_than_a_turn_is_counted_by_the_gyro():
    recorder = planar(2, [0, 90, 180, 270, 990, 0], dwell_s=2.0, gyro_scale_z=1.02)
    found = rate_intervals(recorder.session(fixture_sigma_deg=0.02))
    angle = (found.column("rotation_dps") * found.column("length_s")[:, None])[found.column("turn"), 2]
    assert angle == pytest.approx([90, 90, 90, 720, -990], abs=0.3)


def test_a_ninety_degree_turn_shows_the_gain_within_the_noise_of_its_rates():
    recorder = planar(3, [0, 90, 180, 270, 180, 90, 0], gyro_scale_z=1.01)
    found = rate_intervals(recorder.session(fixture_sigma_deg=0.02))
    turn, rest = found.column("turn"), ~found.column("turn")
    zero = found.column("mean_dps")[rest, 2].mean()
    gain = (found.column("mean_dps")[turn, 2] - zero) / found.column("rotation_dps")[turn, 2]
    assert gain.mean() == pytest.approx(1.01, abs=4 * gain.std(ddof=1) / np.sqrt(6))
    assert gain.std(ddof=1) < 0.003


def test_turns_in_space_see_the_angle_about_their_axis_only():
    world = World(WorldSettings(gyro_misalignment_zx_deg=1.0), seed=9)
    recorder = Recorder(world)
    for k, reads in enumerate(_SPHERE):
        if k:
            recorder.turn(lambda at, to=reads: world.stage.orient(at, np.array(to)))
        else:
            recorder.now_s = world.stage.orient(0.5, np.array(reads)) + 2.0
        recorder.dwell(2.0)
    found = rate_intervals(recorder.session(plane="none", fixture_sigma_deg=np.inf))
    assert found.column("turn").sum() >= 8, found.refused
    for k in np.flatnonzero(found.column("turn")):
        true = quadrature(world, *_times(found, k)) / found.column("length_s")[k]
        covariance = found.column("rotation_covariance_dps2")[k]
        off = found.column("rotation_dps")[k] - true
        assert off @ np.linalg.solve(covariance, off) < 25
        assert np.linalg.eigvalsh(covariance)[1] > 100 * np.linalg.eigvalsh(covariance)[0]


_SPHERE = [
    (0, 0, -1), (1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (1, 1, 0), (-1, 0, 1),
    (0, 1, -1), (1, -1, 1), (-1, 1, -1), (1, 1, 1),
]  # fmt: skip


def test_a_planar_sessions_turns_determine_the_gain_of_z_and_say_what_they_do_not():
    recorder = planar(3, [0, 90, 180, 270, 180, 90, 0], gyro_scale_z=1.01)
    result = fit_gyro(recorder.session(fixture_sigma_deg=0.02))
    gain = result["gyro_scale_z"]
    assert abs(gain.value - 1.01) < 3 * gain.u
    assert gain.u < 0.002
    assert {"gyro_scale_x", "gyro_scale_y", "gyro_misalignment_zx"} <= set(result.undetermined)
    assert "gyro_scale_x" not in result
    assert any("turn the part by whole turns about each axis" in line for line in result.warnings)
    assert result.triad is None


def test_the_triads_rotation_is_told_from_the_angles_between_its_axes():
    """Against a rotation made by scipy, and axes made lean by hand."""
    from scipy.spatial.transform import Rotation

    turned = np.array([0.3, -0.5, 0.8])
    square = Rotation.from_rotvec(turned, degrees=True).as_matrix().T
    lean = np.array([[0.0, 0.002, -0.001], [0.002, 0.0, 0.003], [-0.001, 0.003, 0.0]])
    rows = (np.eye(3) + lean) @ square
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    leans = np.degrees(np.arcsin(rows * (1 - np.eye(3))))
    found = rotation_and_skews_deg(leans)
    assert found[:3] == pytest.approx(turned, abs=2e-3)
    between = [90 - np.degrees(np.arccos(rows[i] @ rows[j])) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert found[3:] == pytest.approx(between, abs=1e-9)


def test_the_alignment_needs_all_six_misalignments_and_carries_their_covariance():
    names = [f"gyro_misalignment_{a}{b}" for a in "xyz" for b in "xyz" if a != b]
    values = {name: Value(0.0, 0.1, "deg") for name in names}
    found = alignment(values, 0.01 * np.eye(6))
    assert found is not None
    # A rotation is half the difference of two leans, a skew their sum.
    assert found["triad_rotation_z"].u == pytest.approx(0.1 / np.sqrt(2), rel=1e-3)
    assert found["gyro_skew_xy"].u == pytest.approx(0.1 * np.sqrt(2), rel=1e-3)
    del values[names[0]]
    assert alignment(values, 0.01 * np.eye(6)) is None


# -- sessions --------------------------------------------------------------------------------------


def test_a_recording_cut_by_stillness_has_the_turns_between_its_dwells_as_views():
    recorder = planar(1, [0, 90, 180], dwell_s=2.0)
    pieces = [
        recorder.dwells[0],
        recorder.turns[0],
        recorder.dwells[1],
        recorder.turns[1],
        recorder.dwells[2],
    ]
    whole = Dwell(
        0,
        np.concatenate([piece.time_s for piece in pieces]),
        np.concatenate([piece.accel for piece in pieces]),
        gyro=np.concatenate([piece.gyro for piece in pieces]),
    )
    session = Session(tuple(recorder.dwells), accel_unit="mg", recording=whole, cut_by_stillness=True)
    assert [(turn.before, turn.position) for turn in session.turns] == [(0, 1), (1, 2)]
    for turn, made in zip(session.turns, recorder.turns, strict=True):
        assert np.array_equal(turn.time_s, made.time_s)
        assert np.shares_memory(turn.gyro, whole.gyro)


def test_a_session_without_one_of_its_dwells_has_no_turn_to_it():
    session = planar(1, [0, 90, 180], dwell_s=1.0).session()
    assert len(session.turns) == 2
    assert replace(session, dwells=(session.dwells[0], session.dwells[2])).turns == ()


def test_dwells_alone_have_no_turns_and_a_free_turn_neither():
    dwell = Dwell(0, np.arange(4.0), np.ones((4, 2)))
    assert Session((dwell, replace(dwell, position=1))).turns == ()
    assert Session((), recording=dwell, free_turn=True).turns == ()


def test_a_session_without_gyros_says_what_is_missing():
    from adis_gonio.base.errors import DataError

    dwell = Dwell(0, np.arange(4.0), np.ones((4, 2)))
    with pytest.raises(DataError, match="no dwell holds samples of the gyros"):
        rate_intervals(Session((dwell,)))


def test_turn_repr_counts_samples():
    assert repr(Turn(0, 1, np.arange(3.0), np.ones((3, 3)))) == "Turn(0 to 1: 3 samples)"
