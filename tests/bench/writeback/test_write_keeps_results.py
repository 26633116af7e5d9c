"""A write changes the sensor and the coefficients, never the result of the recorded session."""

import io
import json
import sqlite3
from contextlib import closing, redirect_stdout

import numpy as np
import pytest

from adis_gonio import Adis16354, load_session, open_bus
from adis_gonio.base.errors import DataError, FitError
from adis_gonio.bench.gyro_turns import gyro_turns_plan
from adis_gonio.bench.writeback import (
    OffsetWriter,
    WriteSettings,
)
from adis_gonio.device.sensor.registers import GYRO_OFF
from adis_gonio.faces.cli import main
from adis_gonio.record.write_journal import operations, operations_of
from adis_gonio.tracing.trace_calibrations import gyro_calibration_of, load_calibration
from bench.writeback.rig import OFFSETS, flash, new_bus, record

URL = "sim:?seed=1"
PLANS = ("two-position", "four-position", "poses", "free-turn", "gyro-turns")
"""One of each kind: without a bias, in a plane, in space, on a turn, and turns for the gyros."""
QUICK = ("--auto", "--dwell", "2")
SHORT = {"gyro-turns": ("--turns", "1")}
PARTS = ("accelerometer", "gyro")
COMMANDS = {plan: ("fit", "trace") if plan == "four-position" else ("fit",) for plan in PLANS}
"""A trace starts from the readings and the model of the fit, so one plan is enough to compare traces."""
NOTHING_TO_WRITE = {("two-position", "accelerometer"), ("free-turn", "gyro")}
"""Two positions show no bias, and a free turn has no gyro at rest."""


@pytest.fixture(scope="module", params=PLANS)
def recorded(request, tmp_path_factory):
    """Return a plan's name, the bytes of a session of it, and its results."""
    path = tmp_path_factory.mktemp("plans") / f"{request.param}.session"
    words = ["--plan", request.param, *QUICK, *SHORT.get(request.param, ())]
    assert main(["calibrate", URL, *words, "-o", str(path)]) == 0
    return request.param, path.read_bytes(), results(path, COMMANDS[request.param])


def document(*arguments: str) -> dict | int:
    """Return the JSON of a command without its warnings, or its exit status if it fails."""
    with redirect_stdout(io.StringIO()) as shown:
        status = main([*arguments, "--json"])
    if status != 0:
        return status
    read = json.loads(shown.getvalue())
    read.pop("warnings", None)  # a write is remarked on
    return read


def results(path, commands: tuple[str, ...] = ("fit", "trace")) -> list[dict | int]:
    """Return the documents of commands of both parts."""
    return [document(command, str(path), "--sensor-part", part) for command in commands for part in PARTS]


def calibrations(path):
    """Return the calibrations of accelerometers and gyros that an export states now; None without one."""
    try:
        accelerometers = load_calibration(path)
    except FitError:
        accelerometers = None
    try:
        gyros = gyro_calibration_of(load_session(path))
    except (DataError, FitError):
        gyros = None
    return accelerometers, gyros


def values_of(calibration, prefix: str) -> dict[str, float]:
    return {one.name: one.value for one in calibration.parameters if one.name.startswith(prefix)}


def test_fit_and_trace_of_both_parts_stay_and_coefficients_move_by_what_was_written(recorded, tmp_path):
    plan, held, before = recorded
    path = tmp_path / "q.session"
    path.write_bytes(held)
    accel, gyro = calibrations(path)
    for part in PARTS:
        command = ["write", str(path), URL, "--yes", "--even-if-inadequate"]
        status = main([*command, "--gyros"] if part == "gyro" else command)
        assert status == ((plan, part) in NOTHING_TO_WRITE)
    assert results(path, COMMANDS[plan]) == before
    session = load_session(path)
    held = dict.fromkeys((*OFFSETS, *GYRO_OFF), 0)  # while it was recorded
    for one in operations(session.facts["offset_writes"]):
        held |= one.target
    moved_mg = 0.4672 * np.array([held[name] for name in OFFSETS])
    moved_dps = 0.018315 * np.array([held[name] for name in GYRO_OFF])
    for part, moved in zip(PARTS, (moved_mg, moved_dps), strict=True):
        assert np.any(moved) == ((plan, part) not in NOTHING_TO_WRITE)
    accel_now, gyro_now = calibrations(path)
    if accel is not None:
        was, now = values_of(accel, "bias_"), values_of(accel_now, "bias_")
        for axis, by in zip("xyz", moved_mg, strict=True):
            if f"bias_{axis}" in was:
                assert now[f"bias_{axis}"] - was[f"bias_{axis}"] == pytest.approx(by, abs=1e-9)
        # One attitude: the part reads more by the offsets, and the angle is the same.
        attitude = np.array([612.3, -789.1, 24.0])[: accel.axes]
        plane = None if accel.planar else "xy"
        then = accel.angle(attitude, plane=plane).angle_deg
        assert accel_now.angle(attitude + moved_mg[: accel.axes], plane=plane).angle_deg == pytest.approx(
            then, abs=1e-9
        )
    if gyro is not None:
        # The gyros feel the force that the accelerometers read, which the chip moves too.
        by_force = gyro.g_sensitivity_dps_per_g @ (moved_mg / 1000)
        difference = np.array(list(values_of(gyro_now, "gyro_bias_").values())) - np.array(
            list(values_of(gyro, "gyro_bias_").values())
        )
        np.testing.assert_allclose(difference, moved_dps - by_force, atol=1e-9)


def test_an_interrupted_write_keeps_the_results(tmp_path):
    path, cut = tmp_path / "q.session", tmp_path / "cut.session"
    assert main(["calibrate", URL, "--plan", "four-position", *QUICK, "-o", str(path)]) == 0
    before = results(path)

    def power_cut(text: str) -> None:
        """Copy the session as it is in the middle of the write."""
        if "written and read back" in text:
            with closing(sqlite3.connect(path)) as now, closing(sqlite3.connect(cut)) as copy:
                now.backup(copy)

    with open_bus(URL) as bus:
        made = OffsetWriter(
            Adis16354(bus, bus.world.variant), path, WriteSettings(dwell_s=1.0), tell=power_cut
        )
        made.plan()
        made.write()
    assert operations_of(load_session(cut))[-1].open
    assert results(cut) == before


def test_accelerometers_calibrated_before_a_write_serve_a_session_recorded_after_it(tmp_path):
    first = record(tmp_path / "first.session", new_bus(1), "poses")
    exported = tmp_path / "before.json"
    load_calibration(first).save(exported)
    bus = new_bus(1)
    made = OffsetWriter(Adis16354(bus), first, WriteSettings(save=True, dwell_s=1.0))
    made.plan()
    made.write()
    assert any(flash(bus))
    later = new_bus(1, flash=dict(zip(OFFSETS, flash(bus), strict=True)))
    second = record(tmp_path / "second.session", later, gyro_turns_plan(1))
    assert any(load_session(second).facts["registers"]["configured"][name] for name in OFFSETS)
    by_old, by_new = (
        document("fit", str(second), "--sensor-part", "gyro", "--calibration", str(path))
        for path in (exported, first)
    )
    assert by_old == by_new


def test_offsets_count_also_on_axes_whose_bias_the_session_does_not_determine(tmp_path):
    path = tmp_path / "two.session"
    assert main(["calibrate", URL, "--plan", "two-position", *QUICK, "-o", str(path)]) == 0
    before = load_calibration(path)
    assert "bias_x" in before.assumed
    offsets = np.array([40, -25, 0])
    after = before.with_offsets(offsets.tolist())
    readings_mg = np.array([[700.0, -690.0], [10.0, 1005.0]])
    added_mg = offsets[:2] * 0.4672
    ours, theirs = after.angle(readings_mg + added_mg), before.angle(readings_mg)
    assert ours.angle_deg == pytest.approx(theirs.angle_deg, abs=1e-9)
    assert ours.u_deg == pytest.approx(theirs.u_deg, rel=1e-3)
    assert load_calibration(path).as_dict() == before.as_dict()


def test_an_export_names_offsets_that_a_later_write_did_not_save(tmp_path, capsys):
    path = tmp_path / "q.session"
    assert main(["calibrate", URL, "--plan", "four-position", *QUICK, "-o", str(path)]) == 0
    capsys.readouterr()
    assert main(["export", str(path), "-o", str(tmp_path / "before.h")]) == 0
    assert "XACCL_OFF" not in capsys.readouterr().err
    assert main(["write", str(path), URL, "--yes", "--even-if-inadequate"]) == 0
    capsys.readouterr()
    assert main(["export", str(path), "-o", str(tmp_path / "after.h")]) == 0
    remark = capsys.readouterr().err
    assert "XACCL_OFF 0 →" in remark
    assert "not saved to flash" in remark
