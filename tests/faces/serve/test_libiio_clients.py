"""Unmodified clients of others: libiio's tools and pyadi-iio, at full rate, without loss."""

import re
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest

from faces.serve.raw_client import WAIT_S, served

PERIOD_NS = 1_220_700
RATE_HZ = 819.2
WITNESS = np.dtype([("v", "<i2", (7,)), ("pad", "<i2"), ("time_ns", "<i8")])
REALTIME = "sim:?seed=1&realtime=1"


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is missing: apt-get install libiio-utils (scripts/install_rigs.sh)")
    return path


def run(name: str, port: int, *words: str) -> subprocess.CompletedProcess:
    command = [tool(name), "-u", f"ip:127.0.0.1:{port}", *words]
    return subprocess.run(command, capture_output=True, timeout=WAIT_S, check=False)


def test_iio_info_shows_every_channel_with_its_values():
    with served() as server:
        done = run("iio_info", server.port)
    text = done.stdout.decode()
    assert done.returncode == 0, done.stderr
    assert "ERROR" not in text
    assert done.stderr == b""
    assert "iio:device0: adis16354 (buffer capable)" in text
    assert "9 channels found" in text
    assert "No trigger on this device" in text
    scale = float(re.search(r"accel_x:.*?scale value: (\S+)", text, re.DOTALL)[1])
    assert scale == pytest.approx(0.4672e-3 * 9.80665)
    assert re.search(r"voltage0: supply \(input, index: 7, format: le:u12/16>>0\)", text)


def test_iio_readdev_gets_seven_channels_at_full_rate_without_a_gap():
    scans = 8192  # ten seconds
    with served(REALTIME) as server:
        channels = ["accel_x", "accel_y", "accel_z", "anglvel_x", "anglvel_y", "anglvel_z", "temp_x"]
        done = run(
            "iio_readdev", server.port, "-b", "128", "-s", str(scans), "adis16354", *channels, "timestamp"
        )
        assert done.returncode == 0, done.stderr
    data = np.frombuffer(done.stdout, WITNESS)
    assert len(data) == scans
    steps = np.diff(data["time_ns"])
    assert ((steps > 0.9 * PERIOD_NS) & (steps < 1.1 * PERIOD_NS)).all()
    norm_g = np.linalg.norm(data["v"][:, :3].mean(axis=0)) * 0.4672e-3
    assert norm_g == pytest.approx(1, abs=0.05)
    assert (data["v"][:, :6].std(axis=0) > 0.3).all()  # it lives


def test_iio_attr_reads_and_writes_where_it_may():
    with served(allow_writes=True) as server:
        assert run("iio_attr", server.port, "-c", "adis16354", "accel_y", "calibbias", "42").returncode == 0
        got = run("iio_attr", server.port, "-c", "adis16354", "accel_y", "calibbias")
        assert got.stdout.strip() == b"42"
        got = run("iio_attr", server.port, "-d", "adis16354", "sampling_frequency")
        assert float(got.stdout) == pytest.approx(RATE_HZ, rel=1e-4)
        assert server.sensor.read("YACCL_OFF") == 42
    with served() as server:
        done = run("iio_attr", server.port, "-c", "adis16354", "accel_y", "calibbias", "42")
        assert b"not permitted" in done.stdout + done.stderr
        assert server.sensor.read("YACCL_OFF") == 0


PYADI = """
import sys, numpy as np
from adi.context_manager import context_manager
from adi.rx_tx import rx

class adis16354(rx, context_manager):
    _device_name = "adis16354"
    _complex_data = False
    _rx_channel_names = [*(f"{kind}_{axis}" for kind in ("accel", "anglvel") for axis in "xyz"), "temp_x"]

    def __init__(self, uri):
        context_manager.__init__(self, uri, self._device_name)
        self._ctrl = self._rxadc = self._ctx.find_device(self._device_name)
        rx.__init__(self)

imu = adis16354(sys.argv[1])
imu.rx_buffer_size = 256
imu.rx_output_type = "raw"
print(imu._get_iio_attr("accel_x", "scale", False), imu._get_iio_dev_attr("sampling_frequency"))
blocks = [np.stack(imu.rx()) for _ in range(int(sys.argv[2]))]
np.save(sys.argv[3], np.concatenate(blocks, axis=1))
imu._set_iio_attr("accel_z", "calibbias", False, -300)
print(imu._get_iio_attr("accel_z", "calibbias", False))
"""


def test_pyadi_iio_reads_the_scans_that_the_sensor_made(tmp_path):
    # In processes of its own: it loads libiio.so, and warns of much.
    probe = subprocess.run(
        [sys.executable, "-c", "import adi"], capture_output=True, text=True, check=False, timeout=600
    )
    if probe.returncode:
        pytest.skip(f"pyadi-iio or libiio0 is missing: {probe.stderr.strip().splitlines()[-1]}")
    blocks = 16
    with served(REALTIME, allow_writes=True) as server:
        uri = f"ip:127.0.0.1:{server.port}"
        command = [sys.executable, "-c", PYADI, uri, str(blocks), str(tmp_path / "rx.npy")]
        with server.client() as witness:
            assert witness.open(0x17F, samples=20_000) == 0
            done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
            assert done.returncode == 0, done.stderr
            newest = int(time.time_ns())
            seen = [np.frombuffer(witness.scans(24, 100), WITNESS)]
            while seen[-1]["time_ns"][-1] < newest:
                seen.append(np.frombuffer(witness.scans(24, 100), WITNESS))
        assert server.sensor.bus.chip.memory["ZACCL_OFF"] & 0xFFF == -300 & 0xFFF
    scale, rate, bias = done.stdout.split()
    assert float(scale) == pytest.approx(0.4672e-3 * 9.80665)
    assert float(rate) == pytest.approx(RATE_HZ, rel=1e-4)
    assert float(bias) == -300
    samples = np.load(tmp_path / "rx.npy")
    assert samples.shape == (7, 256 * blocks)
    assert np.linalg.norm(samples[:3].mean(axis=1)) * float(scale) == pytest.approx(9.81, rel=0.05)
    witnessed = np.concatenate(seen)
    steps = np.diff(witnessed["time_ns"])
    assert np.quantile(steps, 0.99) < 1.1 * PERIOD_NS
    begins = np.flatnonzero((witnessed["v"][:, :3] == samples[:3, 0]).all(axis=1))
    parts = (witnessed["v"][k : k + samples.shape[1]] for k in begins)
    assert any(np.array_equal(part, samples.T) for part in parts), "a scan was lost, repeated or changed"
