"""A real kernel's IIO accelerometer, read by the local `iio:` source: attributes, buffer, unplugging."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from adis_gonio.base.errors import CannotOpenError, ProtocolError
from adis_gonio.faces.cli import app
from adis_gonio.record.source import Settings, open_source
from kernel.hid_accelerometer import INTERVAL_MS, MG_PER_LSB, NAME, HidAccelerometer

DEVICES = Path("/sys/bus/iio/devices")
SETTLE_S = 20
LOST = (30, 31, 32)


@pytest.fixture
def sensor() -> Iterator[HidAccelerometer]:
    """Plugged in, and its device there."""
    with HidAccelerometer(without=LOST) as sensor:
        end = time.monotonic() + SETTLE_S
        while not list(DEVICES.glob("iio:device*")):
            assert time.monotonic() < end, "the kernel made no IIO device"
            time.sleep(0.05)
        time.sleep(0.5)
        yield sensor


def state() -> dict[str, str]:
    """What a reader changes and libiio sets back."""
    (device,) = DEVICES.glob("iio:device*")
    files = [*(device / "scan_elements").glob("*_en"), device / "buffer/enable"]
    return {str(file.relative_to(device)): file.read_text() for file in files}


def test_a_kernels_accelerometer_is_streamed_whole_with_its_own_times(sensor: HidAccelerometer) -> None:
    before = state()
    with open_source(f"iio:{NAME}") as source:
        assert source.measuring.sample_rate_hz == pytest.approx(1000 / INTERVAL_MS)
        assert source.part.step_mg == pytest.approx(MG_PER_LSB)
        with source.samples(Settings(), 10) as stream:
            assert state()["buffer/enable"] == "1\n"
            blocks = [next(stream) for _ in range(5)]
            assert "lost ones show in their times" in stream.how
    rows = np.concatenate([block.accel_mg for block in blocks]) / MG_PER_LSB
    n = rows[:, 0]
    np.testing.assert_allclose(rows, np.stack([n, -n, n - 10_000], axis=1), atol=1e-6)
    times = np.concatenate([block.time_s for block in blocks])
    np.testing.assert_allclose(np.diff(times), np.diff(n) * INTERVAL_MS / 1000, atol=1e-9)
    missing = round(float(n[-1] - n[0])) + 1 - len(n)
    assert sum(block.lost for block in blocks) == missing
    # The device numbers from its first report on, which the reader may have missed.
    assert missing >= len([k for k in LOST if n[0] < k < n[-1]]) == len(LOST)
    assert state() == before


def test_a_kernels_accelerometer_is_polled_value_by_value(sensor: HidAccelerometer) -> None:
    with open_source(f"iio:{NAME}?poll=20") as source, source.samples(Settings(), 5) as stream:
        block = next(stream)
    x, y, z = (block.accel_mg / MG_PER_LSB).T
    assert (np.abs(x + y) < 50).all()  # the axes are read one after another
    assert (np.abs(x - z - 10_000) < 50).all()


def test_a_kernels_accelerometer_is_listed_and_recorded(sensor: HidAccelerometer, tmp_path: Path) -> None:
    listed = CliRunner().invoke(app, ["devices", "--json"], catch_exceptions=False)
    urls = {row["url"]: row["description"] for row in json.loads(listed.stdout)["devices"]}
    (url,) = (url for url in urls if url.startswith("iio:"))
    assert NAME in urls[url]
    out = tmp_path / "rest.csv"
    done = CliRunner().invoke(
        app, ["stream", url, "--seconds", "2", "-o", str(out)], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    # The values of this accelerometer count on, as those of a part that turns: the file holds no dwell.
    lines = out.read_text().splitlines()
    assert {"# sensor: generic", "# accel_unit: mg"} <= set(lines)
    rows = np.genfromtxt([line for line in lines if not line.startswith("#")], delimiter=",", names=True)
    assert rows["az"].mean() == pytest.approx(-1000, abs=50)


def test_a_kernels_accelerometer_that_is_pulled_out_is_a_typed_error(sensor: HidAccelerometer) -> None:
    with open_source(f"iio:{NAME}") as source:
        stream = source.samples(Settings(), 5)
        next(stream)
        sensor.unplug()
        with pytest.raises(ProtocolError, match="the device is gone"):
            list(stream)
        stream.close()
    with pytest.raises(CannotOpenError, match="no such IIO device"):
        open_source(f"iio:{NAME}")
