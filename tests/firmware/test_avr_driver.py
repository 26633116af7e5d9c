"""Driver, serial transport and real binary together: what a user's first hour does, in simulated time."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.bus import Capability
from adis_gonio.bus.serial import SerialBus
from adis_gonio.errors import VariantError
from adis_gonio.fitting import fit
from adis_gonio.sensor import Adis16354
from adis_gonio.session.archive import read_session
from adis_gonio.session.events import Finished, Problem
from adis_gonio.session.plans import plan
from adis_gonio.session.runner import SessionRunner
from adis_gonio.session.settings import Settings
from adis_gonio.sim import SimulatedChip, World, WorldSettings
from contract.bus_contract import BusContract, WatchedChip
from contract.bus_contract import Rig as ContractRig

SEVEN = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "SUPPLY_OUT")
SEED = 11


class RigStage:
    """The world's stage, moved in the rig's time."""

    def __init__(self, rig) -> None:
        self._rig = rig

    def move_to(self, angle_deg: float, approach: int = 0) -> None:
        end_s = self._rig.world.stage.move_to(self._rig.now_s(), angle_deg, approach)
        self._rig.sleep_s(end_s - self._rig.now_s())


def open_serial(rig) -> SerialBus:
    bus = SerialBus(rig.port, url="serial:rig", clock=rig)
    bus.stage = RigStage(rig)
    return bus


@pytest.fixture
def rig(make_rig):
    rig = make_rig(World(seed=SEED))
    rig.sleep_s(0.02)
    return rig


def test_the_sensor_is_identified_and_every_register_reads_what_the_chip_holds(rig):
    with Adis16354(open_serial(rig)) as sensor:
        assert sensor.bus.firmware.board == "atmega328p"
        assert {
            Capability.STREAM,
            Capability.HARD_RESET,
            Capability.EVENT_COUNTER,
        } <= sensor.bus.capabilities
        for name, value in sensor.read_all().items():
            if not name.endswith("_OUT") and name not in ("STATUS", "AUX_ADC"):
                assert value == rig.chip.memory[name], name
        assert sensor.scan()["XACCL_OUT"] == pytest.approx(1000, abs=60)
    assert rig.log.fast_frames == rig.log.frames > 30
    assert rig.log.writes == 0


def test_another_variant_is_noticed(make_rig):
    rig = make_rig(World(part="adis16350", seed=SEED))
    rig.sleep_s(0.02)
    with pytest.raises(VariantError):
        Adis16354(open_serial(rig))


def test_the_clock_follows_the_chips_mode_and_back(rig):
    with Adis16354(open_serial(rig)) as sensor:
        sensor.configure(smpl_prd=0x0A)
        slow = rig.log.frames
        sensor.scan()
        assert rig.log.frames - slow >= 8
        normal = rig.log.frames - rig.log.fast_frames
        assert normal > 8
        sensor.configure(smpl_prd=1)
        sensor.scan()
        assert rig.log.frames - rig.log.fast_frames - normal <= 4
    assert rig.log.least_us("period", "fast") < 43


def test_seven_registers_at_the_full_rate_reach_the_user_without_a_gap(rig):
    with Adis16354(open_serial(rig)) as sensor:
        sensor.configure(smpl_prd=1, filter_m=0, data_ready=True)
        with sensor.stream(SEVEN) as stream:
            blocks = [next(stream) for _ in range(4)]
    times = np.concatenate([block.time_s for block in blocks])
    assert len(times) >= 4 * 200
    assert sum(block.lost for block in blocks) == 0
    assert np.abs(np.diff(times) * 819.2 - 1).max() < 0.05
    assert all((block.words & 0x8000).all() for block in blocks)


def test_a_stream_enables_data_ready_by_itself_and_sets_it_back(rig):
    with Adis16354(open_serial(rig)) as sensor:
        sensor.configure(smpl_prd=1, filter_m=0, linear_g=True)
        with pytest.raises(KeyboardInterrupt), sensor.stream(SEVEN) as stream:  # noqa: PT012
            block = next(stream)
            assert rig.chip.memory["MSC_CTRL"] == 0x84
            raise KeyboardInterrupt
        assert len(block) >= 200
        assert block.lost == 0
        assert rig.chip.memory["MSC_CTRL"] == 0x80
        with sensor.stream(SEVEN, leave_registers=True) as stream:
            assert "polling" in stream.how
            assert len(next(stream)) > 0
        assert rig.chip.memory["MSC_CTRL"] == 0x80


def test_a_hard_reset_brings_back_what_is_saved(rig):
    with Adis16354(open_serial(rig)) as sensor:
        sensor.write("XACCL_OFF", 100)
        sensor.bus.hard_reset()
        rig.sleep_s(0.3)
        assert sensor.read("XACCL_OFF") == 0
    ((low_s, high_s),) = rig.resets
    assert high_s - low_s == pytest.approx(1e-3, rel=0.05)


def test_a_two_position_session_is_calibrated_over_the_real_firmware(make_rig, tmp_path):
    # No biases, which two positions cannot see, and a perfect fixture: then what comes out is the truth.
    hidden = WorldSettings(
        delta_k=0.034,
        delta_phi_deg=-4.3,
        alpha_deg=2.0,
        fixture_sigma_deg=0.0,
        move_speed_dps=180.0,
        noise_mg=2.0,
        self_heating_c=0.0,
        ambient_c=25.0,
        **{f"bias_{axis}_mg": 0.0 for axis in "xyz"},
    )
    rig = make_rig(World(hidden, seed=SEED))
    rig.sleep_s(0.02)
    settings = Settings(dwell_s=1.0, settle_s=0.1, registers=SEVEN)
    path = tmp_path / "rig.session"
    with Adis16354(open_serial(rig)) as sensor:
        events = list(SessionRunner.begin(sensor, path, plan("two-position"), settings, auto=True).run())
    assert isinstance(events[-1], Finished)
    assert not [event for event in events if isinstance(event, Problem)]
    session = read_session(path)
    assert all(len(dwell.time_s) >= 819 for dwell in session.dwells)
    found = fit(session, method="two-position").as_dict()["parameters"]
    assert found["delta_k"]["value"] == pytest.approx(0.034, abs=6 * found["delta_k"]["u"])
    assert found["delta_phi"]["value"] == pytest.approx(-4.3, abs=6 * found["delta_phi"]["u"])
    assert found["delta_k"]["u"] < 0.001
    assert rig.log.fast_frames > 20_000


class TestFirmwareBinary(BusContract):
    """The contract of every bus, with the real binary between the bus and the pins."""

    @pytest.fixture
    def rig(self, make_rig):
        chip = WatchedChip(World(seed=SEED), start_s=-0.5)
        rig = make_rig(World(seed=SEED), chip=chip)
        rig.sleep_s(0.02)
        bus = open_serial(rig)
        yield ContractRig(bus, chip, SimulatedChip(World(seed=SEED), start_s=-0.5), slowest_hz=125_000)
        bus.close()

    def make(self) -> ContractRig:
        raise NotImplementedError
