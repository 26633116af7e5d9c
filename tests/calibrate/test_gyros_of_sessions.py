"""A session's own fit (or trace) of its gyros stands in every calibration that is made of it."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import adis_gonio
from adis_gonio import Calibration
from adis_gonio.base.errors import DataError, FitError
from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
from adis_gonio.calibrate import GyroCalibration
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.cli import main
from adis_gonio.fitting.gyros.gyro_fit import gains_and_directions
from adis_gonio.handover.register_offsets import offset_words_in
from adis_gonio.handover.session_export import ExportSource
from adis_gonio.record.loading import load_session
from adis_gonio.record.provenance import provenance_of
from adis_gonio.record.samples_writer import write_samples_csv
from adis_gonio.tracing import trace_calibrations
from adis_gonio.tracing.trace_calibrations import gyro_calibration_of, load_gyro_calibration, with_gyros
from bench.writeback.gyro_rig import FAULTS, gyro_numbers
from bench.writeback.rig import new_bus, record
from recordings import recording


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return record(tmp_path_factory.mktemp("gyros") / "poses.session", new_bus(3, **FAULTS), "poses")


@pytest.fixture(scope="module")
def fitted(path):
    return adis_gonio.fit(path, part="gyro")


@pytest.fixture(scope="module")
def traced(path):
    return adis_gonio.trace(path, part="gyro")


@pytest.fixture(scope="module")
def bare(path, tmp_path_factory):
    """The same session as a file without the gyros' columns."""
    session = load_session(path)
    own = replace(session, dwells=tuple(replace(dwell, gyro=None) for dwell in session.dwells))
    csv = tmp_path_factory.mktemp("bare") / "bare.csv"
    write_samples_csv(own, csv)
    return csv


def test_the_design_of_the_held_out_data_has_the_unit_of_gyros(traced):
    kept = traced.after.heldout_kept
    assert f"{kept:.3g} °/s with those found kept" in traced.heldout_design


def test_a_session_s_calibration_holds_its_gyros_as_they_were_fitted(path, fitted):
    made = Calibration.load(path).gyro
    assert [one.name for one in made.parameters][:3] == ["gyro_bias_x", "gyro_bias_y", "gyro_bias_z"]
    for name, value in fitted.parameters.items():
        assert made[name].value == value.value
        assert made[name].u == pytest.approx(value.u, rel=1e-9)
    order = [list(fitted.parameters).index(one.name) for one in made.parameters]
    assert made.covariance == pytest.approx(fitted.covariance[np.ix_(order, order)], rel=1e-9)
    assert made.offsets_lsb == (0, 0, 0)
    assert GyroCalibration.load(path) == made
    alone = fitted.calibration()
    assert alone == made


def test_the_session_s_gyros_find_the_part_s_faults(path):
    made = GyroCalibration.load(path)
    off = made.bias_dps - [FAULTS[f"gyro_bias_{axis}_dps"] for axis in "xyz"]
    assert np.abs(off).max() < 0.1  # supply and 1/f noise of that hour beside the noise
    assert made.g_sensitivity_dps_per_g[1, 0] == pytest.approx(0.24, abs=0.03)
    assert np.diag(made.g_sensitivity_dps_per_g) == pytest.approx([0.05] * 3, abs=0.03)
    assert "gyro_scale_x" in made.assumed
    level = made.correct(made.bias_dps, [0.0, 0.0, 0.0])
    assert level == pytest.approx(np.zeros(3), abs=1e-12)


def test_a_session_without_gyros_gives_a_calibration_without(bare, tmp_path):
    session = load_session(bare)
    made = adis_gonio.fit(session).calibration()
    assert with_gyros(made, session) is made
    assert Calibration.load(bare).gyro is None
    with pytest.raises(DataError, match="gyros"):
        gyro_calibration_of(session)
    for name in ("bare.json", "bare.h", "bare.txt", "bare.xml"):
        assert main(["export", str(bare), "-o", str(tmp_path / name)]) == 0
        text = (tmp_path / name).read_text("utf-8").replace("gyro_unit", "")
        assert "gyro_bias" not in text
        assert "XGYRO" not in text
        assert "rates_" not in text


def test_every_export_of_a_session_with_gyros_has_them(path, tmp_path):
    pieces = {"a.json": '"gyro"', "a.h": "_rates_udps", "a.txt": "XGYRO_OFF=", "a.xml": "gyro_bias_x"}
    for name, piece in pieces.items():
        assert main(["export", str(path), "-o", str(tmp_path / name)]) == 0
        assert piece in (tmp_path / name).read_text("utf-8")
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["gyro"]["parameters"]["gyro_bias_x"]["unit"] == "dps"


def test_a_trace_of_the_gyros_is_a_calibration_too(traced, fitted):
    made = traced.calibration()
    assert isinstance(made, GyroCalibration)
    assert (made.method, made.offsets_lsb) == ("trace", (0, 0, 0))
    assert made.temperature_c == fitted.calibration().temperature_c
    names = {one.effect for one in traced.found}
    assert "g_sensitivity" in names
    assert ("g_sensitivity_yx" in made) == ("g_sensitivity" in names)
    for name in ("gyro_bias_x", "gyro_bias_y", "g_sensitivity_yx"):
        limit = 5 * np.hypot(made[name].u, fitted[name].u)
        assert abs(made[name].value - fitted[name].value) < limit
    assert not [one for one in made.not_corrected if one.effect == "g_sensitivity"]


def test_the_gyros_of_another_session_are_traced_where_the_trace_is_exported(path, traced, monkeypatch):
    monkeypatch.setattr(sys.modules["adis_gonio.tracing.trace"], "trace", lambda session, part: traced)
    assert load_gyro_calibration(path, traced=True) == traced.calibration()
    assert load_gyro_calibration(path).method == "gyro"
    source = ExportSource(path, traced=True, gyros=path)
    assert source._with_gyros(adis_gonio.fit(path).calibration()).gyro.method == "trace"


def test_registers_compare_a_session_s_offsets_after_one_fit_of_its_gyros(path, fitted, monkeypatch):
    fits = []
    monkeypatch.setattr(trace_calibrations, "fit_gyro", lambda session: fits.append(session) or fitted)
    words, refused = offset_words_in(path)
    assert not refused
    assert len(fits) == 1
    assert [word.bias for word in words[3:]] == list(fitted.calibration().bias_dps)


def test_the_calibration_of_a_fit_or_trace_holds_with_the_offsets_written_since(path, traced, tmp_path):
    copy = Path(shutil.copy(path, tmp_path / "written.session"))
    bus = new_bus(3, **FAULTS)
    writer = OffsetWriter(Adis16354(bus, bus.world.variant), copy, WriteSettings(gyros=True, dwell_s=2.0))
    writer.plan()
    writer.write()
    held, since = gyro_numbers(bus), provenance_of(load_session(copy))
    for result in (adis_gonio.fit(copy, part="gyro"), replace(traced, provenance=since)):
        made = result.calibration()
        assert made.offsets_lsb == held != (0, 0, 0)
        assert np.abs(made.bias_dps).max() < 0.1  # the chip corrects it; before it was more than 1 °/s


def test_a_trace_that_did_not_end_or_of_no_gyros_gives_no_calibration(path, bare):
    traced = adis_gonio.trace(path, part="gyro", time_limit=1e-3)
    with pytest.raises(FitError, match="time limit"):
        traced.calibration()
    with pytest.raises(DataError, match="gyros"):
        adis_gonio.trace(bare, part="gyro")


def test_what_effects_add_becomes_the_gain_and_direction_of_the_same_gyro():
    rng = np.random.default_rng(3)
    names = ["gyro_scale_error_x", "gyro_misalignment_xy", "gyro_misalignment_xz"]
    for _ in range(20):
        values = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-8, 8), rng.uniform(-8, 8)])
        sines = np.sin(np.radians(values[1:]))
        row = np.array([np.sqrt(1 - sines @ sines) + values[0], *sines])
        gain, *leans = gains_and_directions(names, values)
        direction = np.sin(np.radians(leans))
        again = gain * np.array([np.sqrt(1 - direction @ direction), *direction])
        assert again == pytest.approx(row, abs=1e-12)


def test_turns_that_tell_nothing_for_one_reason_are_one_line(fitted):
    (told,) = [one for one in fitted.warnings if "turns to dwell" in one]
    assert "to dwell 1–13: " in told
    assert "nothing was recorded" in told


def test_a_residual_beyond_the_noise_is_a_doubt():
    result = adis_gonio.fit(recording("adis16350_14_poses"), part="gyro")
    assert any("larger than their noise" in doubt for doubt in result.doubts_of_offsets)
    assert any("gyro-turns" in remark for remark in result.warnings)
