"""Faults are named by the step that they belong to; sound boards are not accused."""

import pytest

from adis_gonio.bench.bringup import Outcome, Permission, Verdict, bring_up
from adis_gonio.bench.bringup.bringup_step import QUESTIONS
from fakes.boards import FAULTY, SOUND, Board, sound

ALL = Permission(writes=True, flash=True)


@pytest.mark.parametrize("name", FAULTY)
def test_a_fault_is_named_by_its_step_and_by_no_other(name):
    board, step, word = FAULTY[name]
    found = bring_up(board.open(1), permission=ALL)
    assert found.accused == (step,)
    assert word in found.row(step).text
    assert found.undone_ok


@pytest.mark.parametrize("seed", range(6))
def test_a_sound_board_is_not_accused_whatever_its_settings_and_its_bridge(seed):
    bus = sound(seed).open(seed)
    before = {name: bus.chip.memory[name] for name in dict(bus.board.flash)}
    found = bring_up(bus, permission=ALL)
    assert not found.accused, [found.row(name).text for name in found.accused]
    assert found.sound
    assert {name: bus.chip.memory[name] for name in before} == before
    assert bus.chip.memory["ENDURANCE"] == 1


def test_on_a_sound_board_every_row_that_a_step_answers_is_answered():
    found = bring_up(SOUND.open(0), permission=ALL)
    assert set(found.answers) == {question.name for question in QUESTIONS}
    outcomes = {name: answer.outcome for name, answer in found.answers.items()}
    confirmed = {name for name, outcome in outcomes.items() if outcome is Outcome.CONFIRMS}
    assert confirmed == {
        "accel_offset_lsb", "accel_noise", "gyro_noise", "filter_gain", "sample_period", "data_ready_edge",
        "self_test_gyro", "self_test_accel", "over_range_falls", "alarm_stays", "flash_count",
        "offset_after_filter",
    }  # fmt: skip
    assert {*outcomes.values()} == {Outcome.CONFIRMS, Outcome.NOT_MEASURED}
    assert all(answer.text for answer in found.answers.values())


def test_above_a_clock_with_errors_nothing_is_clocked_faster():
    bus = Board(clean_hz=300e3).open(5)
    clocks = []
    exchange = bus._exchange

    def watched(frames):
        clocks.append(bus.timing.clock_hz)
        return exchange(frames)

    bus._exchange = watched
    found = bring_up(bus, permission=ALL)
    assert found.accused == ("bit errors",)
    tried = clocks.index(500e3)
    assert max(clocks) == 500e3
    assert max(clocks[tried + 1 :]) <= 250e3


def test_where_every_clock_has_errors_nothing_more_is_judged():
    found = bring_up(Board(clean_hz=20e3, bit_errors=0.01).open(6), permission=ALL)
    assert found.accused in (("bit errors",), ("link",))
    rest = found.rows[3:]
    assert all(row.verdict is Verdict.NOT_MEASURED for row in rest)
