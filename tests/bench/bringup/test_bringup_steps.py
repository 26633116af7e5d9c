"""Single steps of a bring-up: what each finds on faulty, changed and sound boards."""

import numpy as np
import pytest

from adis_gonio.bench.bringup import STEPS, Outcome, Permission, Verdict, bring_up
from adis_gonio.device.bus import open_bus
from adis_gonio.sim.sampling import SignalChain
from fakes.boards import FAULTY, SOUND, Board
from fakes.changed_chips import OF_STEPS, Change, _with_chain, open_chip
from fakes.more_changed_chips import OF_STEPS as MORE_OF_STEPS, OnMachine, OverRangeOfOutputs

ALL = Permission(writes=True, flash=True)


def only(*names):
    return tuple(step for step in STEPS if step.name in names)


@pytest.mark.parametrize("name", FAULTY)
def test_the_step_of_a_fault_finds_it_alone(name):
    board, step, word = FAULTY[name]
    found = bring_up(board.open(1), permission=ALL, steps=only("link", "timing", "bit errors", step))
    assert found.accused == (step,)
    assert word in found.row(step).text


@pytest.mark.parametrize("step", STEPS, ids=[step.name for step in STEPS])
def test_each_step_confirms_a_sound_board(step):
    found = bring_up(SOUND.open(0), permission=ALL, steps=only("link", step.name))
    row = found.row(step.name)
    assert row.verdict is Verdict.OK
    assert {name: answer.outcome for name, answer in row.answers.items()} == dict.fromkeys(
        step.settles, Outcome.CONFIRMS
    )
    for figure in row.figures:
        if figure.u is not None and figure.expected is not None and figure.name != "|a|":  # it has a bias
            assert figure.value == pytest.approx(figure.expected, abs=5 * figure.u), figure
    assert found.undone_ok


def test_the_offset_registers_lsb_is_measured_as_it_is():
    found = bring_up(Board(offset_lsb=2).open(3), permission=ALL, steps=only("link", "offset"))
    answer = found.answers["accel_offset_lsb"]
    assert answer.outcome is Outcome.CONTRADICTS
    assert len(answer.figures) >= 3
    for figure in answer.figures:
        assert figure.value == pytest.approx(2.0, abs=5 * figure.u)
        assert figure.u < 4e-3


def test_the_accelerometers_answer_to_the_negative_stimulus_is_reported_as_a_difference():
    found = bring_up(
        Board(negative_self_test=True).open(2), permission=ALL, steps=only("link", "self-test")
    )
    assert found.row("self-test").verdict is Verdict.DIFFERS
    assert found.answers["self_test_accel"].outcome is Outcome.CONTRADICTS
    assert found.answers["self_test_gyro"].outcome is Outcome.CONFIRMS


UNLIKE = {  # column (supply, gyros, accelerometers), sign of the stimulus, answer in mg or °/s
    "YACCL_OUT does not answer to the positive stimulus": (5, 1, 0.0),
    "ZACCL_OUT answer differently": (6, -1, -250.0),
    "XGYRO_OUT, YGYRO_OUT, ZGYRO_OUT answer differently": (1, -1, 0.0),
    "YGYRO_OUT, ZGYRO_OUT answer differently": (3, -1, 50.0),
}


@pytest.mark.parametrize("said", UNLIKE)
def test_an_axis_that_answers_to_the_self_test_unlike_the_others_is_a_fault(monkeypatch, said):
    column, sign, answer = UNLIKE[said]
    scaled = SignalChain._scaled

    def wrong(sampler, inputs):
        new = scaled(sampler, inputs)
        if sampler._manual_test == sign:
            test, sampler._manual_test = sampler._manual_test, 0.0
            rest = scaled(sampler, inputs)
            sampler._manual_test = test
            new[:, column] = rest[:, column] + np.int64(answer * sampler._gain[column])
        return new

    monkeypatch.setattr(SignalChain, "_scaled", wrong)
    found = bring_up(open_bus("sim:?seed=3"), permission=ALL, steps=only("link", "self-test"))
    assert found.row("self-test").verdict is Verdict.FAULT
    assert said in found.row("self-test").text


@pytest.mark.parametrize("width_us", [30, 150, 250, 400, 700, 1100])
@pytest.mark.parametrize("leads", [False, True])
def test_the_edge_that_leads_is_found_whatever_the_width_of_the_pulse(width_us, leads):
    board = Board(pulse_s=1e-6 * width_us, lead_s=1e-6 * width_us * leads)
    found = bring_up(board.open(1), steps=only("link", "timing", "bit errors", "data-ready"))
    edge = found.answers["data_ready_edge"]
    if leads and width_us < 1100:  # so wide a pulse ends just before the next update
        assert edge.outcome is Outcome.CONTRADICTS
        assert found.accused == ("data-ready",)
    elif not leads:
        assert edge.outcome is Outcome.CONFIRMS


@pytest.mark.parametrize("rate_error", [-0.028, 0.03])
def test_a_clock_that_a_bridge_of_32_frames_cannot_measure_does_not_accuse_data_ready(rate_error):
    bus = Board(rate_error=rate_error).open(1)
    bus.unbroken_frames = 32
    found = bring_up(bus, steps=only("link", "timing", "bit errors", "sample rate", "data-ready"))
    assert found.row("sample rate").verdict is Verdict.NOT_MEASURED
    assert found.row("data-ready").verdict is Verdict.OK


@pytest.mark.parametrize("counts", [True, False])
def test_a_board_without_the_wire_is_not_accused_and_polls(counts):
    found = bring_up(
        Board(data_ready=False, counts=counts).open(2),
        steps=only("link", "bit errors", "data-ready", "noise"),
    )
    assert not found.accused
    assert found.row("data-ready").text.startswith("no edge arrives")
    assert found.row("noise").verdict is Verdict.OK


def test_an_offset_that_somebody_wrote_is_not_the_parts_bias():
    board = Board(flash=(("XACCL_OFF", 500),), direction=(1.0, 0.0, 0.0))
    found = bring_up(board.open(9, bias_x_mg=0.0), steps=only("link", "bit errors", "variant"))
    assert found.row("variant").verdict is Verdict.OK
    assert found.row("variant").figures[0].value == pytest.approx(2140, rel=0.01)


def test_a_silent_axis_is_named():
    found = bring_up(SOUND.open(7, noise_mg=0.0, bias_instability_mg=0.0), steps=only("link", "noise"))
    assert found.row("noise").verdict is Verdict.FAULT
    assert "never changes" in found.row("noise").text


CHANGED = OF_STEPS | MORE_OF_STEPS


@pytest.mark.parametrize("name", CHANGED)
def test_a_changed_rule_of_the_part_is_contradicted_by_the_step_that_asks_for_it(name):
    rule = CHANGED[name].rule
    (step,) = (step for step in STEPS if rule in step.settles)
    with open_chip(CHANGED[name], 2) as bus:
        found = bring_up(bus, permission=ALL, steps=only("link", step.name))
    assert found.answers[rule].outcome is Outcome.CONTRADICTS
    assert found.accused == (step.name,)


def test_over_range_that_falls_at_offsets_near_its_limit_is_confirmed():
    with open_chip(Change("", _with_chain(OverRangeOfOutputs)), 4) as bus:
        found = bring_up(bus, permission=ALL, steps=only("link", "status"))
    assert found.answers["over_range_falls"].outcome is Outcome.CONFIRMS


def test_the_filter_is_not_judged_on_a_vibrating_table():
    with open_chip(Change("", OnMachine), 2) as bus:
        found = bring_up(bus, permission=ALL, steps=only("link", "filter steps"))
    assert found.answers["filter_gain"].outcome is Outcome.NOT_MEASURED
    assert not found.accused


@pytest.mark.parametrize(
    ("setting", "value", "loud", "quiet"),
    [("noise_mg", 6.0, "accel", "gyro"), ("gyro_noise_dps", 0.9, "gyro", "accel")],
)
def test_noise_that_is_not_the_tables_is_a_difference_with_its_size_on_each_axis(
    setting, value, loud, quiet
):
    found = bring_up(SOUND.open(8, **{setting: value}), steps=only("link", "bit errors", "noise"))
    assert found.row("noise").verdict is Verdict.DIFFERS
    of_kind = {"accel": "ACCL", "gyro": "GYRO"}[loud]
    named = [part.partition(":")[0] for part in found.row("noise").text.split("; ")]
    assert named == [f"{axis}{of_kind}_OUT" for axis in "XYZ"]
    answer = found.answers[f"{loud}_noise"]
    assert answer.outcome is Outcome.CONTRADICTS
    assert all(figure.value == pytest.approx(value, abs=5 * figure.u) for figure in answer.figures)
    assert found.answers[f"{quiet}_noise"].outcome is Outcome.CONFIRMS
