"""Offset words take the bias away: on the simulated chip, which adds what its registers hold."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import open_sensor
from adis_gonio.base.errors import DataError, FitError
from adis_gonio.faces.cli import main
from adis_gonio.handover.register_offsets import offset_words, offset_words_in, registers_text
from handover.calibrations import PLANE, calibration
from handover.gyros import ZERO, with_gyros

LSB = 0.4672


def test_the_sign_is_against_the_bias_and_rounding_leaves_half_an_lsb():
    words = offset_words(calibration(PLANE))
    assert [(word.name, word.number) for word in words] == [("XACCL_OFF", -26), ("YACCL_OFF", 60)]
    for word in words:
        assert word.remainder == pytest.approx(word.bias + word.number * LSB)
        assert abs(word.remainder) <= LSB / 2


def test_offsets_that_stood_already_are_kept_in_the_sum():
    own = calibration(PLANE)
    held = replace(own, provenance=replace(own.provenance, offsets_lsb=(5, -7, 0)))
    assert [word.number for word in offset_words(held)] == [-26 + 5, 60 - 7]
    assert "5 before" in registers_text(held)
    assert "does not state the contents of these registers" in registers_text(own)


def test_the_lines_are_what_the_registers_command_takes_and_the_bias_is_gone(capsys):
    with open_sensor("sim:?seed=4") as sensor:
        before = sensor.read_scans(400).accel_mg.mean(axis=0)
        numbers = dict(re.findall(r"^(\w+)=(-?\d+)$", registers_text(calibration(PLANE)), re.MULTILINE))
        for name, number in numbers.items():
            sensor.write(name, int(number))
        after = sensor.read_scans(400).accel_mg.mean(axis=0)
    assert np.abs(after[:2] - before[:2] - [-26 * LSB, 60 * LSB]).max() < 1.0
    words = [line for line in registers_text(calibration(PLANE)).splitlines() if not line.startswith("#")]
    assert main(["registers", "sim:?seed=1", *words]) == 0
    assert "−26" in capsys.readouterr().out


def test_an_uncertainty_keeps_its_second_digit():
    word = replace(offset_words(calibration(PLANE))[0], u=0.1004)
    assert str(word).endswith("(u 0.10)")


def test_a_file_that_is_neither_calibration_nor_session_is_refused(tmp_path):
    path = tmp_path / "letter.txt"
    path.write_text("Dear sir")
    with pytest.raises(DataError, match=r"letter\.txt"):
        offset_words_in(path)


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (calibration(PLANE, sensor="generic"), "belong to an ADIS16350"),
        (calibration({**PLANE, "bias_x": 970.0}), "XACCL_OFF holds -2048 to 2047"),
    ],
)
def test_a_calibration_that_gives_no_offsets_is_refused_with_the_reason(made, reason, tmp_path):
    made.save(tmp_path / "own.json")
    with pytest.raises(FitError, match=reason):
        offset_words_in(tmp_path / "own.json")


@pytest.mark.parametrize(
    ("bias_mg", "rate_dps", "given", "reason"),
    [
        (970.0, 1.21, "GYRO_OFF", "not compared: XACCL_OFF holds -2048 to 2047"),
        (12.0, 90.0, "ACCL_OFF", "not compared: XGYRO_OFF holds -4096 to 4095"),
    ],
)
def test_registers_say_why_a_part_of_the_calibration_gives_no_offsets(
    bias_mg, rate_dps, given, reason, tmp_path, capsys
):
    path = str(tmp_path / "both.json")
    own = calibration({**PLANE, "bias_x": bias_mg})
    with_gyros(own, {**ZERO, "gyro_bias_x": rate_dps}).save(path)
    assert main(["registers", "sim:?seed=1", f"Y{given}", "--cal", path]) == 0
    shown = capsys.readouterr()
    assert "(u " in shown.out
    assert reason in shown.err


def test_what_has_no_offset_registers_or_no_bias_is_refused():
    with pytest.raises(FitError, match="belong to an ADIS16350"):
        offset_words(calibration(PLANE, sensor="generic"))
    without = replace(calibration(PLANE), parameters=calibration(PLANE).parameters[:-1])
    with pytest.raises(FitError, match="does not determine bias_y"):
        offset_words(without)
    with pytest.raises(FitError, match="XACCL_OFF holds -2048 to 2047"):
        offset_words(calibration({**PLANE, "bias_x": 970.0}))
