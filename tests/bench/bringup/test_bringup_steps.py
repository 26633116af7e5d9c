"""Single steps of a bring-up on faulty, changed and sound boards."""

import itertools
import re
from dataclasses import replace

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
        if figure.expected is not None and figure.name != "|a|":  # it has a bias
            error = 0.02 * figure.expected if figure.u is None else 5 * figure.u
            assert figure.value == pytest.approx(figure.expected, abs=error), figure
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


@pytest.mark.parametrize(
    ("width_us", "leads"),
    # A leading pulse of 1100 µs begins just after the update before, and is not judged.
    [*itertools.product([30, 150, 250, 400, 700], [False, True]), (1100, False)],
)
def test_the_edge_that_leads_is_found_whatever_the_width_of_the_pulse(width_us, leads):
    board = Board(pulse_s=1e-6 * width_us, lead_s=1e-6 * width_us * leads)
    found = bring_up(board.open(1), steps=only("link", "timing", "bit errors", "data-ready"))
    expected = Outcome.CONTRADICTS if leads else Outcome.CONFIRMS
    assert found.answers["data_ready_edge"].outcome is expected
    assert found.accused == (("data-ready",) if leads else ())


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


# -- link, timing, variant --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "verdict", "said"),
    [
        (lambda words: 0 * words, Verdict.FAULT, "stuck low"),
        (lambda words: 0 * words + 0x1234, Verdict.FAULT, "all replies are 0x1234"),
        (lambda words: words ^ 0x5A33, Verdict.FAULT, "make no sense"),
        (lambda words: words << 1, Verdict.FAULT, "one bit early"),
        (lambda words: words >> 8 | words << 8, Verdict.FAULT, "two bytes of the words are swapped"),
        (lambda words: np.where(words == 0x0402, 0x8402, words), Verdict.DIFFERS, "not allowed: SENS_AVG"),
    ],
)
def test_replies_of_a_wrong_link_are_named(change, verdict, said):
    bus = SOUND.open(0)
    exchange = bus._exchange
    bus._exchange = lambda frames: change(exchange(frames)).astype(np.uint16)
    found = bring_up(bus, steps=only("link", "supply"))
    assert found.row("link").verdict is verdict
    assert said in found.row("link").text
    assert (found.row("supply").verdict is Verdict.NOT_MEASURED) == (verdict is Verdict.FAULT)


def test_words_that_change_from_read_to_read_are_a_fault_of_the_wires():
    bus, dice = SOUND.open(0), np.random.default_rng(1)
    bus._exchange = lambda frames: dice.integers(0, 1 << 16, len(frames)).astype(np.uint16)
    assert "read differently each time" in bring_up(bus, steps=only("link")).row("link").text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"stall_us": 70.0}, "stall 70 and period 160 µs in normal mode"),
        ({"period_us": 150.0}, "stall 75 and period 150 µs in normal mode"),
        ({"clock_hz": 260e3}, "clocks at 260000 Hz where at most 250000 was asked"),
    ],
)
def test_a_bridge_that_does_not_keep_the_limits_asked_for_ends_the_bring_up(change, said):
    bus = SOUND.open(0)
    bus._configure = lambda timing: replace(timing, **change) if timing.stall_us == 75.0 else timing
    found = bring_up(bus, steps=only("link", "timing", "bit errors"))
    assert found.row("timing").verdict is Verdict.FAULT
    assert said in found.row("timing").text
    assert found.row("bit errors").verdict is Verdict.NOT_MEASURED


@pytest.mark.parametrize(
    ("bias_mg", "verdict", "said"),
    [
        (20.0, Verdict.OK, "g of an ADIS16354"),
        (100.0, Verdict.DIFFERS, "further from 1 g"),
        (700.0, Verdict.FAULT, "no known part"),
    ],
)
def test_the_length_of_gravity_allows_the_bias_and_the_gain_of_the_table(bias_mg, verdict, said):
    bus = Board(direction=(1.0, 0.0, 0.0)).open(9, bias_x_mg=bias_mg)
    row = bring_up(bus, steps=only("link", "variant")).row("variant")
    assert row.verdict is verdict
    assert said in row.text


# -- noise, offsets, flash --------------------------------------------------------------------------------


def test_a_tone_is_named_with_its_axis_frequency_and_amplitude():
    row = bring_up(Board(hum_mg=4.0).open(1), steps=only("link", "noise")).row("noise")
    found = re.fullmatch(
        r"a tone of ([\d.]+) mg at ([\d.]+) Hz on XACCL_OUT: hum or a vibrating table", row.text
    )
    assert float(found[1]) == pytest.approx(4.0, rel=0.2)
    assert float(found[2]) == pytest.approx(50.0, abs=0.2)


def test_the_noise_of_a_sound_board_scatters_by_its_uncertainty():
    rows = [bring_up(SOUND.open(seed), steps=only("link", "noise")).row("noise") for seed in range(4)]
    figures = [figure for row in rows for figure in row.figures if figure.u is not None]
    off = [(figure.value - figure.expected) / figure.u for figure in figures]
    assert len(off) == 24
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_an_offset_near_the_end_of_its_register_is_moved_the_other_way():
    bus = Board(flash=(("XACCL_OFF", 1500),)).open(3)
    assert bring_up(bus, permission=ALL, steps=only("link", "offset")).row("offset").verdict is Verdict.OK
    assert bus.chip.memory["XACCL_OFF"] == 1500


@pytest.mark.parametrize(
    ("frame", "name"), [(0xB201, "GPIO_CTRL"), (0xB202, "GPIO_CTRL"), (0xB010, "AUX_DAC")]
)
def test_a_line_that_is_in_use_is_not_dropped_by_a_reset(frame, name):
    bus = SOUND.open(0)
    bus.exchange([frame, 0])
    found = bring_up(bus, permission=ALL, steps=only("link", "flash count"))
    assert found.row("flash count").verdict is Verdict.NOT_MEASURED
    assert f"{name} is in use" in found.row("flash count").text
    assert bus.chip.memory["ENDURANCE"] == 0


# -- the rate of updates ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate_error", "verdict", "said"),
    [
        (0.0, Verdict.OK, "819.2"),
        (0.01, Verdict.DIFFERS, " +1.00 % from the nominal rate"),
        (-0.04, Verdict.DIFFERS, " −3.99 % from the nominal rate"),
        (-0.5, Verdict.FAULT, "that would be SMPL_PRD = 0x03"),
    ],
)
def test_a_rate_is_the_nominal_one_an_error_of_the_clock_or_another_setting(rate_error, verdict, said):
    bus = Board(rate_error=rate_error).open(1)
    row = bring_up(bus, steps=only("link", "sample rate")).row("sample rate")
    assert row.verdict is verdict
    assert said in row.text
    rate, period = row.figures
    assert rate.value == pytest.approx(819.2 * (1 + rate_error), rel=1e-3)
    assert period.value * rate.value == pytest.approx(1e6)
    # A computer's clock is known to 100 ppm / √3; the reads add a little in two seconds.
    assert 5e-5 < rate.u / rate.value < 1e-4


def test_a_cleared_gyro_range_is_a_content_that_is_not_allowed():
    bus = open_bus("sim:?seed=3")
    bus.chip.memory["SENS_AVG"] = 0
    link = bring_up(bus, steps=only("link")).row("link")
    assert link.verdict is Verdict.DIFFERS
    assert link.text.endswith("SENS_AVG 0x0000")
