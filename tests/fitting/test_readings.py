import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import DataError, FitError
from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation.readings import readings_of, reduced
from adis_gonio.fitting.estimation.spectrum import covariance_of_means, noise_of_means
from adis_gonio.model.records import Dwell, Session

LSB = 0.4672


def filtered(rng, n, filter_m, sd=4.7):
    """Noise (n,) through the chip's Bartlett filter, and the variance of its mean."""
    box = np.full(2**filter_m, 0.5**filter_m)
    weights = np.convolve(box, box)
    noise = np.convolve(rng.normal(0, sd, n + len(weights) - 1), weights, "valid")
    correlation = np.correlate(weights, weights, "full")
    lag = np.abs(np.arange(len(correlation)) - len(weights) + 1)
    return noise, sd**2 * float(correlation @ (n - lag)) / n**2


def dwell(rows, k=0, **more):
    rows = np.asarray(rows, dtype=float)
    return Dwell(position=k, time_s=k * 100 + np.arange(len(rows)) / 819.2, accel=rows, **more)


def session(*dwells, **more):
    return Session(dwells=dwells, **{"accel_unit": "mg", "sensor": "generic", **more})


@pytest.mark.parametrize(("filter_m", "n"), [(0, 300), (1, 600), (2, 600), (3, 1200), (4, 1200), (6, 4000)])
def test_the_variance_of_a_mean_is_that_of_correlated_samples(filter_m, n):
    rng = np.random.default_rng(filter_m)
    ratio, dof = [], []
    for _ in range(60):
        pair = [filtered(rng, n, filter_m) for _ in range(8)]
        rows = [np.stack([pair[2 * k][0], pair[2 * k + 1][0]], axis=1) for k in range(4)]
        noise = noise_of_means(rows)
        ratio.append(noise.covariance[0, 0, 0] / pair[0][1])
        dof.append(noise.dof[0])
    # One standard error of the mean ratio is sqrt(2/dof/60).
    assert np.mean(ratio) == pytest.approx(1, abs=0.05 + 3 * math.sqrt(2 / np.median(dof) / 60))
    # The stated degrees of freedom are those of the scatter seen, within a factor of two and a half.
    seen = 2 / np.var(ratio)
    assert 0.4 < np.median(dof) / seen < 2.5


def test_sigma_over_root_n_would_be_wrong_by_the_filter():
    rng = np.random.default_rng(1)
    noise, true = filtered(rng, 8000, 5)
    naive = noise.var() / 8000
    mine = noise_of_means([np.stack([noise, noise[::-1]], axis=1)]).covariance[0, 0, 0]
    assert true / naive > 30
    assert 0.4 < mine / true < 2.5


def test_white_noise_keeps_its_degrees_of_freedom():
    rng = np.random.default_rng(2)
    dof = [noise_of_means([rng.normal(size=(50, 2)) for _ in range(6)]).dof[0] for _ in range(40)]
    assert np.median(dof) == pytest.approx(6 * 49, rel=0.02)


def test_dwells_of_one_noise_are_pooled_and_others_keep_their_own():
    rng = np.random.default_rng(3)
    same = noise_of_means([rng.normal(0, 2, (100, 2)) for _ in range(5)])
    assert same.pooled
    np.testing.assert_allclose(same.covariance[0], same.covariance[4])
    rows = [rng.normal(0, 2, (100, 2)) for _ in range(4)] + [rng.normal(0, 9, (100, 2))]
    mixed = noise_of_means(rows)
    assert not mixed.pooled
    assert mixed.covariance[4, 0, 0] / mixed.covariance[0, 0, 0] > 8
    assert mixed.dof[0] < 120


def test_correlation_between_axes_is_kept_where_it_is_real():
    rng = np.random.default_rng(4)
    common = [rng.normal(size=(400, 1)) for _ in range(4)]
    rows = [c + 0.5 * rng.normal(size=(400, 2)) for c in common]
    covariance = noise_of_means(rows).covariance[0]
    assert covariance[0, 1] / covariance[0, 0] == pytest.approx(0.8, abs=0.06)
    assert noise_of_means([rng.normal(size=(400, 2)) for _ in range(4)]).covariance[0, 0, 1] == 0


def test_flicker_in_long_dwells_is_seen_and_bounded_where_absent():
    rng = np.random.default_rng(5)
    n, allan, white = 32768, 0.5, 4.0
    frequency = np.arange(1, n // 2 + 1) / n

    def flicker():
        lines = np.zeros(n // 2 + 1, dtype=complex)
        amplitude = np.sqrt(allan**2 / (4 * math.log(2)) / frequency * n / 2)
        lines[1:] = amplitude * (rng.normal(size=n // 2) + 1j * rng.normal(size=n // 2))
        return np.fft.irfft(lines, n)

    with_it = noise_of_means(
        [rng.normal(0, white, (n, 2)) + np.stack([flicker(), flicker()], 1) for _ in range(4)]
    )
    total = with_it.covariance[0, 0, 0] + with_it.flicker[0]
    assert 0.3 < total / allan**2 < 4
    without = noise_of_means([rng.normal(0, white, (n, 2)) for _ in range(4)])
    assert (without.flicker == 0).all()
    assert (np.sqrt(without.flicker_limit) < 0.1).all()


def one_over_f(rng, n, allan):
    """Noise (n,) with this Allan deviation at every time: part of a longer series, so not periodic."""
    long = 4 * n
    frequency = np.arange(1, long // 2 + 1) / long
    lines = np.zeros(long // 2 + 1, dtype=complex)
    amplitude = np.sqrt(allan**2 / (4 * math.log(2)) / frequency * long / 2)
    lines[1:] = amplitude * (rng.normal(size=long // 2) + 1j * rng.normal(size=long // 2))
    return np.fft.irfft(lines, long)[:n]


@pytest.mark.parametrize("n", [100, 256])
def test_flicker_without_white_noise_is_not_taken_for_noise_that_averaging_lowers(n):
    rng = np.random.default_rng(n)
    found = [
        noise_of_means([np.stack([one_over_f(rng, n, 0.5) for _ in range(2)], axis=1) for _ in range(12)])
        for _ in range(12)
    ]
    shown = np.array([noise.flicker for noise in found]) / 0.5**2
    # The three lowest ordinates of twelve dwells: each figure scatters by 1/6, their mean by 1/30.
    # What is slower than a dwell leaks into them and adds a tenth or two.
    assert 0.85 < shown.mean() < 1.35
    assert shown.min() > 0.4
    assert all((noise.flicker_limit >= noise.flicker).all() for noise in found)


@pytest.mark.parametrize(("n", "white"), [(100, 0.0), (256, 0.0), (4096, 1.0)])
def test_dwells_that_are_shaken_do_not_raise_the_flicker_that_the_quiet_ones_show(n, white):
    rng = np.random.default_rng(n)

    def shown(loudness):
        rows = [np.stack([one_over_f(rng, n, 0.5) for _ in range(2)], axis=1) for _ in range(12)]
        shaken = [loudness if k % 2 else white for k in range(12)]
        return noise_of_means([r + rng.normal(0, s, r.shape) for r, s in zip(rows, shaken, strict=True)])

    found = np.array([shown(60.0).flicker for _ in range(12)])
    # Two hundred times as loud as the flicker: their own means scatter by 2 to 12 times its size.
    assert 0.6 < np.median(found) / 0.5**2 < 1.6
    assert found.max() / 0.5**2 < 3


@pytest.mark.parametrize(
    ("filter_m", "n", "too_short"),
    [(0, 100, False), (3, 1200, False), (6, 4000, False), (4, 64, True), (5, 120, True), (6, 300, True)],
)
def test_a_filter_is_no_flicker_and_dwells_of_few_of_its_windows_say_that_they_are_too_short(
    filter_m, n, too_short
):
    rng = np.random.default_rng(n)
    for _ in range(8):
        rows = [np.stack([filtered(rng, n, filter_m)[0] for _ in range(2)], axis=1) for _ in range(12)]
        noise = noise_of_means(rows)
        assert (noise.flicker == 0).all()
        assert noise.too_short == too_short


def test_the_figure_of_the_variant_is_the_floor_unless_the_dwells_exclude_it():
    rng = np.random.default_rng(6)

    def u(sensor, n):
        dwells = [dwell(rng.normal(0, 4.7, (n, 2)), k) for k in range(2)]
        return math.sqrt(reduced(session(*dwells, sensor=sensor)).covariance[0, 0, 0])

    n = 2000
    white = 4.7 / math.sqrt(n)
    # Two dwells 100 s apart share 1/f noise in part; a reading has the rest, and what is slower.
    length = n / 819.2
    begin = np.array([0.0, 100.0])
    floor = 0.1 * math.sqrt(covariance_of_means(begin, begin + length)[0, 0])
    assert u("generic", n) == pytest.approx(white, rel=0.1)
    assert u("adis16354", n) == pytest.approx(math.hypot(white, floor), rel=0.1)
    # A minute and a half of white noise to 0.02 mg: 0.1 mg of flicker would have shown.
    assert u("adis16354", 80000) < 0.08


@pytest.mark.parametrize("noise_lsb", [0.0, 0.15, 0.3, 1.0])
def test_quantization_of_a_quiet_sensor_is_in_the_uncertainty(noise_lsb):
    rng = np.random.default_rng(7)
    n, squares, stated = 64, [], []
    for _ in range(300):
        level = rng.uniform(100, 2000, (2, 2))
        rows = np.round(level[:, None, :] + rng.normal(0, noise_lsb, (2, n, 2)))
        quiet = session(dwell(rows[0], 0), dwell(rows[1], 1), accel_unit="lsb", sensor="adis16354")
        readings = reduced(quiet)
        squares.append(np.mean((readings.mean / LSB - level) ** 2))
        stated.append(readings.covariance[:, 0, 0].mean() / LSB**2)
    floor = np.mean(stated) - np.mean(squares)
    # At 1 LSB the floor of 0.1 mg may come on top; below, nothing else hides the step of the converter.
    begin = np.array([0.0, 100.0])
    shared = covariance_of_means(begin, begin + n / 819.2)[0, 0]
    most = (0.1 / LSB) ** 2 * shared * (noise_lsb > 0)
    assert -0.2 * np.mean(squares) < floor < 0.35 * np.mean(squares) + most


def test_units_become_mg():
    rows = np.array([[1.0, 0.0], [1.0, 2.0]])
    factor = {"mg": 1.0, "g": 1000.0, "mps2": 1000 / 9.80665, "lsb": 0.4672}
    for unit, value in factor.items():
        readings = reduced(session(dwell(rows), accel_unit=unit, sensor="adis16354"))
        np.testing.assert_allclose(readings.mean, [[value, value]])
        assert readings.unit.known
    assert reduced(session(dwell(rows), accel_unit="lsb", sensor="adis16350")).mean[0, 0] == pytest.approx(
        2.522
    )


def test_readings_of_one_row_have_the_stated_uncertainty_or_none():
    stated = reduced(session(dwell([[1.0, 2.0]]), reading_u_mg=0.3))
    np.testing.assert_allclose(stated.covariance[0], 0.09 * np.eye(2))
    assert np.isinf(stated.dof[0])
    assert stated.noise_known
    assert not reduced(session(dwell([[1.0, 2.0]]))).noise_known


def test_loads_stand_from_the_first_to_the_last_sample_of_each_dwell():
    measured = session(
        dwell([[998.0, 0.0], [1002.0, 2.0]]),
        dwell([[0.0, 990.0]], 1, angle_deg=90.0),
        dwell([[-1001.0, 5.0], [-999.0, 5.0]], 2),
        reading_u_mg=1.0,
    )
    times, loads = reduced(measured).conditions.load_history
    assert times == pytest.approx([0, 1 / 819.2, 100, 200, 200 + 1 / 819.2])
    np.testing.assert_allclose(loads, [[1000, 1], [1000, 1], [0, 990], [-1000, 5], [-1000, 5]])
    back = session(dwell([[1000.0, 0.0]], 1), dwell([[0.0, 990.0]], 0), reading_u_mg=1.0)
    assert reduced(back).conditions.load_history is None, "times that run back tell no history"


def test_times_of_dwells_that_overlap_tell_no_history():
    rows = [[998.0, 0.0], [1002.0, 2.0]]
    first = Dwell(0, np.array([0.0, 1.0]), np.array(rows))
    later = Dwell(1, np.array([1.5, 2.5]), np.array(rows[::-1]))
    assert reduced(session(first, later)).conditions.load_history is not None
    within = replace(later, time_s=np.array([0.5, 1.5]))
    assert reduced(session(first, within)).conditions.load_history is None


def test_what_was_not_measured_or_has_no_unit_is_no_condition():
    rng = np.random.default_rng(3)
    rows = [rng.normal((100.0 * k, 900.0), 2.0 + k, (300, 2)) for k in range(6)]
    many = reduced(session(*(dwell(own, k) for k, own in enumerate(rows)))).conditions
    spread = [[np.sum((axis - np.sum(axis) / 300) ** 2) / 300 for axis in own.T] for own in rows]
    np.testing.assert_allclose(many.variance_mg2, spread)
    assert many.approach is many.temperature_c is many.supply_v is many.angle_rad is None
    single = session(*(dwell(own[:1], k) for k, own in enumerate(rows)), reading_u_mg=0.1)
    assert reduced(single).conditions.variance_mg2 is None, "one sample has no variance"
    angles = np.radians(60.0 * np.arange(6))
    turn = 500 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + 2000
    counts = [dwell(rng.normal(own, 2.0, (300, 2)), k) for k, own in enumerate(turn)]
    assert reduced(session(*counts, accel_unit="counts")).conditions.variance_mg2 is None, "in no unit"
    told = [dwell(own, k, approach=(-1) ** k) for k, own in enumerate(rows)]
    assert reduced(session(*told)).conditions.approach.tolist() == [1, -1, 1, -1, 1, -1]
    some = [*told[:5], dwell(rows[5], 5, temperature_c=np.full(300, 21.0))]
    assert reduced(session(*some)).conditions.temperature_c is None, "recorded in one dwell only"


def test_check_dwells_are_left_out():
    readings = reduced(session(dwell([[1.0, 2.0]], 0), dwell([[5.0, 6.0]], 1, use="check"), reading_u_mg=1))
    assert readings.training.position.tolist() == [0]
    assert readings.checking.position.tolist() == [1]
    with pytest.raises(FitError, match="none to fit"):
        assert reduced(session(dwell([[5.0, 6.0]], 1, use="check"))).training
    with pytest.raises(DataError, match="no dwell to fit; every dwell is empty"):
        reduced(session())
    with pytest.raises(DataError, match="a free turn has no positions; use fit"):
        reduced(session(free_turn=True))


def test_third_axis_is_left_out_in_the_plane_and_needed_in_space():
    assert reduced(session(dwell([[1.0, 2.0, 3.0]]))).mean.shape == (1, 2)
    assert reduced(session(dwell([[1.0, 2.0, 3.0]]), plane="none")).mean.shape == (1, 3)
    with pytest.raises(DataError, match="three axes"):
        reduced(session(dwell([[1.0, 2.0]]), plane="none"))


class TestDeadData:
    rng = np.random.default_rng(8)

    def words(self, n=300, level=(2000, 100)):
        return np.round(self.rng.normal(level, 10, (n, 2)))

    def refused(self, *dwells, **more):
        with pytest.raises(DataError) as caught:
            reduced(session(*dwells, **{"accel_unit": "lsb", "sensor": "adis16354", **more}))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def test_all_zero_names_the_position(self):
        assert "all-zero accelerations in position 4" in self.refused(
            dwell(self.words(), 3), dwell(np.zeros((300, 2)), 4)
        )

    def test_one_axis_that_stands_while_others_move_is_stuck(self):
        rows = self.words()
        rows[:, 1] = rows[0, 1]
        assert "stuck data in position 7" in self.refused(dwell(self.words(), 6), dwell(rows, 7))
        assert "stuck" in self.refused(dwell(self.words(), 6), dwell(rows, 7), accel_unit="mg")

    def test_one_dwell_that_stands_at_the_largest_word_of_an_axis_is_stuck_and_at_no_limit(self):
        rows = self.words()
        rows[:, 1] = 400.0  # a reading of 1.0 g, as gravity allows
        assert "stuck data in position 7" in self.refused(dwell(self.words(), 6), dwell(rows, 7))

    def test_the_second_half_of_a_dwell_can_be_stuck(self):
        rows = self.words()
        rows[120:] = rows[120]
        assert "stuck data in position 2" in self.refused(dwell(self.words(), 1), dwell(rows, 2))

    def test_the_same_words_in_different_positions_are_stuck(self):
        same = np.tile([2000.0, 100.0], (40, 1))
        dwells = [dwell(same, k, angle_deg=90.0 * k) for k in range(2)]
        assert "stuck data in positions 0, 1" in self.refused(*dwells, accel_unit="mg")
        loose = [dwell(same, k) for k in range(3)]
        assert "stuck" in self.refused(*loose, accel_unit="mg")

    def test_a_chip_that_shows_no_noise_in_any_dwell_is_stuck(self):
        frozen = [dwell(np.tile([2000.0 - k, 100.0 + 9 * k], (400, 1)), k) for k in range(3)]
        assert "stuck data in positions 0, 1, 2" in self.refused(*frozen)

    def test_a_quiet_converter_of_an_unknown_sensor_may_repeat_its_word(self):
        frozen = [dwell(np.tile([2000.0 - k, 100.0 + 9 * k], (400, 1)), k) for k in range(3)]
        readings = reduced(session(*frozen, accel_unit="mg"))
        assert (np.diagonal(readings.covariance, axis1=1, axis2=2) > 0).all()

    def test_the_longest_filter_is_not_taken_for_stuck(self):
        rng = np.random.default_rng(9)
        for _ in range(20):
            dwells = []
            for k in range(3):
                rows = np.stack([filtered(rng, 700, 6)[0] for _ in range(2)], axis=1)
                dwells.append(dwell(np.round((rows + np.array([900, 50 * k])) / LSB), k))
            reduced(session(*dwells, accel_unit="lsb", sensor="adis16354"))


def test_few_degrees_of_freedom_enlarge_the_interval_to_its_coverage():
    rng = np.random.default_rng(10)
    covered = []
    for _ in range(400):
        rows = [rng.normal(level, 1.0, (2, 2)) for level in ((940, 342), (342, -940))]
        dwells = [dwell(r, k, angle_deg=90.0 * k) for k, r in enumerate(rows)]
        delta_k = fit(session(*dwells, fixture_sigma_deg=0.0), "two-position")["delta_k"]
        covered.append((abs(delta_k.value) < 1.96 * delta_k.u, abs(delta_k.value) < delta_k.U))
    # Two degrees of freedom an axis: u alone is no interval; U with Student's quantile is.
    normal, student = np.mean(covered, axis=0)
    assert normal < 0.91
    assert student > 0.93


def few_poses(poses, rows, **facts):
    dwells = tuple(
        Dwell(k, np.arange(rows) + 10.0 * k, np.tile(1000.0 * np.array(pose), (rows, 1)))
        for k, pose in enumerate(poses)
    )
    return Session(dwells, sensor="generic", accel_unit="mg", plane="none", **facts)


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_a_few_averaged_poses_in_space_are_refused_in_one_line_or_have_no_u(count, rows):
    poses = [(0, 0, -1.0), (1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (-1.0, 0, 0)][:count]
    try:
        result = fit(few_poses(poses, rows))
    except FitError as refused:
        assert "\n" not in str(refused)  # noqa: PT017 (it may be answered too)
    else:
        assert all(one.u is None for one in result.parameters.values())
        assert result.undetermined


def test_an_average_that_is_written_down_twice_shows_no_noise():
    poses = [(0, 0, -1.0), (0, 0, 1.0), (1.0, 0, 0), (-1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (0.6, 0.8, 0)]
    assert not readings_of(few_poses(poses, 2)).noise_known
    assert readings_of(few_poses(poses, 2, reading_u_mg=1.0)).noise_known


@pytest.mark.parametrize(("unit", "per_mg"), [("g", 1e-3), ("counts", 4.1)])
def test_an_average_in_any_unit_but_words_shows_no_noise(unit, per_mg):
    session = few_poses([(0, 0, 1.0), (1.0, 0, 0), (0, 1.0, 0), (0.6, 0.8, 0)], 2)
    dwells = tuple(replace(dwell, accel=per_mg * dwell.accel) for dwell in session.dwells)
    assert not readings_of(replace(session, dwells=dwells, accel_unit=unit)).noise_known


@pytest.mark.parametrize(("dwells", "samples"), [(24, 2), (9, 2), (24, 3)])
def test_noise_that_short_dwells_share_has_the_degrees_of_freedom_of_them_all_once(dwells, samples):
    rng = np.random.default_rng(1)
    turn = [np.radians(20 - k * 360 / dwells) for k in range(dwells)]
    made = tuple(
        Dwell(
            k,
            10.0 * k + np.arange(float(samples)),
            1000 * np.array([np.cos(a), np.sin(a)]) + rng.normal(0, 1, (samples, 2)),
            float(20 - np.degrees(a)),
        )
        for k, a in enumerate(turn)
    )
    data = readings_of(Session(made, accel_unit="mg", sensor="generic", fixture_sigma_deg=0.01))
    assert data.pooled
    assert data.noise_dof == dwells * (samples - 1)


def test_dwells_with_noise_of_their_own_add_up_their_degrees_of_freedom():
    rng = np.random.default_rng(2)
    made = tuple(
        Dwell(
            k,
            10.0 * k + np.arange(400.0) / 100,
            1000 * np.array([np.cos(a), np.sin(a)]) + rng.normal(0, (1, 6)[k % 2], (400, 2)),
            float(-np.degrees(a)),
        )
        for k, a in enumerate(-np.radians([0, 90, 180, 270]))
    )
    data = readings_of(Session(made, accel_unit="mg", sensor="generic", fixture_sigma_deg=0.01))
    assert not data.pooled
    assert data.noise_dof == 4 * 399


def test_counts_that_show_no_scale_are_refused_with_the_name_of_the_file():
    counts = [dwell([row], k, angle_deg=90.0 * k) for k, row in enumerate([(100, 200), (200, 100)])]
    with pytest.raises(FitError, match=r"^counts\.csv: 2 positions cannot show an unknown scale"):
        fit(session(*counts, accel_unit="counts", source="counts.csv"))


def test_samples_without_noise_have_a_repeatability_of_nothing():
    rng = np.random.default_rng(32)
    for _ in range(8):
        alpha = rng.uniform(0, 2 * math.pi)
        held = [
            Dwell(
                position=k,
                time_s=12.0 * k + 0.02 * np.arange(200),
                accel=np.round(np.tile([math.cos(angle), math.sin(angle)], (200, 1)) * 1000 / 2.522),
                angle_deg=30.0 * k,
            )
            for k, angle in enumerate(alpha - np.radians(30.0 * np.arange(12)))
        ]
        # A NumPy warning would be an error here.
        result = fit(Session(held, sensor="adis16350", accel_unit="lsb", fixture_sigma_deg=0.02))
        (noise,) = [
            row for row in result.as_dict()["budget"]["delta_k"] if row["source"] == "repeatability"
        ]
        assert noise["u"] < 1e-6
