"""What is written is undone and verified after each step, an error, a Ctrl-C; a no is obeyed."""

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.bench.bringup import STEPS, Permission, Verdict, bring_up
from adis_gonio.record.source import HOLDING_SETTINGS
from fakes.boards import Board

HELD = (("SMPL_PRD", 0x03), ("SENS_AVG", 0x0201 | 0x2), ("XACCL_OFF", 57), ("ALM_MAG1", 0x8123))
WRITES = Permission(writes=True, flash=True)
SHORT = ("link", "data-ready", "offset", "self-test", "status")


def opened(**board):
    """A bus, the registers' words behind it, and the list of write frames to come."""
    bus = Board(flash=HELD, **board).open(3)
    writes = []
    exchange = bus._exchange

    def watched(frames):
        writes.extend(int(frame) for frame in frames if frame & 0x8000)
        return exchange(frames)

    bus._exchange = watched
    return bus, registers_of(bus), writes


def registers_of(bus):
    return {name: bus.chip.memory[name] for name in HOLDING_SETTINGS}


def steps(*names):
    return tuple(step for step in STEPS if step.name in names)


def failing(bus, at, error, times=1):
    """Let the exchanges that hold a write fail from the given one on."""
    exchange, seen = bus._exchange, [0]

    def fails(frames):
        if np.any(frames & 0x8000):
            seen[0] += 1
            if at <= seen[0] < at + times:
                half = max(1, len(frames) // 2)
                exchange(frames[:half])  # the first byte of a register is written, the second is not
                raise error
        return exchange(frames)

    bus._exchange = fails
    return seen


def test_every_step_leaves_the_registers_as_it_found_them():
    bus, before, writes = opened()
    held = []
    bring_up(bus, permission=WRITES, tell=lambda row: held.append((row.name, registers_of(bus))))
    assert writes
    for name, registers in held:
        assert registers == before, name


def test_without_permission_nothing_but_data_ready_is_written():
    bus, before, writes = opened()
    found = bring_up(bus)
    assert {frame >> 8 & 0x3F for frame in writes} == {0x34}, "the low byte of MSC_CTRL"
    assert registers_of(bus) == before
    left = [row.name for row in found.rows if row.verdict is Verdict.NOT_MEASURED]
    assert left == [step.name for step in STEPS if step.question]
    assert "--allow-writes" in found.row("offset").text


def test_a_no_leaves_a_step_out_and_a_yes_to_the_next_one_does_it():
    bus, before, _ = opened()
    asked = []

    def ask(question):
        asked.append(question)
        return "self-test" in question

    found = bring_up(bus, permission=Permission(writes=True, flash=True, ask=ask))
    assert len(asked) == sum(bool(step.question) for step in STEPS)
    assert "was no" in found.row("offset").text
    assert found.row("self-test").verdict is Verdict.OK
    assert registers_of(bus) == before
    assert bus.chip.memory["ENDURANCE"] == 0


@pytest.mark.parametrize("at", [1, 2, 3, 6, 9, 14, 20, 26])
@pytest.mark.parametrize("times", [1, 2])
def test_a_ctrl_c_at_any_write_ends_the_run_with_the_registers_put_back(at, times):
    bus, before, _ = opened()
    seen = failing(bus, at, KeyboardInterrupt(), times)
    found = bring_up(bus, permission=WRITES, steps=steps(*SHORT))
    assert seen[0] >= at
    assert found.stopped
    assert registers_of(bus) == before
    assert found.undone_ok
    assert found.rows[-1].text == "stopped by the operator"
    assert [row.name for row in found.rows] == [step.name for step in steps(*SHORT)]


def test_a_ctrl_c_while_a_row_is_shown_keeps_the_rows():
    bus, before, _ = opened()

    def show(row):
        if row.name == "offset":
            raise KeyboardInterrupt

    found = bring_up(bus, permission=WRITES, steps=steps(*SHORT), tell=show)
    assert found.stopped
    assert found.row("offset").verdict is Verdict.OK
    assert found.row("status").text == "stopped by the operator"
    assert registers_of(bus) == before


@pytest.mark.parametrize("at", [1, 3, 6, 14, 20])
def test_an_error_in_a_step_is_its_fault_and_the_next_steps_go_on(at):
    bus, before, _ = opened()
    failing(bus, at, BusTimeoutError("no answer"))
    found = bring_up(bus, permission=WRITES, steps=steps(*SHORT))
    (accused,) = found.accused
    assert "no answer" in found.row(accused).text
    assert not found.stopped
    assert registers_of(bus) == before
    assert found.undone_ok


def test_a_bus_that_dies_after_a_write_is_said_and_nothing_more_is_tried():
    bus, before, _ = opened()
    failing(bus, 6, BusTimeoutError("no answer"), times=10**6)
    found = bring_up(bus, permission=WRITES, steps=steps(*SHORT))
    assert registers_of(bus) != before, "the test is to have something to undo"
    assert not found.undone_ok
    assert not found.sound
    assert "NOT put back" in found.undone
    assert "XACCL_OFF" in found.undone
    assert "could not be put back" in found.rows[-1].text


def test_a_register_that_does_not_go_back_is_named():
    bus, before, _ = opened()
    back = 0x8000 | 0x22 << 8 | before["YACCL_OFF"] & 0xFF
    exchange = bus._exchange
    bus._exchange = lambda frames: exchange(np.where(frames == back, 0, frames).astype(np.uint16))
    found = bring_up(bus, permission=WRITES, steps=steps("link", "offset", "self-test"))
    assert "YACCL_OFF" in found.row("offset").text
    assert found.undone == "NOT put back: YACCL_OFF; switch the supply off and on"
    assert not found.sound
    assert found.row("self-test").verdict is Verdict.NOT_MEASURED
    assert registers_of(bus) == before | {"YACCL_OFF": bus.chip.memory["YACCL_OFF"]}


def test_the_flash_is_written_once_and_holds_what_it_held():
    bus, before, _ = opened()
    chip = bus.chip
    flash = dict(chip.memory._flash)
    chip.memory["XACCL_OFF"] = 99  # somebody's volatile setting, which must not get into the flash
    found = bring_up(bus, permission=WRITES, steps=steps("link", "flash count"))
    assert found.row("flash count").verdict is Verdict.OK
    assert chip.memory["ENDURANCE"] == 1
    assert dict(chip.memory._flash) == flash
    assert registers_of(bus) == before | {"XACCL_OFF": 99}


def test_with_a_supply_too_low_the_flash_is_not_touched():
    bus, _, _ = opened(supply_v=4.7)
    found = bring_up(bus, permission=WRITES, steps=steps("link", "supply", "flash count"))
    assert found.row("flash count").verdict is Verdict.NOT_MEASURED
    assert bus.chip.memory["ENDURANCE"] == 0
    assert not bus.chip.memory["STATUS"]
