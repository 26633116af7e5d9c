"""The smoothed angle of an open sensor: calibration, other files, a broken link, the bench screen."""

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.calibrate import Calibration, Coefficient
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor import open_sensor
from adis_gonio.device.sensor.settings import Configuration
from adis_gonio.live.live_angle import (
    AngleMeter,
    LiveSource,
    calibration_for,
    live_angles,
    open_live,
    sensing_of,
)
from adis_gonio.record.blocks import ValueBlock
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from adis_gonio.tracing.trace_calibrations import load_calibration

RATE = Configuration(1, 2, 300, data_ready=True, linear_g=False, origin=False)
HIDDEN = "sim:?seed=9&delta_k=0.02&delta_phi_deg=1.5&bias_x_mg=30&bias_y_mg=-20&fixture_sigma_deg=0"
NAMES = ("ax", "ay", "az", "gx", "gy", "gz")


def calibrated(url: str, path) -> Calibration:
    settings = Settings(dwell_s=1.0, settle_s=0.1)
    with open_sensor(url) as sensor:
        runner = SessionRunner.begin(sensor, path, plan("mmpm"), settings, auto=True, fixture_sigma_deg=0.0)
        list(runner.run(so_far=False))
    return load_calibration(path)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory) -> Calibration:
    return calibrated(HIDDEN, tmp_path_factory.mktemp("cal") / "a.session")


def wrapped(angle_deg: float) -> float:
    return (angle_deg + 180) % 360 - 180


def turned(url: str, calibration: Calibration | None, to_deg: float, seconds: float = 12.0):
    """Readings of a part that rests, turns and rests, each with the stage's true angle at its time."""
    with open_sensor(url) as sensor:
        names = ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT", "XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT")
        meter = AngleMeter(sensor.configuration(), 2.0, 0.4672, calibration, part="adis16354", lag_s=0.25)
        bus, shown, begun = sensor.bus, [], False
        with sensor.stream(names, block_scans=82) as stream:
            first = None
            for block in stream:
                reading = meter.feed(block).smoothed
                end_s = float(block.time_s[-1])
                first = end_s if first is None else first
                if reading is not None:
                    at = bus.world.stage.at(np.array([end_s - reading.lag_s]))
                    shown.append((reading, math.degrees(float(at.angle_rad[0])), end_s - first))
                if end_s - first > 5 and not begun:
                    bus.stage.move_to(to_deg)
                    begun = True
                if end_s - first > seconds:
                    break
    return shown


@pytest.mark.parametrize("to_deg", [150.0, -200.0])
def test_the_stages_angle_is_shown_while_it_turns(calibration, to_deg):
    shown = turned(HIDDEN, calibration, to_deg)
    off = np.array([wrapped(reading.smoothed_deg - true) for reading, true, _ in shown])
    u = np.array([reading.smoothed_u_deg for reading, _, _ in shown])
    true = np.array([angle for _, angle, _ in shown])
    moves = np.abs(np.gradient(true)) > 0.5
    late = np.array([at for *_, at in shown]) > 3
    assert moves.sum() > 20
    assert np.abs(off / u)[late].max() < 4
    assert np.abs(off)[moves].max() < 0.5
    assert abs(true[-1] - to_deg) < 1e-6
    assert not any(reading.notes for reading, *_ in shown)


def test_u_grows_with_the_distance_from_the_temperature_of_the_calibration(calibration):
    widths = []
    for ambient_c in (22, 35):
        reading, true, _ = turned(f"{HIDDEN}&ambient_c={ambient_c}", calibration, 0.0, seconds=4.0)[-1]
        assert abs(wrapped(reading.smoothed_deg - true)) < 3 * reading.smoothed_u_deg
        widths.append(reading.smoothed_u_deg)
    by_calibration = calibration.stage_angle(
        calibration.readings_of([[1.0, 0.0]])[0], calibration.provenance.temperature_c.mean + 13
    )
    assert widths[1] > 0.9 * by_calibration.u_deg > 5 * widths[0]


def test_another_parts_calibration_is_said_and_widens_u(calibration, tmp_path):
    other = calibrated(
        "sim:?seed=10&bias_x_mg=-40&bias_y_mg=50&fixture_sigma_deg=0", tmp_path / "b.session"
    )
    own, wrong = (one_reading(one) for one in (calibration, other))
    assert own.notes == ()
    assert wrong.notes == ("calibration",)
    assert wrong.smoothed_u_deg > 10 * own.smoothed_u_deg
    assert abs(wrapped(wrong.smoothed_deg - own.smoothed_deg)) < 4 * wrong.smoothed_u_deg


@pytest.mark.parametrize(("constant_mg", "shaking_mg", "notes"), [(7, 0, ("calibration",)), (0, 8, ())])
def test_a_hand_that_begins_to_turn_the_part_is_no_other_part(calibration, constant_mg, shaking_mg, notes):
    meter = AngleMeter(RATE, 2.0, 0.4672, calibration, part="adis16354")
    time_s = np.arange(82 * 10) / 819.2
    accel = np.random.default_rng(3).normal(0, 2.0, (len(time_s), 3))
    accel[:, :2] += calibration.readings_of([[1.0, 0.0]])[0]
    accel[:, 0] += constant_mg + shaking_mg * np.sin(2 * np.pi * 3 * time_s)
    shown = [
        meter.feed(ValueBlock(("ax", "ay", "az"), accel[rows], time_s[rows]))
        for rows in (slice(k, k + 82) for k in range(0, len(time_s), 82))
    ]
    assert shown[-1].still
    assert {reading.notes for reading in shown if reading.still} == {notes}


def one_reading(calibration: Calibration):
    """What is shown of the sensor `HIDDEN` at rest."""
    with open_live(HIDDEN) as source:
        readings = live_angles(source, calibration, lag_s=0.1)
        return next(reading for reading in readings if reading.time_s > 2).smoothed


def test_a_link_that_breaks_ends_the_angles_with_its_error():
    def blocks():
        for k in range(10):
            time_s = np.arange(82 * k, 82 * (k + 1)) / 819.2
            yield ValueBlock(NAMES, np.tile([1000.0, 0, 0, 0, 0, 0], (82, 1)), time_s)
        raise BusTimeoutError("no answer")

    shown, seen = live_angles(LiveSource(RATE, blocks(), 2.0, 0.4672, "generic"), lag_s=0.1), []
    with pytest.raises(BusTimeoutError, match="no answer"):
        seen.extend(shown)
    assert [reading.angle_deg for reading in seen] == [0.0] * len(seen)


def test_the_slope_of_a_raw_angle_is_as_uncertain_as_the_biases_of_the_variant():
    slopes = [sensing_of(RATE, part, 2.0).bend for part in ("adis16354", "adis16350", "generic")]
    # Bias 10, 40 and 10 mg over gravity; gains of ±2 % and a Δφ of ±0.25° add 0.0066.
    assert slopes == pytest.approx([0.012, 0.0405, 0.012], rel=0.01)


def test_a_sensor_without_gyros_has_no_smoothed_angle():
    meter = AngleMeter(RATE, 2.0, 0.4672, lag_s=0.0)
    for k in range(50):
        time_s = np.arange(82 * k, 82 * (k + 1)) / 819.2
        reading = meter.feed(ValueBlock(("ax", "ay", "az"), np.full((82, 3), 500.0), time_s))
    assert reading.smoothed is None


# -- with the gyros calibrated ---------------------------------------------------------------------------

TURNED_ON = f"{HIDDEN}&gyro_bias_z_dps=1.2"


def with_gyros(calibration: Calibration, off_dps: float = 0.0) -> Calibration:
    """The calibration with the true errors of the gyros of `TURNED_ON`, and a zero rate that is off."""
    with open_sensor(TURNED_ON) as sensor:
        truth = sensor.bus.world.truth()
    estimates = {
        f"gyro_bias_{axis}": Coefficient("", truth[f"gyro_bias_{axis}"] + off_dps, 0.02, "dps")
        for axis in "xyz"
    }
    estimates |= {f"gyro_scale_{axis}": Coefficient("", 1.0, 1e-3, "1") for axis in "xyz"}
    estimates |= {
        f"g_sensitivity_{a}{b}": Coefficient("", truth[f"g_sensitivity_{a}{b}"], 0.002, "dps/g")
        for a in "xyz"
        for b in "xyz"
    }
    return replace(calibration, gyro=GyroCalibration.of(estimates, offsets_lsb=(0, 0, 0)))


def after_seconds(calibration: Calibration, offset_lsb: int = 0, seconds: float = 6.0):
    with open_sensor(TURNED_ON) as sensor:
        if offset_lsb:
            sensor.write("ZGYRO_OFF", offset_lsb)
        names = ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT", "XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT")
        now = (sensor.read("XGYRO_OFF"), sensor.read("YGYRO_OFF"), sensor.read("ZGYRO_OFF"))
        source = LiveSource(sensor.configuration(), None, 2.0, 0.4672, "adis16354", (0, 0, 0), now)
        now = calibration_for(calibration, source)
        meter = AngleMeter(source.measuring, 2.0, 0.4672, now, part=source.part, lag_s=0.1)
        with sensor.stream(names, block_scans=82) as stream:
            for _ in range(round(10 * seconds)):
                reading = meter.feed(next(stream))
        return reading.smoothed


def test_a_gyro_calibration_is_used_and_what_the_chip_corrects_is_not_corrected_again(
    calibration,
):
    plain = after_seconds(replace(calibration, gyro=None))
    known = after_seconds(with_gyros(calibration))
    assert plain.gyro_zero_dps == pytest.approx(1.2, abs=0.2)
    assert abs(known.gyro_zero_dps) < 4 * known.gyro_zero_u_dps
    assert known.gyro_zero_u_dps < plain.gyro_zero_u_dps
    moved = after_seconds(with_gyros(calibration), offset_lsb=-110)  # about -2 °/s
    assert abs(moved.gyro_zero_dps) < 4 * moved.gyro_zero_u_dps
    assert known.notes == moved.notes == ()


def test_another_parts_gyros_are_said_and_the_angle_is_right_all_the_same(calibration):
    own, wrong = (after_seconds(with_gyros(calibration, off)) for off in (0.0, 3.0))
    assert wrong.notes == ("gyro_calibration",)
    assert abs(wrong.smoothed_deg - own.smoothed_deg) < 2 * own.smoothed_u_deg
