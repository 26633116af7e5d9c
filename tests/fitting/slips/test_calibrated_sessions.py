"""From the bench to the fit: a part that slips in `calibrate` is said twice, and angles mend it."""

from __future__ import annotations

import json

import numpy as np

from adis_gonio.faces.cli import main
from adis_gonio.record.loading import load_session
from typical_gyros import draw_gyros

SLIP_DEG, FROM = 4.0, 3
GYROS = "&".join(f"{name}={value}" for name, value in draw_gyros(np.random.default_rng(5)).items())
REALISTIC = f"sim:?seed=5&delta_k=0.012&delta_phi_deg=0.2&{GYROS}"
SLIPPING = f"{REALISTIC}&part_slip_deg={SLIP_DEG}&part_slip_position={FROM}"


def calibrated(capsys, url, path):
    """What the bench says while it goes through twelve positions by itself."""
    options = ("--auto", "--plan", "mmpm", "--positions", "12", "--dwell", "2", "-o", str(path))
    main(["calibrate", url, *options])
    said = capsys.readouterr()
    return " ".join((said.out + said.err).split())


def fitted(capsys, path, *options):
    assert main(["fit", str(path), "--json", *options]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_slip_is_said_at_the_bench_and_by_the_fit_and_mended_by_angles(tmp_path, capsys):
    path = tmp_path / "slips.session"
    said = calibrated(capsys, SLIPPING, path)
    assert "off 90° " in said
    assert "positions 3 to 11 are (+4.0" in said

    document = fitted(capsys, path)
    (found,) = document["positions"]
    assert (found["finding"], found["position"]) == ("slipped", FROM)
    assert abs(found["error_deg"] - SLIP_DEG) < 4 * found["error_u_deg"] + 0.02
    assert found["gyro_deg"] is not None
    assert abs(found["gyro_deg"] - 94.0) < 4 * found["gyro_u_deg"]

    moved = {
        d.position: d.angle_deg + found["error_deg"]
        for d in load_session(path).dwells
        if d.position >= FROM
    }
    mended = fitted(capsys, path, "--angles", ",".join(f"{k}={a}" for k, a in moved.items()))
    assert "positions" not in mended
    for name, truth in (("delta_k", 0.012), ("delta_phi", 0.2)):
        entry, spoilt = mended["parameters"][name], document["parameters"][name]
        assert abs(entry["value"] - truth) < 4 * entry["u"]
        assert entry["u"] < spoilt["u"] / 5


def test_where_nothing_slips_nothing_is_said(tmp_path, capsys):
    path = tmp_path / "good.session"
    said = calibrated(capsys, REALISTIC, path)
    assert "° off " not in said
    assert "positions" not in fitted(capsys, path)
