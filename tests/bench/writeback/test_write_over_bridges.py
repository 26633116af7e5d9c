"""The write-back over every bridge's fake, as a real sensor: the bus brings neither a stage nor a world."""

import pytest

from adis_gonio.bench.runner import SessionRunner
from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
from adis_gonio.device.sensor import Adis16354
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from adis_gonio.sim.chip import State
from bench.writeback.rig import flash, new_bus, numbers
from device.bus.test_bridges_with_driver import BRIDGES
from fakes.benches import open_bridge


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """A session of the part behind the bridges that does not know it to be simulated."""
    path = tmp_path_factory.mktemp("real") / "part.session"
    bus = new_bus(4)
    sensor, bus.world = Adis16354(bus), None
    runner = SessionRunner.begin(
        sensor, path, plan("four-position"), Settings(dwell_s=1.0, settle_s=0.1), auto=True
    )
    for _ in runner.run(so_far=False):
        pass
    return path


@pytest.mark.parametrize("kind", BRIDGES)
def test_write_save_and_undo(kind, real, tmp_path):
    path = tmp_path / "part.session"
    path.write_bytes(real.read_bytes())
    bus, chip = open_bridge(kind)
    bus.chip = chip
    with Adis16354(bus) as sensor:
        made = OffsetWriter(sensor, path, WriteSettings(dwell_s=0.5, save=True, angle_deg=0.0))
        new = tuple(made.plan().new.values())
        outcome = made.write()
        assert outcome.standing.text == "the sensor holds the new offsets, saved to flash"
        assert numbers(bus)[:2] == flash(bus)[:2] == new
        assert any(new)
        OffsetWriter(sensor, path).undo()
    assert numbers(bus) == flash(bus) == (0, 0, 0)
    assert chip.memory["ENDURANCE"] == 2
    assert chip.state is not State.DEAD
    assert chip.memory["MSC_CTRL"] == 0
