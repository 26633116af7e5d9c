"""A register that changes inside the simulated chip changes its behaviour and what the driver reads."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.sim import SimBus, World, WorldSettings


def open_quiet() -> SimBus:
    """A simulated bus to a still part that turns at 20 °/s by its bias, without noise."""
    quiet = {
        "noise_mg": 0.0,
        "gyro_noise_dps": 0.0,
        "gyro_instability_dps": 0.0,
        "bias_instability_mg": 0.0,
    }
    quiet["gyro_instability_dps"] = 0.0
    return SimBus(World(WorldSettings(**quiet, gyro_bias_x_dps=20.0), seed=1))


def word(bus: SimBus, name: str) -> int:
    """Number in an output register a second later."""
    bus.sleep_s(1.0)
    frames = np.array([BY_NAME[name].address << 8, 0], np.uint16)
    return BY_NAME[name].number(int(bus.exchange(frames)[1]))


@pytest.mark.parametrize(
    ("name", "content", "output", "change"),
    [
        ("XACCL_OFF", 100, "XACCL_OUT", lambda before: before + 100),
        ("XGYRO_OFF", 400, "XGYRO_OUT", lambda before: before + 100),
        ("SENS_AVG", 0x0204, "XGYRO_OUT", lambda before: 2 * before),
        ("MSC_CTRL", 0x0100, "XACCL_OUT", lambda before: before + round(250 / 0.4672)),
    ],
)
def test_a_content_that_changes_without_a_frame_acts_on_the_outputs(name, content, output, change):
    bus = open_quiet()
    before = word(bus, output)
    bus.chip.memory[name] = content
    assert word(bus, output) == pytest.approx(change(before), abs=1)


def test_a_period_that_changes_without_a_frame_acts_at_once():
    bus = open_quiet()
    bus.sleep_s(1.0)
    bus.chip.memory["SMPL_PRD"] = 0x03
    assert bus.chip.update_period_s == pytest.approx(4 / 1638.4)
    next_s = bus.chip.next_update_s(bus.now_s())
    assert next_s - bus.now_s() <= 4 / 1638.4


def test_the_driver_scales_by_the_range_that_the_chip_has_now():
    with Adis16354(open_quiet()) as sensor:
        before = sensor.scan(["XGYRO_OUT"])["XGYRO_OUT"]
        sensor.bus.chip.memory["SENS_AVG"] = 0x0104
        sensor.bus.sleep_s(1.0)
        assert before == pytest.approx(20.0, abs=0.1)
        assert sensor.scan(["XGYRO_OUT"])["XGYRO_OUT"] == pytest.approx(20.0, abs=0.1)
