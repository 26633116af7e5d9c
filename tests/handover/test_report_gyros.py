"""The report's section on the gyros: parameters with u and U, residuals; nothing where there are none."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from adis_gonio import fit
from adis_gonio.base.numbers import format_uncertain
from adis_gonio.fitting.gyros.gyro_fit import fit_gyro
from adis_gonio.handover.calibration_report import build_page
from adis_gonio.handover.gyro_report import gyro_section, gyro_table
from adis_gonio.record.loading import load_session
from recordings import recording


@pytest.fixture(scope="module")
def session():
    return load_session(recording("adis16350_14_poses"))


@pytest.fixture(scope="module")
def section(session):
    return gyro_section(session)


def test_the_gyros_stand_beside_each_other_and_what_is_not_known_is_a_dash(session, section):
    result = fit_gyro(session)
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    told = [
        format_uncertain(result[f"gyro_bias_{axis}"].value, result[f"gyro_bias_{axis}"].U) for axis in "xyz"
    ]
    assert rows["zero rate / (°/s)"] == told
    along_z = result["g_sensitivity_yz"]
    assert rows["force along Z adds / (°/s/g)"][1] == format_uncertain(along_z.value, along_z.U)
    assert "gain" not in rows  # no turns


def test_the_columns_of_numbers_are_aligned_as_numbers(section):
    (table,) = section.tables
    number = re.compile(r"[−\d]")
    columns = list(zip(*table.rows, strict=True))
    assert {k for k, cells in enumerate(columns) if any(map(number.match, cells))} == set(table.numeric)


def test_one_gain_of_three_is_told_apart_from_those_that_are_not_known(session, monkeypatch):
    result = fit_gyro(session)
    value = result["gyro_bias_z"]
    one = replace(result, parameters={**result.parameters, "gyro_scale_z": value})
    (gains,) = [row for row in gyro_table(one).rows if row[0] == "gain"]
    assert gains[1:] == ["–", "–", format_uncertain(value.value, value.U)]


def test_what_is_not_determined_is_said(section):
    assert any("gyro_scale" in point and "gyro-turns" in point for point in section.points)


def test_the_residuals_are_drawn_for_each_gyro_and_the_same_each_time(session, section):
    (figure,) = section.figures
    for axis in "XYZ":
        assert f"gyro {axis}" in figure.svg
    assert "turns between them" not in figure.svg
    assert gyro_section(session).figures[0].svg == figure.svg


def test_the_page_has_the_section_once_and_without_gyros_nothing_of_them(session, section):
    fits = [fit(session)]
    page = build_page(session, fits, "left out here", sections=[section])
    assert page.count(">Gyros<") == 1
    bare = replace(session, dwells=tuple(replace(dwell, gyro=None) for dwell in session.dwells))
    assert gyro_section(bare) is None
    plain = build_page(bare, [fit(bare)], "left out here")
    assert "yro" not in plain
