"""Driver, serial transport and real binary together: what a user's first hour does, in simulated time."""

from __future__ import annotations

import math

import pytest

from adis_gonio.base.errors import VariantError
from adis_gonio.bench.events import Finished, Problem
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import Adis16354
from adis_gonio.fitting import fit
from adis_gonio.record.plans import plan
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from adis_gonio.sim import SimulatedChip, World, WorldSettings
from adis_gonio.sim.testing.bus_contract import BusContract, Rig as ContractRig, WatchedChip
from firmware.board_tests import SEVEN, DriverTests, open_serial

SEED = 11


class RigStage:
    """The world's stage, moved in the rig's time."""

    def __init__(self, rig) -> None:
        self._rig = rig

    def move_to(self, angle_deg: float, approach: int = 0) -> None:
        end_s = self._rig.world.stage.move_to(self._rig.now_s(), angle_deg, approach)
        self._rig.sleep_s(end_s - self._rig.now_s())


def started(make_rig, **options):
    rig = make_rig(World(seed=SEED, **options))
    rig.sleep_s(0.02)
    return rig


class TestDriver(DriverTests):
    board = "atmega328p"

    @pytest.fixture
    def rig(self, make_rig):
        return started(make_rig)


def test_another_variant_is_noticed(make_rig):
    rig = started(make_rig, part="adis16350")
    with pytest.raises(VariantError):
        Adis16354(open_serial(rig))


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
    settings = Settings(dwell_s=0.5, settle_s=0.1, registers=SEVEN)
    path = tmp_path / "rig.session"
    bus = open_serial(rig)
    bus.stage = RigStage(rig)
    with Adis16354(bus) as sensor:
        events = list(SessionRunner.begin(sensor, path, plan("two-position"), settings, auto=True).run())
    assert isinstance(events[-1], Finished)
    assert not [event for event in events if isinstance(event, Problem)]
    session = read_session(path)
    assert all(len(dwell.time_s) >= 409 for dwell in session.dwells)
    found = fit(session, method="two-position")
    # Without what an unseen bias may do: here there is none.
    u = {
        name: math.hypot(*(row.contribution for row in found.budget[name] if row.source != "model choice"))
        for name in ("delta_k", "delta_phi")
    }
    assert found["delta_k"].value == pytest.approx(0.034, abs=6 * u["delta_k"])
    assert found["delta_phi"].value == pytest.approx(-4.3, abs=6 * u["delta_phi"])
    assert u["delta_k"] < 0.001
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
