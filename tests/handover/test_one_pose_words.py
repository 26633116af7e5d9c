"""One pose: what is said of it is what one pose can and cannot tell."""

import numpy as np

from adis_gonio import load_session
from adis_gonio.tracing import trace_summary as words
from adis_gonio.tracing.trace import trace

HEADER = "# plane: none\n# accel_unit: mg\n# sensor: generic\n"


def one_pose(tmp_path, n=4000):
    """A warm-up of 20 °C that moves the zeros of an accelerometer at rest."""
    rng = np.random.default_rng(5)
    time = np.arange(n) * 0.5
    warm = 20 * np.sin(time / time[-1] * 2 * np.pi)
    accel = np.array([12.0, -7.0, -999.0]) + np.outer(warm, [0.3, -0.2, 0.1]) + rng.normal(size=(n, 3))
    rows = [
        f"{t:.1f},0,{25 + w:.4f},{a[0]:.4f},{a[1]:.4f},{a[2]:.4f}"
        for t, w, a in zip(time, warm, accel, strict=True)
    ]
    path = tmp_path / "pose.csv"
    path.write_text(HEADER + "time_s,position,temp_c,ax,ay,az\n" + "\n".join(rows) + "\n")
    return load_session(path)


def test_thousands_of_samples_are_not_too_few_readings(tmp_path):
    session = one_pose(tmp_path)
    result = trace(session)
    said = words.headline(result)
    assert "bias_temperature (x, y, z)" in said
    assert "as many parameters as there are readings" not in said
    assert "more positions" not in said.lower()
    assert "One pose does not show whether bias or gain" in said
    assert "noise of neighbouring samples" in said
