"""Recordings of changed chips name the changed row of the register table, and no row of a sound chip."""

from __future__ import annotations

import json
from functools import cache

import pytest

from adis_gonio.bench.bringup import Outcome
from adis_gonio.bench.bringup.chip_rows import (
    ELSE,
    ROWS,
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
