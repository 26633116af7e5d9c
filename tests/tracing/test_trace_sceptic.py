"""What a first user stumbled over: large slips, angles of the wrong sense, names that nothing tests."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.base.errors import DataError
from adis_gonio.faces.cli import main


def written(
    path: Path,
    declared_deg: np.ndarray,
    true_deg: np.ndarray | None = None,
    bias=(8.0, -5.0),
    samples: int = 60,
    seed: int = 0,
    k2: float = 0.0,
) -> Path:
    """Dwells at true angles, of a part with a bias, in a file with the declared ones."""
    rng = np.random.default_rng(seed)
    true = declared_deg if true_deg is None else true_deg
    rows, time = [], 0.0
    for k, (declared, angle) in enumerate(zip(declared_deg, true, strict=True)):
        psi = 0.1 - np.deg2rad(angle + rng.normal(0, 0.005))
        x = 1005 * np.cos(psi) + bias[0] + k2 * np.cos(psi) ** 2
        y = 998 * np.sin(psi + 0.004) + bias[1]
        for own in np.array([x, y]) + rng.normal(0, 1.0, (samples, 2)):
            rows.append(f"{time:.4f},{k},{declared},{own[0]:.4f},{own[1]:.4f}")
            time += 0.01
        time += 4.0
    head = ["# sensor: generic", "# fixture_sigma_deg: 0.005", "# accel_unit: mg"]
    path.write_text("\n".join([*head, "time_s,position,angle_deg,ax,ay", *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("slip", [8.0, -15.0, 45.0, 90.0, 180.0])
def test_a_position_that_was_misread_is_a_slip_of_that_angle(tmp_path: Path, slip: float) -> None:
    declared = np.arange(24) * 15.0
    true = declared.copy()
    true[7] -= slip  # ψ = α − θ: the dwell stands at ψ + slip
    result = trace(load_session(written(tmp_path / "misread.csv", declared, true)))
    (found,) = [finding for finding in result.found if finding.effect == "position_slip"]
    value = found.parameters["slip"]
    off = (value.value - slip + 180) % 360 - 180
    assert abs(off) < 5 * value.u < 0.5
    assert found.parameters["dwell"].value == 7
    assert {finding.effect for finding in result.found} == {"position_slip", "bias"}
    assert result.adequate


def test_a_slip_stands_beside_a_large_bias(tmp_path: Path) -> None:
    declared = np.arange(24) * 15.0
    true = declared.copy()
    true[3] += 20.0
    result = trace(load_session(written(tmp_path / "both.csv", declared, true, bias=(60.0, -45.0), k2=4.0)))
    assert {finding.effect for finding in result.found} == {"position_slip", "bias", "quadratic"}
    assert result.adequate


@pytest.mark.parametrize("command", ["trace", "fit"])
def test_angles_of_the_wrong_sense_are_one_clear_line(tmp_path: Path, capsys, command: str) -> None:
    declared = np.arange(12) * 30.0
    path = written(tmp_path / "reversed.csv", declared, -declared)
    with pytest.raises(DataError, match="turn the other way"):
        trace(load_session(path))
    assert main([command, str(path)]) == 1
    error = capsys.readouterr().err
    assert "reversed.csv: the readings turn the other way than the declared angles" in error
    assert "Traceback" not in error


def test_nothing_is_called_adequate_that_nothing_tested(tmp_path: Path) -> None:
    result = trace(load_session(written(tmp_path / "two.csv", np.array([0.0, 90.0]))))
    assert result.after.chi2_per_dof is None
    assert not result.adequate
    assert not result.found


def test_without_a_dwell_to_leave_out_only_a_bias_is_called_found(tmp_path: Path) -> None:
    path = written(tmp_path / "four.csv", np.arange(4) * 90.0, k2=6.0)
    result = trace(load_session(path))
    if result.after.heldout_rms is None:
        assert {finding.effect for finding in result.found} <= {"bias"}


@pytest.mark.parametrize("seed", range(2))
def test_whatever_is_found_stands_its_own_test(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    declared = rng.permutation(np.arange(12) * 30.0)
    path = written(tmp_path / "wild.csv", declared, declared + rng.normal(0, 0.05, 12), seed=seed)
    for finding in trace(load_session(path)).found:
        assert finding.p_value <= 0.01
        assert finding.probability <= 1.0


def test_all_dwells_about_one_axis_are_no_design(tmp_path: Path) -> None:
    # Sixteen dwells within 5°: no fold by axes has anything to be fitted to.
    path = written(tmp_path / "arc.csv", np.linspace(0, 5, 16))
    assert "body axes" not in trace(load_session(path)).heldout_design


def test_a_method_that_fails_leaves_the_others_their_results(tmp_path: Path, capsys) -> None:
    declared = np.array([0.0, 90.0, 180.0, 270.0])
    path = written(tmp_path / "45.csv", declared, declared + 45.0 + np.rad2deg(0.1))
    assert main(["fit", str(path)]) == 0
    shown = capsys.readouterr()
    text = " ".join((shown.out + shown.err).split())
    assert "no result by paper" in text
    assert "four-position" in text
    assert main(["fit", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["method"] == "ml"


def test_a_report_of_numbers_without_any_freedom_is_written(tmp_path: Path) -> None:
    path = written(tmp_path / "few.csv", np.array([0.0, 90.0]), samples=1)
    assert main(["report", str(path), "-o", str(tmp_path / "few.html")]) == 0
    assert (tmp_path / "few.html").stat().st_size > 5000
