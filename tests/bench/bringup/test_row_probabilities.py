"""Probabilities of the table's rows, from observations and from the history of a recorded chip."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.bench.bringup import Outcome
from adis_gonio.bench.bringup.bringup_step import BringupBus, Question
from adis_gonio.bench.bringup.chip_rows import (
    BY_QUESTION,
    ELSE,
    ChipRow,
    RecordedChip,
    RegisterSpan,
    RowFigure,
    findings_text,
)
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import BY_NAME, VARIANTS
from adis_gonio.sim import SimBus, World

PART = VARIANTS["adis16354"]


def row(*alternatives: str, confidence: str = "C", wide: tuple[float, float] = (-10.0, 10.0)) -> ChipRow:
    return ChipRow(Question("x", "X?", "", "", confidence, ""), lambda *_: (), alternatives, wide)


def test_nothing_observed_leaves_the_prior_and_one_odd_event_among_many_no_doubt():
    hypotheses = row("a", "b")
    assert hypotheses.judge([]).outcome is Outcome.NOT_MEASURED
    assert hypotheses.judge([]).probabilities["a"] == pytest.approx(0.9)
    assert hypotheses.judge([*["a"] * 20, "b"]).outcome is not Outcome.CONTRADICTS
    assert hypotheses.judge(["b"] * 3).best == "b"
    assert hypotheses.judge(["c"] * 4).best == ELSE


def test_a_figure_follows_the_normal_density_between_two_alternatives():
    hypotheses = row("one", "two", confidence="C")
    figure = RowFigure(1.4, 0.1, {"one": (1.0, 1.0), "two": (2.0, 2.0)})
    # ln of the densities: -(0.4/0.1)²/2 and -(0.6/0.1)²/2, with a ten-thousandth of a flat density of 1/20.
    densities = [0.9999 * math.exp(-z * z / 2) / (0.1 * math.sqrt(2 * math.pi)) + 5e-6 for z in (4.0, 6.0)]
    chances = hypotheses.judge([figure]).probabilities
    assert chances["one"] / chances["two"] == pytest.approx(0.9 * densities[0] / (0.05 * densities[1]))


def test_two_of_eight_figures_off_contradict_the_table():
    row_of = row("one", "two", confidence="A")
    figures = [RowFigure(x, 0.01, {"one": (0.9, 1.1), "two": (2.0, 2.0)}) for x in (*[1.0] * 6, 1.5, 1.6)]
    assert row_of.judge(figures[:6]).outcome is Outcome.CONFIRMS
    assert row_of.judge(figures).best == ELSE


def test_a_row_that_nothing_distinguishes_stays_open():
    figure = RowFigure(0.2, 5.0, {"one": (0.0, 0.0), "two": (0.0, 0.0)})
    assert row("one", "two").judge([figure]).outcome is Outcome.OPEN


def test_long_rows_are_cut_to_the_width_of_the_table():
    finding = row("a", "b").judge(["another word that is much too long for the table"] * 9)
    assert max(map(len, findings_text([finding]).splitlines())) <= 80


def test_odds_are_shown_in_favour_of_or_against_the_table_and_contradictions_come_first():
    for_it, against = row("a", "b").judge(["a"] * 3), row("a", "b").judge(["b"])
    lines = findings_text([for_it, row("a", "b").judge([]), against]).splitlines()
    rows = [line.split() for line in lines if line.startswith("x ")]
    assert [line[-1] for line in rows] == [against.outcome, for_it.outcome]
    assert rows[0][-2].startswith("1:")
    assert rows[1][-2].endswith(":1")
    assert lines[-1] == "not exercised: x"
    assert findings_text([for_it]).splitlines()[-1] == "not exercised: none"


@pytest.mark.parametrize(
    ("evidence", "odds"),
    [(0.0, "1:1"), (3.5, "3162:1"), (5.2, "1e5:1"), (-2.0, "1:100"), (200.0, "1e99:1")],
)
def test_odds_beyond_ten_thousand_are_powers_of_ten(evidence, odds):
    finding = replace(row("a", "b").judge(["a"]), log10_evidence=evidence)
    assert findings_text([finding]).splitlines()[1].split()[-2] == odds


def test_evidence_against_the_table_does_not_confirm_it_however_sure_the_table_is():
    sure, figure = row("one", "two", confidence="A"), {"one": (1.0, 1.0), "two": (1.02, 1.02)}
    against = sure.judge([RowFigure(1.02, 0.01, figure)])
    assert (against.outcome, against.log10_evidence < 0) == (Outcome.OPEN, True)
    assert against.probabilities["one"] > 0.99
    assert sure.judge([RowFigure(1.0, 0.01, figure)]).outcome is Outcome.CONFIRMS


# -- observations -----------------------------------------------------------------------------------------


def observed(name: str, **chip) -> list:
    return list(BY_QUESTION[name].observe(SimpleNamespace(**chip), PART))


@pytest.mark.parametrize(
    ("reply", "label"),
    [(0, "zeros"), (0xA012, "the frame"), (0x112, "the content"), (7, "the reply before"), (9, ELSE)],
)
def test_the_reply_to_a_write_is_named(reply, label):
    assert observed("reply_to_write", after_writes=[(0xA012, 0x112, 7, reply)]) == [label]


def test_a_reply_that_may_be_two_things_is_no_observation():
    assert observed("reply_to_write", after_writes=[(0xA012, 0x112, 0, 0)]) == []
    assert observed("reply_to_write", after_writes=[(0xA012, 0x112, 0, 0x112)]) == ["the content"]


@pytest.mark.parametrize(("extra", "label"), [(0, "zeros"), (0xF8F8, "ones"), (0x8000, ELSE)])
def test_reserved_bits_of_a_register_are_named_once_for_each_content(extra, label):
    assert observed("reserved_bits", reads=[(BY_NAME["SENS_AVG"], 0x0402 | extra)] * 3) == [label]


@pytest.mark.parametrize(
    ("word", "label"),
    [(0x0FFF, ["zeros"]), (0xFFFF, ["the sign"]), (0xF001, ["ones"]), (0x1FFF, [ELSE]), (0x0001, [])],
)
def test_bits_above_the_number_of_an_offset_are_named(word, label):
    assert observed("offset_upper_bits", reads=[(BY_NAME["XACCL_OFF"], word)]) == label


@pytest.mark.parametrize(
    ("after_s", "ready", "label"),
    [
        (0.150, True, ["in time"]),
        (0.136, True, ["in time"]),
        (0.134, True, ["shorter"]),
        (0.164, False, []),
        (0.166, False, ["longer"]),
    ],
)
def test_a_wait_differs_from_the_table_from_a_tenth_on(after_s, ready, label):
    assert observed("reset_time", waits={"reset": [(after_s, ready)]}) == label
    assert observed("reset_time", waits={}) == []


def test_the_edge_of_data_ready_that_follows_the_update_has_new_data_in_its_first_word():
    def scans(place):
        words = np.zeros((9, 4), np.int64)
        words[:, place] = 0x8000
        return words

    assert observed("data_ready_edge", edges=[scans(0), scans(2)]) == ["the first", "the second"]
    assert observed("data_ready_edge", edges=[scans(0) | scans(1)]) == []


def first_word(passed: float, number: int, share: float) -> list:
    """Observations of an offset that a word shows by a share, `passed` updates later, at M = 6."""
    held = {"SMPL_PRD": 0x01, "SENS_AVG": 0x0406, "MSC_CTRL": 0}
    before = RegisterSpan(0.0, held | {"XACCL_OFF": 0}, -1.0)
    before.outputs["XACCL_OUT"] = [(0.5 + np.arange(20) / 819.2, np.full(20, 0x8000 | 100))]
    after = RegisterSpan(1.0, held | {"XACCL_OFF": number}, 1.0)
    seen = 0x8000 | round(100 + share * number)
    after.outputs["XACCL_OUT"] = [(np.array([1.0 + passed * after.period_s]), np.array([seen]))]
    return observed("offset_after_filter", spans=[before, after], rests=[])


def test_the_first_word_after_an_offset_shows_whether_it_passes_the_filter():
    # Of a step through two averages of 64 taps, 40 updates later, (40/64)²/2 has passed.
    ramp = (40 / 64) ** 2 / 2
    (at_once,), (filtered,) = first_word(40, 1000, 1.0), first_word(40, 1000, ramp)
    assert at_once.x == pytest.approx(1.0, abs=2e-3)
    assert filtered.x == pytest.approx(0.0, abs=2e-3)
    assert at_once.u == pytest.approx(0.05)
    assert first_word(60, 1000, 1.0) == [], "nearly half has passed"
    assert first_word(0.9, 1000, 1.0) == [], "no update has passed"
    assert first_word(40, 400, 1.0) == [], "a small offset shows nothing"


# -- the history of the registers -------------------------------------------------------------------------


def test_a_span_knows_its_rate_and_filter_and_the_readings_after_settling():
    span = RegisterSpan(1.0, {"SMPL_PRD": 0x01, "SENS_AVG": 0x0402}, 1.0)
    assert (span.period_s, span.m) == (pytest.approx(1 / 819.2, rel=1e-4), 2)
    unknown = RegisterSpan(1.0, {})
    assert math.isnan(unknown.period_s)
    assert (unknown.m, unknown.first("XACCL_OUT")) == (None, None)
    # The filter of M = 2 has settled after 7 samples; two more are left out.
    times = 1.0 + (np.arange(1, 21) - 0.3) / 819.2
    words = np.arange(1, 21) | 0x8000
    words[14] &= 0x7FFF  # read before its update
    span.outputs["XACCL_OUT"] = [(times[:5], words[:5]), (times[5:], words[5:])]
    assert span.first("XACCL_OUT") == (times[0], 1)
    assert span.settled("XACCL_OUT")[1].tolist() == [10, 11, 12, 13, 14, 16, 17, 18, 19, 20]
    assert len(span.settled("YACCL_OUT")[0]) == 0


@pytest.fixture
def recorded():
    """A sensor on a bus that keeps its calls, and the function that reads the history."""
    bus = BringupBus(SimBus(World(seed=1)), 2e6)
    return Adis16354(bus), lambda: RecordedChip(bus.calls)


def test_the_history_has_each_write_with_its_content_and_each_read(recorded):
    sensor, history = recorded
    sensor.read("XACCL_OFF")
    sensor.write("XACCL_OFF", -300)
    sensor.read("XACCL_OFF")
    chip = history()
    assert [content for _, content, _, _ in chip.after_writes] == [0x0D4]  # the second has no reply
    assert (BY_NAME["XACCL_OFF"], 0xED4) in chip.reads
    assert chip.spans[-1].image["XACCL_OFF"] == 0xED4
    assert "XACCL_OFF" in chip.spans[-1].verified
    for name in ("reply_to_write", "offset_upper_bits"):
        question = BY_QUESTION[name]
        assert question.judge([*question.observe(chip, PART)]).best == "zeros"


def test_the_history_has_the_waits_for_commands_and_forgets_what_they_change(recorded):
    sensor, history = recorded
    sensor.read("XGYRO_OFF")
    sensor.read("XACCL_OFF")
    sensor.autonull()
    chip = history()
    assert [name for _, name in chip.nulls] == ["autonull"]
    after = chip.spans[chip.nulls[0][0]].image
    assert after["XGYRO_OFF"] == sensor.read("XGYRO_OFF") & 0x1FFF != 0, "read again after the command"
    assert "XACCL_OFF" in after
    sensor.reset()
    chip = history()
    assert [ready for _, ready in chip.waits["reset"]][-1] is True
    assert chip.waits["reset"][-1][0] >= 0.15


@pytest.mark.parametrize(("rises", "count"), [(False, 1), (True, 0), (None, 0)])
def test_scans_of_one_register_show_the_edge_that_starts_them(recorded, rises, count):
    sensor, _ = recorded
    bus = sensor.bus
    bus.exchange([0xB404])  # data-ready, active low
    with bus.stream([0x0A00] * 8, block_scans=16) as stream:
        next(stream)
    chip = RecordedChip(bus.calls, rises)
    assert [words.shape for words in chip.edges] == [(15, 8)] * count
    with bus.stream([0x0A00, 0x0C00, 0x0E00, 0x1000], block_scans=16) as stream:
        next(stream)
    chip = RecordedChip(bus.calls, rises)
    assert len(chip.edges) == count
    assert len(chip.spans[-1].outputs["ZACCL_OUT"][0][0]) == 16


def test_rests_have_the_means_of_the_readings_between_two_changes(recorded):
    sensor, history = recorded
    names = ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT")
    for name in ("SMPL_PRD", "SENS_AVG", "XACCL_OFF"):
        sensor.read(name)
    means = []
    for number in (0, 1000):
        sensor.write("XACCL_OFF", number)
        sensor.read("XACCL_OFF")
        means.append(sensor.read_scans(600, names, data_ready=False).numbers().mean(axis=0))
    first, last = history().rests[0], history().rests[-1]
    assert last.mean[0] - first.mean[0] == pytest.approx(1000, abs=5)
    assert last.mean[:3] == pytest.approx(means[1], abs=1)
    assert np.isnan(last.mean[3:]).all()
    assert last.dps == 300
    (step, *_) = BY_QUESTION["accel_offset_lsb"].observe(history(), PART)
    assert step.x == pytest.approx(1.0, abs=5 * step.u)
    assert step.u < 0.01
