"""Files without gyros at rest in them are taken, and said to look like it; sound ones are not accused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import adis_gonio
from adis_gonio import fit
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import format_ranges, format_uncertain, format_unit
from adis_gonio.faces.cli import main
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.samples_writer import write_samples_csv
from adis_gonio.tracing import trace_summary as words
from adis_gonio.tracing.trace_result import ErrorFigures, Step, TraceResult


def session(zero=(0.4, -1.1, 0.2), noise=0.6, rows=60, unit="dps"):
    rng = np.random.default_rng(5)
    dwells = []
    for k in range(4):
        accel = np.array([1000 * np.cos(k * np.pi / 2), -1000 * np.sin(k * np.pi / 2), 0.0])
        time = 100.0 * k + 0.01 * np.arange(rows)
        gyro = np.array(zero) + noise * rng.standard_normal((rows, 3))
        own = accel + 2 * rng.standard_normal((rows, 3))
        dwells.append(Dwell(k, time, own, 90.0 * k, gyro=gyro))
    return Session(tuple(dwells), sensor="adis16354", accel_unit="mg", gyro_unit=unit)


@pytest.mark.parametrize(
    ("own", "told"),
    [
        (session(zero=(0.4, -1.1, 400.0)), ["gyro_bias_z is 400"]),
        (session(unit="radps"), ["gyro_bias_x is", "gyro_bias_y is -6", "gyro_bias_z is"]),
        (session(zero=(0.0, 0.0, 0.0), noise=0.0), [f"gyro {a} reads 0 in every sample" for a in "xyz"]),
    ],
)
def test_what_no_gyro_at_rest_reads_is_said_and_nothing_is_written_by_it(own, told):
    result = fit(own, part="gyro")
    assert len(result.doubts) == len(told)
    for line, piece in zip(result.doubts, told, strict=True):
        assert piece in line
    assert set(result.doubts) <= set(result.warnings)
    assert set(result.doubts) <= set(result.doubts_of_offsets)


def test_sound_gyros_are_not_accused():
    assert fit(session(), part="gyro").doubts == ()
    assert (
        fit(session(zero=np.radians([0.4, -1.1, 0.2]), noise=0.01, unit="radps"), part="gyro").doubts == ()
    )


def test_one_sample_a_dwell_is_refused_for_what_it_is():
    with pytest.raises(DataError, match="one sample of the gyros each"):
        fit(session(rows=1), part="gyro")


def test_averages_repeated_in_a_dwell_are_refused_unless_the_part_has_a_figure():
    own = session()
    means = [replace(one, gyro=np.tile(one.gyro.mean(axis=0), (len(one), 1))) for one in own.dwells]
    averaged = replace(own, dwells=tuple(means))
    assert fit(averaged, part="gyro").chi2 < 100
    with pytest.raises(DataError, match="gyro x is constant within each dwell and differs between"):
        fit(replace(averaged, sensor="generic"), part="gyro")


def test_numbers_in_a_row_are_told_as_such():
    assert format_ranges([1, 2, 3, 4, 7, 9, 10]) == "1–4, 7, 9, 10"
    assert format_ranges([3]) == "3"
    assert format_ranges([]) == ""


def test_people_read_degrees_a_second_and_documents_dps():
    assert format_unit("dps/g") == "°/s/g"
    assert format_uncertain(1.25, 0.02, "dps").replace("\u00a0", " ") == "1.250 ± 0.020 °/s"
    result = fit(session(), part="gyro")
    assert "°/s" in repr(result)
    assert "dps" not in repr(result)
    assert not [line for line in result.warnings if "dps" in line]
    assert result.as_dict()["parameters"]["gyro_bias_x"]["unit"] == "dps"


def test_a_trace_of_the_gyros_is_told_in_degrees_a_second():
    axes = {"x": 0.11, "y": 0.07, "z": 0.12}
    before = ErrorFigures(0.122, 0.0968, None, 12.6, axes, unit="dps")
    after = ErrorFigures(0.025, 0.0526, None, 0.93, axes, 0.05, unit="dps")
    traced = TraceResult(True, (), (Step("gyro_scale", after),), before, after)
    head, _ = words.error_rows(traced)
    told = " ".join([words.gains(traced), *head])
    assert "from 0.122 to 0.0250 °/s" in told
    assert "x / (°/s)" in head
    assert "dps" not in told
    assert after.as_dict()["residual_rms_dps"] == 0.025


@pytest.mark.parametrize("option", [["--all"], ["--monte-carlo", "200"]])
def test_options_of_the_accelerometers_are_refused_for_gyros(tmp_path, option, capsys):
    path = tmp_path / "own.csv"
    write_samples_csv(session(), path)
    assert main(["fit", str(path), "--sensor-part", "gyro", *option]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert said == f"adis-gonio: {option[0]}: not with --sensor-part gyro"


def test_gyros_out_of_a_header_are_refused_for_what_it_is(tmp_path):
    (tmp_path / "own.h").write_text("/* a header */")
    with pytest.raises(DataError, match="made for others to read"):
        adis_gonio.GyroCalibration.load(tmp_path / "own.h")


def test_the_screen_of_a_fit_says_degrees_a_second_in_eighty_columns_and_json_dps(tmp_path, capsys):
    path = tmp_path / "own.csv"
    write_samples_csv(session(), path)
    assert main(["fit", str(path), "--sensor-part", "gyro"]) == 0
    screen = capsys.readouterr().out
    table = [
        line.rstrip() for line in screen.splitlines() if line.startswith(("gyro_", "parameter", "zero"))
    ]
    assert max(map(len, table)) <= 80
    assert "°/s" in screen
    assert "dps" not in screen
    assert main(["fit", str(path), "--sensor-part", "gyro", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["parameters"]["g_sensitivity_xx"]["unit"] == "dps/g"
