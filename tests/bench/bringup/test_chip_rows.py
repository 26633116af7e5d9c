"""Recordings of changed chips name the changed row of the register table, and no row of a sound chip."""

from __future__ import annotations

import json
import math
from functools import cache

import pytest

from adis_gonio.bench.bringup import Outcome
from adis_gonio.bench.bringup.bringup_step import Question
from adis_gonio.bench.bringup.chip_rows import (
    ELSE,
    ROWS,
    ChipRow,
    RowFigure,
    findings_text,
    judge_recordings,
)
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.faces.cli import main
from fakes.changed_chips import CHANGES, record_bringup, record_nulls, record_service
from fakes.more_changed_chips import SOUND

PART = VARIANTS["adis16354"]
IN_BRINGUP = (
    *("a write is echoed", "one byte is read twice", "upper bits of offsets are ones"),
    *("a flash update takes 1 s", "the self-test's bit stays"),
    *("accelerometer offsets count 2", "offsets act before the filter"),
    "a pulse of 0.2 ms ends at the update",
)
"""Changes that a bring-up alone exercises; scripts/changed_chips.py runs all."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record a bring-up of a changed chip, or of a sound one for an empty name; return the file."""
    folder = tmp_path_factory.mktemp("recordings")

    @cache
    def record(name: str, seed: int):
        path = folder / f"{len(list(folder.iterdir()))}.rec"
        record_bringup(CHANGES.get(name), seed, path)
        return path

    return record


def contradicted(findings):
    return [one.name for one in findings if one.outcome is Outcome.CONTRADICTS]


@pytest.mark.parametrize("name", IN_BRINGUP)
def test_the_changed_row_is_contradicted_and_no_other(name, recorded):
    findings = judge_recordings([recorded(name, 2)], PART)
    assert contradicted(findings) == [CHANGES[name].rule]


@pytest.mark.parametrize("seed", [4, 5])
def test_no_row_is_contradicted_by_a_sound_chip(seed, recorded):
    findings = judge_recordings([recorded("", seed)], PART)
    assert not contradicted(findings)
    confirmed = [one.name for one in findings if one.outcome is Outcome.CONFIRMS]
    assert {"accel_offset_lsb", "offset_after_filter", "data_ready_edge"} <= {*confirmed}


@pytest.mark.parametrize("name", SOUND)
def test_vibration_drift_and_saved_registers_are_no_faults_of_a_chip(name, tmp_path):
    record_bringup(SOUND[name], 2, tmp_path / "run.rec")
    assert not contradicted(judge_recordings([tmp_path / "run.rec"], PART))


def test_several_files_are_judged_together_and_the_second_exercises_more_rows(recorded, tmp_path):
    record_service(CHANGES["a precise null takes 60 s"], 2, tmp_path / "service.rec")
    alone = {one.name: one for one in judge_recordings([recorded("", 4)], PART)}
    both = judge_recordings([recorded("", 4), tmp_path / "service.rec"], PART)
    assert alone["precision_time"].outcome is Outcome.NOT_MEASURED
    assert contradicted(both) == ["precision_time"]


def test_one_recording_of_truncated_autonulls_decides_the_coarse_step_and_not_the_fine(tmp_path):
    record_nulls(CHANGES["an autonull truncates to the output's LSB"], 3, tmp_path / "coarse.rec")
    record_nulls(CHANGES["an autonull truncates to its LSB"], 3, tmp_path / "fine.rec")
    coarse, fine = (
        {one.name: one for one in judge_recordings([tmp_path / f"{name}.rec"], PART)}["autonull_rounding"]
        for name in ("coarse", "fine")
    )
    assert (coarse.outcome, coarse.best) == (Outcome.CONTRADICTS, "truncated to the output's LSB")
    assert fine.outcome is Outcome.OPEN


def test_the_command_prints_80_columns_and_names_rows_that_are_not_exercised(recorded, capsys):
    path = recorded("accelerometer offsets count 2", 2)
    assert main(["bringup", "--from", str(path)]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    first = text.splitlines()[1]
    assert first.split()[:3] == ["accel_offset_lsb", "1", "2"]
    assert first.endswith("contradicts")
    assert "not exercised: " in text
    assert "autonull_rounding" in text.partition("not exercised: ")[2]


def test_the_json_has_every_row_with_its_probabilities(recorded, capsys):
    assert main(["bringup", "--from", str(recorded("", 4)), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["name"] for row in rows] == [row.question.name for row in ROWS]
    for row in rows:
        assert sum(row["probabilities"].values()) == pytest.approx(1)
        assert ELSE in row["probabilities"]


@pytest.mark.parametrize("other", ["sim:?seed=1", "--flash", "--yes"])
def test_from_excludes_all_that_concerns_a_board(recorded, capsys, other):
    assert main(["bringup", other, "--from", str(recorded("", 4))]) == 2
    assert "--from" in capsys.readouterr().err


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
