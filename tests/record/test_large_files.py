"""Large files: memory grows with the numbers alone, progress is told, Ctrl-C ends at once."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import large_file
from adis_gonio.base.budget import Budget, within
from adis_gonio.fitting import fit
from adis_gonio.fitting.estimation import spectrum
from adis_gonio.record.loading import load_session
from programs import running

ROOT = Path(__file__).parents[2]

ALLOWED_MB, ROWS = 600, 5_000_000
"""What a file of seven columns may take: 280 MB of it are the numbers."""
FEW, MANY = 100_000, 300_000


@pytest.mark.parametrize("positions", [False, True], ids=["continuous", "positions"])
def test_memory_of_five_million_rows_by_the_slope_of_smaller_files(tmp_path, positions):
    peaks = []
    for rows in (FEW, MANY):
        path = tmp_path / f"{rows}.csv"
        large_file.write(path, rows, positions=positions)
        figures = large_file.measure(path)
        assert figures["dwells"] == large_file.POSITIONS
        assert figures["delta_k"] == pytest.approx(0.01, abs=1e-3)
        peaks.append(figures["fitted_mb"])
    per_row_mb = (peaks[1] - peaks[0]) / (MANY - FEW)
    assert peaks[1] + per_row_mb * (ROWS - MANY) < ALLOWED_MB


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    path = tmp_path_factory.mktemp("large") / "large.csv"
    large_file.write(path, 300_000, positions=True)
    return path


def test_loading_and_fitting_tell_their_stages_with_the_share(large):
    stages = []
    with within(Budget(tell=stages.append)):
        fit(load_session(large))
    shares = [int(stage.removesuffix("%")) for stage in stages if stage.endswith("%")]
    assert shares == sorted(shares)
    assert len(set(shares)) > 10  # one per MB of text
    assert shares[-1] == 100
    assert stages.index("noise of the readings") > stages.index("100%")
    assert stages[-1] == "the best method"


def test_ctrl_c_while_a_file_is_read_ends_with_130_and_one_line(large, tmp_path):
    # Eight times its rows, time going on: of what is read within a second a log is told nothing.
    lines = large.read_text().splitlines()
    head = [line for line in lines if not line[0].isdigit()]
    rows = [line.split(",", 1) for line in lines[len(head) :]]
    longer = tmp_path / "large.csv"
    with longer.open("w") as file:
        file.writelines(f"{line}\n" for line in head)
        for copy in range(8):
            file.writelines(f"{float(time) + 1000 * copy:.4f},{rest}\n" for time, rest in rows)
    command = [sys.executable, "-m", "adis_gonio", "fit", str(longer)]
    with running(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        told = process.stderr.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    assert told.startswith("reading large.csv")
    assert process.returncode == 130
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert "stopped by the operator" in err


@pytest.mark.parametrize("n", [130, 1024, 4095, 20_000])
def test_joined_ordinates_give_the_noise_that_all_of_them_give(monkeypatch, n):
    """Bins nest in every band and cell, so that nothing changes but rounding."""
    rng = np.random.default_rng(n)
    white = rng.normal(0, 1, (6, n, 3))
    filtered = np.stack([np.apply_along_axis(np.convolve, 0, w, np.ones(9) / 9, "same") for w in white])
    for samples in (
        list(white),
        list(filtered),
        list(np.cumsum(white, axis=1)),
        [*white[:3], *filtered[3:]],
    ):
        joined = spectrum.noise_of_means(samples)
        with monkeypatch.context() as patched:
            patched.setattr(spectrum, "_ALONE", n)
            single = spectrum.noise_of_means(samples)
        for name in ("covariance", "dof", "flicker", "flicker_limit"):
            np.testing.assert_allclose(getattr(joined, name), getattr(single, name), rtol=1e-9, atol=1e-30)
        assert (joined.pooled, joined.too_short) == (single.pooled, single.too_short)
