"""Turns in a samples CSV: rows without a position, and the declared angle of each turn."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import DataError
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.faces.api import fit
from adis_gonio.faces.cli import main
from adis_gonio.fitting.gyros.gyro_fit import LIMIT
from adis_gonio.fitting.gyros.turn_integration import Path as Samples, Sampling, integrate
from adis_gonio.record.loading import load_session
from recordings import recording

PERIOD_S = 0.01
GAIN = np.array([1.013, 0.991, 1.022])
ZERO_DPS = np.array([0.4, -0.2, 0.1])
ANGLES_DEG = (90.0, -90.0, 450.0, -450.0)
HEADER = "time_s,position,turned_deg,ax,ay,az,gx,gy,gz"


def table_turns(angles_deg: tuple[float, ...] = ANGLES_DEG, *, seed: int = 1) -> list[str]:
    """Rows of a part that lies with each axis up in turn on a level table, and is turned at marks.

    The rate of a turn is a cosine bell, so its integral is exact; at most 150 °/s.
    """
    rng = np.random.default_rng(seed)
    rows: list[str] = []
    time, position = 0.0, 0

    def add(count: int, where: str, turned: str, up: np.ndarray, rate: np.ndarray) -> None:
        nonlocal time
        reading = -1000.0 * up + rng.normal(0, 2.0, (count, 3))
        gyro = GAIN * rate[:, None] * up + ZERO_DPS + rng.normal(0, 0.05, (count, 3))
        for accel, own in zip(reading, gyro, strict=True):
            cells = [f"{time:.2f}", where, turned, *(f"{v:.3f}" for v in accel), *(f"{v:.4f}" for v in own)]
            rows.append(",".join(cells))
            time += PERIOD_S

    for axis in range(3):
        up = np.eye(3)[axis]
        add(400, str(position), "", up, np.zeros(400))
        for angle in angles_deg:
            count = round(2 * abs(angle) / 150.0 / PERIOD_S) + 100
            bell = 1 - np.cos(2 * math.pi * np.arange(count) / count)
            moving = angle / (PERIOD_S * bell.sum()) * bell
            add(count + 200, "", "", up, np.concatenate([np.zeros(100), moving, np.zeros(100)]))
            position += 1
            add(400, str(position), f"{angle:g}", up, np.zeros(400))
        position += 1
        # The part is laid on its next face by hand: nothing is recorded.
        time += 20.0
    for face in range(3):
        add(400, str(position), "", -np.eye(3)[face], np.zeros(400))
        position += 1
        time += 20.0
    return rows


def write(path: Path, rows: list[str], *, header: str = HEADER) -> Path:
    keys = ["# sensor: generic", "# accel_unit: mg", "# plane: none", "# fixture_sigma_deg: 0.1"]
    path.write_text("\n".join([*keys, header, *rows, ""]))
    return path


def test_gains_follow_from_declared_angles_that_are_no_whole_turns(tmp_path: Path) -> None:
    result = fit(write(tmp_path / "marks.csv", table_turns()), part="gyro")
    assert result.turns == 12
    for axis, true in zip("xyz", GAIN, strict=True):
        gain = result[f"gyro_scale_{axis}"]
        assert gain.u is not None
        assert gain.u < 1e-3
        assert gain.value == pytest.approx(true, abs=3 * gain.u)
    assert isinstance(result.calibration(), GyroCalibration)


@pytest.mark.parametrize(("factor", "told"), [(2.0, "2.00"), (-1.0, "−1.00")])
def test_whole_turns_do_not_hide_a_wrong_range_or_sign(tmp_path: Path, factor: float, told: str) -> None:
    rows = []
    for row in table_turns((360.0, -360.0), seed=4):
        cells = row.split(",")
        rows.append(",".join([*cells[:6], *(f"{factor * float(cell):.4f}" for cell in cells[6:])]))
    result = fit(write(tmp_path / "range.csv", rows), part="gyro")
    (line,) = [text for text in result.warnings if "in all 6 declared turns" in text]
    assert f"turned {told} times turned_deg" in line


def test_one_miscounted_turn_is_no_sign_of_a_wrong_range(tmp_path: Path) -> None:
    rows = table_turns((360.0, -360.0), seed=5)
    changed = [row.replace(",360,", ",720,") if row.split(",")[1] == "1" else row for row in rows]
    assert changed != rows
    result = fit(write(tmp_path / "one.csv", changed), part="gyro")
    assert result.turns == 6
    assert not any("declared turns" in text for text in result.warnings)


def test_a_wrongly_declared_angle_is_refused_and_named(tmp_path: Path) -> None:
    rows = [
        row.replace(",450,", ",400,") if row.split(",")[1] == "3" else row for row in table_turns(seed=2)
    ]
    result = fit(write(tmp_path / "wrong.csv", rows), part="gyro")
    assert result.turns == 11
    (line,) = [text for text in result.warnings if "400°" in text]
    assert "turn to dwell 3" in line
    assert "correct turned_deg" in line


def test_swapped_axes_of_the_gyros_are_named_in_the_turns_about_them(tmp_path: Path) -> None:
    path = write(tmp_path / "swapped.csv", table_turns(), header=HEADER.replace("gx,gy", "gy,gx"))
    result = fit(path, part="gyro")
    assert result.turns == 4
    assert any("correct the order of the gyros' axes" in text for text in result.warnings)


def test_without_declared_angles_the_advice_names_the_column(tmp_path: Path) -> None:
    rows = [",".join([*row.split(",")[:2], "", *row.split(",")[3:]]) for row in table_turns(seed=3)]
    result = fit(write(tmp_path / "silent.csv", rows), part="gyro")
    assert result.turns == 0
    assert any("declare it (turned_deg)" in text for text in result.warnings)


def test_an_exported_session_of_whole_turns_gives_the_same_gyros(tmp_path: Path) -> None:
    session, samples = tmp_path / "table.session", tmp_path / "table.csv.gz"
    options = [
        "--plan",
        "gyro-turns",
        "--turns",
        "1",
        "--positions",
        "3",
        "--dwell",
        "1.5",
        "--settle",
        "0.1",
    ]
    assert main(["calibrate", "sim:?seed=3&hand_moves=1", *options, "--auto", "-o", str(session)]) == 0
    assert main(["export", str(session), "-o", str(samples)]) == 0
    ours, theirs = fit(session, part="gyro"), fit(samples, part="gyro")
    assert ours.turns == theirs.turns == 6
    assert list(ours.parameters) == list(theirs.parameters)
    for name, value in ours.parameters.items():
        # The CSV has no filter setting, so its turns begin later by the filter's delay.
        assert theirs[name].value == pytest.approx(value.value, abs=0.2 * (value.u or 0.0)), name


def test_gyros_without_accelerometers_are_refused_in_one_line(tmp_path: Path) -> None:
    rows = [",".join(row.split(",")[:3] + row.split(",")[6:]) for row in table_turns()[:50]]
    path = write(tmp_path / "rates.csv", rows, header="time_s,position,turned_deg,gx,gy,gz")
    with pytest.raises(DataError, match=r"row 5: gyros without accelerometers: .* needs ax, ay and az"):
        load_session(path)


def test_rows_of_a_dwell_may_not_enclose_a_way(tmp_path: Path) -> None:
    rows = ["0,1,,0,0,-1000,0,0,0", "1,,,0,0,-1000,0,0,0", "2,1,,0,0,-1000,0,0,0"]
    with pytest.raises(DataError, match="row 8: position 1 occurs again"):
        load_session(write(tmp_path / "split.csv", rows))


def test_what_a_turn_does_not_determine_is_no_result() -> None:
    result = fit(recording("mimu4444_exp6_imu1"), part="gyro")
    # Gravity shows an angle and not the direction of its axis, so directions stay open.
    assert {"gyro_misalignment_zx", "gyro_misalignment_zy", "gyro_scale_x"} <= set(result.undetermined)
    for name, value in result.parameters.items():
        limit = math.degrees(LIMIT) if "misalignment" in name else LIMIT
        assert name.startswith("gyro_bias") or (value.u or 0.0) < limit, name
    assert result["gyro_scale_y"].u < 0.01


@pytest.mark.parametrize("number", [4, 6, 7, 8, 9])
def test_sessions_of_one_gyro_agree_about_its_g_sensitivity(number: int) -> None:
    result = fit(recording(f"mimu4444_exp{number}_imu1"), part="gyro")
    found = result["g_sensitivity_xy"]
    # Without a drift: 0.012, 0.073, 0.040, 0.011 and 0.014 °/s/g with u of 0.002 to 0.006.
    assert abs(found.value) < 0.01
    assert abs(found.value) < 2 * (found.u or 0.0)
    assert any("predicts left-out dwells best" in line for line in result.warnings)


def test_a_gap_soon_after_a_short_motion_gives_a_result_without_a_warning() -> None:
    period_s, many = 1 / 204.8, 40
    # A motion of 0.4° shows in the windows of filter setting 6, which are longer than the samples there.
    time = period_s * np.concatenate([np.arange(many), 600 + np.arange(400)])
    rate = np.zeros((len(time), 3))
    rate[:10, 2] = 8.0
    force = np.tile([0.0, 0.0, -1.0], (len(time), 1))
    path = Samples(time, rate, force, np.zeros((2, 3)), force[:2])
    sampling = Sampling(period_s, 6, math.inf, 1e-6 * np.eye(3), np.zeros(3))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = integrate(path, sampling)
    assert found == "the part was already moving when the recording began, or still moving when it ended"
