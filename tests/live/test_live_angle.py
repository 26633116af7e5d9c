"""The live angle against what the simulation knows of itself."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import lfilter

from adis_gonio.base.arrays import wrap_degrees
from adis_gonio.base.errors import UsageError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.calibrate import Calibration
from adis_gonio.device.sensor import open_sensor
from adis_gonio.device.sensor.registers import ACCEL_OUT
from adis_gonio.device.sensor.settings import Configuration
from adis_gonio.faces.cli import main
from adis_gonio.live.live_angle import (
    AngleMeter,
    LiveAngle,
    LiveSource,
    calibration_for,
    corrected_angle,
    open_live,
    raw_angle_deg,
)
from adis_gonio.record.blocks import ValueBlock
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from adis_gonio.tracing.trace_calibrations import load_calibration

PERFECT = "delta_k=0&delta_phi_deg=0&bias_x_mg=0&bias_y_mg=0&fixture_sigma_deg=0"


@dataclass(frozen=True)
class Rate:
    sample_rate_hz: float
    settling_s: float = 0.0

    @property
    def sample_period_s(self) -> float:
        return 1 / self.sample_rate_hz

    def as_dict(self) -> dict[str, float]:
        return {}


def readings(meter: AngleMeter, accel_mg: np.ndarray, block: int = 5, lost: int = 0) -> list[LiveAngle]:
    told = []
    for start in range(0, len(accel_mg), block):
        rows = accel_mg[start : start + block]
        times = 0.01 * np.arange(start, start + len(rows))
        told.append(meter.feed(ValueBlock(("ax", "ay", "az"), rows, times, lost)))
    return [reading for reading in told if reading is not None]


def at_rest(angle_deg: float, count: int, noise_mg: float, rng: np.random.Generator) -> np.ndarray:
    psi = math.radians(-angle_deg)
    return 1000 * np.array([math.cos(psi), math.sin(psi), 0.0]) + noise_mg * rng.standard_normal((count, 3))


@pytest.mark.parametrize("angle_deg", [0.0, 37.5, 90.0, -90.0, 179.9, -133.0])
def test_the_raw_angle_of_a_perfect_sensor_is_the_stages(angle_deg):
    with open_sensor(f"sim:?seed=4&alpha_deg=0&noise_mg=0.1&{PERFECT}") as sensor:
        sensor.bus.stage.move_to(angle_deg)
        sensor.bus.sleep_s(30.0)
        meter = AngleMeter(sensor.configuration(), 2.0, 0.4672)
        with sensor.stream(ACCEL_OUT, block_scans=41) as stream:
            shown = [reading for _ in range(12) if (reading := meter.feed(next(stream))) is not None]
    assert len(shown) == 6
    for reading in shown:
        # An LSB of an axis is 0.027°, and so little noise does not average it away.
        assert wrap_degrees(reading.angle_deg - angle_deg) == pytest.approx(0, abs=0.03)
        assert reading.corrected_deg is None


def test_u_is_the_scatter_of_the_readings_behind_the_chips_filter():
    with open_sensor(f"sim:?seed=5&{PERFECT}") as sensor:
        sensor.configure(filter_m=4)
        meter = AngleMeter(sensor.configuration(), 2.0, 0.4672)
        with sensor.stream(ACCEL_OUT, block_scans=82) as stream:
            shown = [reading for _ in range(400) if (reading := meter.feed(next(stream))) is not None]
    del shown[0]  # a hand is supposed before there is enough to see
    # Of neighbours, so that the flicker of minutes stays out of it.
    scatter = np.diff([reading.angle_deg for reading in shown]).std() / math.sqrt(2)
    typical = math.sqrt(np.mean([reading.u_deg**2 for reading in shown]))
    assert typical == pytest.approx(scatter, rel=0.25)


def test_u_without_a_filter_is_the_standard_error():
    rng = np.random.default_rng(1)
    shown = readings(AngleMeter(Rate(100.0), 2.0, 0.0), at_rest(20.0, 4000, 2.0, rng), block=10)
    assert len(shown) == 400
    expected = math.degrees(2e-3 / math.sqrt(10))
    assert np.mean([reading.u_deg for reading in shown[1:]]) == pytest.approx(expected, rel=0.05)
    assert np.std([reading.angle_deg for reading in shown]) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("hz", [2.0, 5.0, 10.0])
def test_u_of_gravity_alone_is_the_scatter_of_the_angle_in_a_tremor(hz):
    rng = np.random.default_rng(2)
    accel = at_rest(20.0, 12_000, 1.0, rng)
    # A resonance of quality 5, driven by noise.
    decay = math.exp(-math.pi * hz * 0.01 / 5)
    poles = [1.0, -2 * decay * math.cos(2 * math.pi * hz * 0.01), decay**2]
    tremor = lfilter([1.0], poles, rng.standard_normal((len(accel), 2)), axis=0)
    accel[:, :2] += 6.0 * tremor / tremor.std()
    shown = readings(AngleMeter(Rate(100.0), 1.0, 0.0), accel, block=10)[1:]
    errors = np.array([(reading.angle_deg - 20.0) / reading.u_deg for reading in shown])
    assert math.sqrt((errors**2).mean()) == pytest.approx(1.0, abs=0.15)
    assert (abs(errors) < 1.96).mean() == pytest.approx(0.95, abs=0.03)


def test_a_knock_is_in_u_of_gravity_alone_while_it_is_in_the_mean():
    accel = at_rest(20.0, 400, 2.0, np.random.default_rng(4))
    accel[212, :2] += 300.0
    shown = readings(AngleMeter(Rate(100.0), 2.0, 0.0), accel, block=10)
    off = max(shown, key=lambda reading: abs(reading.angle_deg - 20.0))
    assert abs(off.angle_deg - 20.0) > 1.0
    assert off.u_deg > 0.5 * abs(off.angle_deg - 20.0)
    assert np.mean([reading.u_deg for reading in shown[25:]]) < 0.05


HIDDEN = "sim:?seed=9&delta_k=0.02&delta_phi_deg=1.5&bias_x_mg=30&bias_y_mg=-20&fixture_sigma_deg=0"


@pytest.fixture(scope="module")
def calibration(tmp_path_factory) -> Calibration:
    path = tmp_path_factory.mktemp("cal") / "a.session"
    settings = Settings(dwell_s=1.0, settle_s=0.1)
    with open_sensor(HIDDEN) as sensor:
        runner = SessionRunner.begin(sensor, path, plan("mmpm"), settings, auto=True, fixture_sigma_deg=0.0)
        list(runner.run(so_far=False))
    return load_calibration(path)


def live(
    calibration: Calibration | None, angle_deg: float, bias_lsb: int = 0, url: str = HIDDEN
) -> LiveAngle:
    """The mean reading of a few seconds at an angle of the simulated stage."""
    with open_sensor(url) as sensor:
        if bias_lsb:
            sensor.write("XACCL_OFF", bias_lsb)
        sensor.bus.stage.move_to(angle_deg)
        sensor.bus.sleep_s(5.0)
        offsets = tuple(sensor.read(name) for name in ("XACCL_OFF", "YACCL_OFF", "ZACCL_OFF"))
        if calibration is not None:
            source = LiveSource(sensor.configuration(), None, 2.0, 0.4672, "adis16354", offsets)
            calibration = calibration_for(calibration, source)
        meter = AngleMeter(sensor.configuration(), 2.0, 0.4672, calibration, every_s=4.0)
        with sensor.stream(("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT")) as stream:
            while (reading := meter.feed(next(stream))) is None:
                pass
    return reading


def test_u_of_a_corrected_angle_has_the_drift_since_the_calibration(calibration):
    rng = np.random.default_rng(2)
    blocks = at_rest(20.0, 400, 2.0, rng)
    parts = ("adis16354", "generic")
    meters = [AngleMeter(Rate(100.0), 2.0, 0.0, calibration, part=part, every_s=4.0) for part in parts]
    known, unknown = (readings(meter, blocks, block=10)[0] for meter in meters)
    octaves, floor_mg = 17, 0.1  # each octave has half of the square of the Allan floor
    drift_deg = math.degrees(1e-3 * floor_mg * math.sqrt(octaves / 2))
    assert known.u_deg == pytest.approx(math.hypot(unknown.u_deg, drift_deg), rel=1e-3)


@pytest.mark.parametrize("angle_deg", [37.5, 200.0, -75.0])
def test_a_calibration_gives_the_stages_angle_where_the_raw_one_is_off(calibration, angle_deg):
    reading = live(calibration, angle_deg)
    assert abs(wrap_degrees(reading.corrected_deg - angle_deg)) < 4 * reading.u_deg
    assert reading.u_deg < 0.1
    assert abs(wrap_degrees(reading.angle_deg - angle_deg)) > 5 * reading.u_deg
    assert live(None, angle_deg).u_deg < reading.u_deg, "the calibration adds its uncertainty"


def test_the_angle_by_a_calibration_from_poses_has_the_sense_of_the_raw_one(tmp_path):
    path = tmp_path / "poses.session"
    assert main(["simulate", "--plan", "poses", "--dwell", "1", "--seed", "4", "-o", str(path)]) == 0
    calibration = load_calibration(path)
    assert "alpha" not in calibration
    reading = at_rest(30.0, 1, 0.0, np.random.default_rng(0))[0]
    angle_deg, u_deg = corrected_angle(calibration, reading, None)
    assert raw_angle_deg(reading) == pytest.approx(30.0)
    assert angle_deg == pytest.approx(30.0, abs=3.0)
    assert 0 < u_deg < 1


def test_what_the_chip_corrects_by_now_is_not_corrected_again(calibration):
    plain, offset = live(calibration, 75.0), live(calibration, 75.0, bias_lsb=-64)
    assert abs(wrap_degrees(offset.angle_deg - plain.angle_deg)) > 0.5
    assert wrap_degrees(offset.corrected_deg - plain.corrected_deg) == pytest.approx(0, abs=0.02)


def test_another_parts_calibration_is_refused(calibration):
    with (
        open_live("sim:?seed=1&variant=adis16350", variant="adis16350") as source,
        pytest.raises(UsageError, match="of sensor adis16354, this is sensor adis16350"),
    ):
        calibration_for(calibration, source)


def test_gravity_across_the_plane_has_no_corrected_angle(calibration):
    rng = np.random.default_rng(9)
    flat = np.array([8.0, -5.0, 1000.0]) + 0.5 * rng.standard_normal((40, 3))
    shown = readings(AngleMeter(Rate(100.0), 2.0, 0.0, calibration), flat)
    assert all(reading.corrected_deg is None and reading.u_deg is None for reading in shown)


@pytest.mark.parametrize(("gain_z", "widened"), [(1.0, False), (1.02, False), (1.5, True)])
def test_u_of_a_tilted_plane_is_not_widened_by_a_usual_error_of_z(calibration, gain_z, widened):
    """A calibration in the plane has no Z: at a tilt of 30°, 2 % of it are 5 mg of the length, or 0.29°."""
    accel = at_rest(20.0, 400, 0.5, np.random.default_rng(6)) * np.cos(np.radians(30))
    accel[:, 2] += 1000 * gain_z * np.sin(np.radians(30))
    u_deg = readings(AngleMeter(Rate(100.0), 2.0, 0.0, calibration), accel)[-1].u_deg
    assert (u_deg > 0.29) is widened


def test_still_is_said_once_it_can_be_told_and_a_push_ends_it():
    rng = np.random.default_rng(3)
    accel = at_rest(20.0, 400, 2.0, rng)
    accel[200:230, 0] += 50 * np.sin(np.arange(30))
    shown = readings(AngleMeter(Rate(100.0), 2.0, 0.0), accel)
    assert [reading.still for reading in shown[:4]] == [None, None, None, True]
    moving = [reading.time_s for reading in shown if reading.still is False]
    assert moving
    assert min(moving) == pytest.approx(2.09)
    assert shown[-1].still


def test_noise_about_180_degrees_is_small():
    rng = np.random.default_rng(6)
    shown = readings(AngleMeter(Rate(100.0), 2.0, 0.0), at_rest(180.0, 400, 2.0, rng))
    assert max(reading.u_deg for reading in shown[1:]) < 0.1
    assert all(abs(abs(reading.angle_deg) - 180) < 0.2 for reading in shown)


def test_single_samples_have_the_u_of_a_sensor_held_in_the_hand():
    rng = np.random.default_rng(7)
    shown = readings(AngleMeter(Rate(0.5), 2.0, 0.0), at_rest(20.0, 3, 2.0, rng), block=1, lost=2)
    assert [reading.u_deg for reading in shown] == pytest.approx([math.degrees(20e-3)] * 3, rel=0.01)
    assert [reading.lost for reading in shown] == [2, 4, 6]


def test_blocks_without_a_sample_are_none():
    meter = AngleMeter(Rate(100.0), 2.0, 0.0)
    assert meter.feed(ValueBlock(("ax", "ay", "az"), np.empty((0, 3)), np.empty(0), 3)) is None
    rng = np.random.default_rng(8)
    (reading,) = readings(meter, at_rest(1.0, 10, 1.0, rng), block=10)
    assert reading.lost == 3


def test_the_sensors_settings_stay_as_they_are():
    with open_live("sim:?seed=1") as source:
        assert isinstance(source.measuring, Configuration)
        block = next(source.stream)
        assert block.registers[:3] == ACCEL_OUT
        assert len(block) == 41


def test_directions_of_the_axes():
    four = 1000.0 * np.array([[1, 0], [0, -1], [-1, 0], [0, 1]])
    assert raw_angle_deg(four) % 360 == pytest.approx([0, 90, 180, 270])
