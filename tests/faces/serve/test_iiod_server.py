"""The server with plain sockets: answers, errors, many clients, clients that die, and its end."""

import contextlib
import gc
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.device.bus import open_bus
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.cli import main
from adis_gonio.faces.serve import iio_device, iio_server
from adis_gonio.faces.serve.iio_server import MOST_PENDING, SEND_BUFFER
from adis_gonio.sim.bus import SimBus
from adis_gonio.sim.world import World
from faces.serve.raw_client import WAIT_S, RawClient, served
from fakes.counting_bus import CountingBus
from fakes.faulty_chip import FaultyChip, Window
from programs import running

PERIOD_NS = 1_220_700
ALL = 0x1FF
SCAN = np.dtype([("values", "<i2", (8,)), ("time_ns", "<i8")])
EPERM, ENOENT, EIO, ENXIO, EBADF, EACCES, EBUSY, ENODEV, EINVAL = -1, -2, -5, -6, -9, -13, -16, -19, -22


def wait_until(condition):
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def assert_gapless(data: bytes) -> np.ndarray:
    scans = np.frombuffer(data, SCAN)
    steps = np.diff(scans["time_ns"])
    assert ((steps > 0.9 * PERIOD_NS) & (steps < 1.1 * PERIOD_NS)).all(), "a scan was lost or repeated"
    return scans


def test_readings_have_the_units_that_they_claim():
    with served() as server, server.client() as client:
        axes = []
        for axis in "xyz":
            raw = float(client.text(f"READ iio:device0 INPUT accel_{axis} raw"))
            axes.append(raw * float(client.text(f"READ adis16354 INPUT accel_{axis} scale")))
        assert np.linalg.norm(axes) == pytest.approx(9.81, rel=0.05)
        supply = float(client.text("READ iio:device0 INPUT voltage0 raw"))
        assert supply * float(client.text("READ iio:device0 INPUT voltage0 scale")) == pytest.approx(
            5000, rel=0.02
        )
        assert float(client.text("READ iio:device0 sampling_frequency")) == pytest.approx(819.2, rel=1e-4)


@pytest.mark.parametrize("level", ["high", "low"])
def test_a_reading_is_refused_while_the_data_line_is_stuck(level):
    """Zeros and ones look like readings: only a register that is never zeros or ones tells."""
    bus = open_bus("sim:?seed=1")
    chip = bus.chip = FaultyChip(bus.chip, np.random.default_rng(1))
    lines = [f"READ iio:device0 INPUT accel_{axis} raw" for axis in "xyz"]

    def norm_lsb(client) -> float:
        return float(np.linalg.norm([int(client.text(line)) for line in lines]))

    with served(sensor=Adis16354(bus)) as server, server.client() as client:
        assert norm_lsb(client) == pytest.approx(2140, rel=0.1)
        chip.windows.append(Window(bus.now_s(), bus.now_s() + 1e6, level, deaf=False))
        assert [client.ask(line) for line in lines] == [EIO] * 3
        chip.windows.clear()
        assert norm_lsb(client) == pytest.approx(2140, rel=0.1)


@pytest.mark.parametrize(
    ("line", "errno"),
    [
        ("BINARY", EINVAL),
        ("ZPRINT", EINVAL),
        ("HELLO", EINVAL),
        ("OPEN iio:device0", EINVAL),
        ("OPEN iio:device0 many 000001ff", EINVAL),
        ("OPEN iio:device0 256 xyz", EINVAL),
        ("READ", EINVAL),
        ("READ iio:device0 INPUT accel_x", EINVAL),
        ("READ iio:device0 INPUT accel_x raw more", EINVAL),
        ("TIMEOUT", EINVAL),
        ("TIMEOUT 1e9", EINVAL),
        ("READ iio:device9 sampling_frequency", ENODEV),
        ("READ iio:device0 no_such", ENOENT),
        ("READ iio:device0 ", EINVAL),
        ("READ iio:device0 BUFFER length", EINVAL),
        ("READ iio:device0 DEBUG clients", EINVAL),
        ("READ iio:device0 INPUT accel_w raw", ENXIO),
        ("READ iio:device0 OUTPUT accel_x raw", EINVAL),
        ("READ iio:device0 INPUT timestamp raw", ENOENT),
        ("OPEN iio:device0 256 00000000", EINVAL),
        ("OPEN iio:device0 256 ffffffff", EINVAL),
        ("OPEN iio:device0 256 1", EINVAL),
        ("OPEN iio:device0 0 00000001", EINVAL),
        ("OPEN iio:device0 16 00000001 CYCLIC", EINVAL),
        ("OPEN iio:device1 256 00000001", ENODEV),
        ("READBUF iio:device0 64", EBADF),
        ("CLOSE iio:device0", EBADF),
        ("CLOSE iio:device1", ENODEV),
        ("WRITEBUF iio:device0 64", EPERM),
        ("GETTRIG iio:device0", ENOENT),
        ("SETTRIG iio:device0 trigger0", ENOENT),
        ("SET iio:device0 BUFFERS_COUNT 4", EINVAL),
        ("HELP", EINVAL),
        ("WRITE iio:device0 INPUT accel_x calibbias 99999", -7),
    ],
)
def test_a_wrong_request_has_an_error_number_and_holds_nobody_up(line, errno):
    with served() as server, server.client() as client, server.client() as other:
        assert client.ask(line) == errno
        assert other.ask("TIMEOUT 1000") == 0


def test_without_leave_nothing_is_written():
    bus = CountingBus(World(seed=1))
    with served(sensor=Adis16354(bus)) as server, server.client() as client:
        before = list(bus.writes)
        assert client.write("iio:device0 INPUT accel_x calibbias", "100") == EPERM
        assert client.write("iio:device0 sampling_frequency", "100") == EPERM
        assert client.write("iio:device0 INPUT accel_x scale", "1") == EACCES
        assert client.write("iio:device0 INPUT accel_x nothing", "1") == ENOENT
        assert client.text("READ iio:device0 INPUT accel_x calibbias") == "0"
        assert bus.writes == before


def test_with_leave_offsets_rate_and_filter_are_written_and_read_back():
    with served(allow_writes=True) as server, server.client() as client:
        before = int(client.text("READ iio:device0 INPUT accel_z raw"))
        assert client.write("iio:device0 INPUT accel_z calibbias", "-1000") == 6
        assert client.text("READ iio:device0 INPUT accel_z calibbias") == "-1000"
        assert client.write("iio:device0 INPUT anglvel_y calibbias", "77") == 3
        assert client.write("iio:device0 sampling_frequency", "205") == 4
        assert float(client.text("READ iio:device0 sampling_frequency")) == pytest.approx(204.8, rel=1e-3)
        assert client.write("iio:device0 INPUT accel_x filter_low_pass_3db_frequency", "4.1") == 4
        got = float(client.text("READ iio:device0 INPUT anglvel_z filter_low_pass_3db_frequency"))
        assert got == pytest.approx(16.36 * 204.8 / 819.2, rel=1e-2)
        for bad in ("5000", "-2049", "1.5", "nan", "inf", "ten", "", "1_0"):
            assert client.write("iio:device0 INPUT accel_z calibbias", bad) == EINVAL, bad
        assert client.write("iio:device0 sampling_frequency", "100000") == EINVAL
        after = int(client.text("READ iio:device0 INPUT accel_z raw"))
        assert after - before == pytest.approx(-1000, abs=60)
    assert server.failure == []


def test_a_connection_that_is_idle_gives_way_and_one_in_use_does_not(monkeypatch):
    monkeypatch.setattr(iio_server, "MOST_CLIENTS", 3)
    monkeypatch.setattr(iio_server, "IDLE_S", 600.0)
    with served() as server, contextlib.ExitStack() as stack:
        streaming, first, second = (stack.enter_context(server.client()) for _ in range(3))
        assert streaming.ask(f"OPEN iio:device0 64 {ALL:08x}") == 0
        for client in (first, second):
            assert client.text("READ iio:device0 sampling_frequency")
        with server.client() as refused:
            assert refused.file.read() == b""
        monkeypatch.setattr(iio_server, "IDLE_S", 0.0)
        # With no time allowed, the client that asked first has been idle for the longest time.
        new = stack.enter_context(server.client())
        assert new.text("READ iio:device0 sampling_frequency")
        assert first.file.read() == b""
        assert second.text("READ iio:device0 sampling_frequency")
        assert streaming.ask("CLOSE iio:device0") == 0


def test_five_clients_each_with_a_mask_of_its_own_lose_nothing():
    with served("sim:?seed=1&realtime=1") as server:
        clients = [server.client() for _ in range(5)]
        masks = [0x1FF, 0x107, 0x001, 0x138, 0x180]
        sizes = [24, 16, 2, 16, 16]
        for client, mask in zip(clients, masks, strict=True):
            assert client.open(mask) == 0
            assert client.open(mask) == EBUSY
        for client, size in zip(clients, sizes, strict=True):
            client.send(f"READBUF iio:device0 {size * 700}\r\n".encode())
        data = []
        for client, size in zip(clients, sizes, strict=True):
            part, mask = b"", None
            while len(part) < size * 700:
                length = client.number()
                mask = mask or client.file.readline()
                part += client.file.read(length)
            data.append(part)
        full = assert_gapless(data[0])
        accel = np.frombuffer(data[1], np.dtype([("v", "<i2", (3,)), ("pad", "<i2"), ("time_ns", "<i8")]))
        _, mine, theirs = np.intersect1d(accel["time_ns"], full["time_ns"], return_indices=True)
        assert len(mine) > 100
        assert (accel["v"][mine] == full["values"][theirs, :3]).all()
        for client in clients:
            client.close()
        wait_until(lambda: len(server.told) == 5)
        assert all("700 scans sent, 0 lost" in line for line in server.told)


def test_a_client_that_does_not_read_loses_its_own_oldest_scans_and_nobody_elses():
    with served(queue_s=0.5) as server, server.client() as slow, server.client() as quick:
        slow.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        assert slow.open(ALL, 16) == 0
        slow.send(b"READBUF iio:device0 240000000\r\n")
        assert quick.open(ALL) == 0
        assert_gapless(quick.scans(24, 8000))  # the queue, and what the kernel takes, have less room
        slow.close()
        wait_until(lambda: any(" 0 lost" not in line for line in server.told))


def test_lost_scans_are_counted_also_after_the_client_has_read_all_others():
    hub = SimpleNamespace(close=lambda buffer: None)
    server = SimpleNamespace(device=None, sampler=None, hub=hub, allow_writes=False)
    client = iio_server.ClientSession(None, None, server)
    client._buffer = iio_device.Buffer(SimpleNamespace(dtype=SCAN), 10)
    client._buffer.lost = 7
    assert client.lost == 7
    client._close()
    assert client.lost == 7


def test_a_client_that_dies_in_the_middle_leaves_no_trace():
    with served("sim:?seed=1&realtime=1") as server:
        for goodbye in (b"", b"WRITE iio:device0 INPUT accel_x calibbias 4\r\n1", b"READBUF iio:dev"):
            dying = server.client()
            assert dying.open(ALL) == 0
            dying.send(goodbye or b"READBUF iio:device0 2400000\r\n")
            wait_until(lambda: server.sensor.bus.chip.memory["MSC_CTRL"] == 4)
            dying.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            dying.close()  # a reset, not a goodbye
            wait_until(lambda: server.sensor.bus.chip.memory["MSC_CTRL"] == 0)  # nobody listens: set back
        with server.client() as next_one:
            assert next_one.open(ALL) == 0
            assert_gapless(next_one.scans(24, 100))


def test_requests_sent_ahead_are_answered_in_order():
    with served() as server, server.client() as client:
        client.send(b"TIMEOUT 1\r\nNONSENSE\r\n" * (4 * MOST_PENDING))
        assert [client.number() for _ in range(8 * MOST_PENDING)] == [0, EINVAL] * (4 * MOST_PENDING)


def test_a_half_closed_connection_still_gets_its_answers():
    with served() as server, server.client() as client:
        client.send(b"VERSION\r\nTIMEOUT 5\r\n")
        client.socket.shutdown(socket.SHUT_WR)
        assert client.file.read() == b"0.24.gonio-1\n0\n"


def test_a_read_beyond_the_last_whole_scan_ends_with_zero():
    with served() as server, server.client() as client:
        assert client.open(ALL) == 0
        assert client.ask("READBUF iio:device0 23") == 0
        client.send(b"READBUF iio:device0 30\r\n")
        assert client.number() == 24
        client.file.read(9 + 24)
        assert client.number() == 0


def test_attributes_are_read_and_written_while_scans_flow():
    url = "sim:?seed=1&realtime=1"
    with served(url, allow_writes=True) as server, server.client() as writer, server.client() as client:
        assert client.open(ALL) == 0
        client.scans(24, 50)
        raw = int(writer.text("READ iio:device0 INPUT accel_x raw"))
        assert_gapless(client.scans(24, 100))
        assert writer.write("iio:device0 INPUT accel_x calibbias", "500") == 4
        values = np.frombuffer(client.scans(24, 400), SCAN)["values"][:, 0]
        assert values[-50:].mean() - raw == pytest.approx(500, abs=60)
        assert client.write("iio:device0 INPUT accel_x calibbias", "0") == 2
        assert client.ask("CLOSE iio:device0") == 0
        assert client.ask("READBUF iio:device0 24") == EBADF


class DyingBus(SimBus):
    """Its cable can be pulled in the middle of a stream."""

    pulled = False

    def stream(self, frames, *, block_scans=256):
        stream = super().stream(frames, block_scans=block_scans)

        def blocks():
            while not self.pulled:
                yield next(stream)
            raise BusTimeoutError("sim: the bridge does not answer")

        return _Stream(blocks(), stream)


class _Stream:
    def __init__(self, blocks, stream):
        self._blocks, self._stream = blocks, stream

    def __next__(self):
        return next(self._blocks)

    def close(self):
        self._stream.close()


def test_a_sensor_that_fails_is_an_error_for_every_client_and_the_servers_end():
    with served(sensor=Adis16354(DyingBus(World(seed=1)))) as server:
        with server.client() as one, server.client() as two:
            for client in (one, two):
                assert client.open(ALL) == 0
                client.scans(24, 20)
                client.send(b"READBUF iio:device0 24000000\r\n")
            server.sensor.bus.pulled = True
            for client in (one, two):
                length, first = client.number(), True
                while length > 0:
                    client.file.read(length + (9 if first else 0))
                    length, first = client.number(), False
                assert length == EIO
            server.thread.join(WAIT_S)
        assert [str(error) for error in server.failure] == ["sim: the bridge does not answer"]


@pytest.mark.skipif(sys.platform == "win32", reason="signals need POSIX")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_command_in_order_with_a_client_in_the_middle(number):
    command = [sys.executable, "-m", "adis_gonio", "serve", "sim:?seed=1", "--iio", "0"]
    with running(command, stderr=subprocess.PIPE) as program:
        line = program.stderr.readline()
        assert "read-only" in line, line
        port = int(line.split("ip:127.0.0.1:")[1].partition(",")[0])
        with RawClient(port) as client:
            assert client.open(ALL) == 0
            client.scans(24, 20)
            client.send(b"READBUF iio:device0 24000000\r\n")
            client.number()
            os.kill(program.pid, number)
            told = program.stderr.read()
        assert program.wait(WAIT_S) == 0, told
    assert "Traceback" not in told
    assert "scans sent" in told


def test_a_port_that_is_taken_is_one_line(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "sim:?seed=1", "--iio", str(port)]) == 1
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"port {port}" in told
    assert main(["serve", "sim:?seed=1", "--iio", "0", "--listen", "no.such.host.invalid"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["serve", "sim:?seed=1", "--iio", "99999"]) == 2


def test_data_ready_is_set_back_at_the_end():
    with served() as server:
        sensor = server.sensor
        with server.client() as client:
            assert client.open(ALL) == 0
            client.scans(24, 20)
            assert sensor.bus.chip.memory["MSC_CTRL"] == 4
        wait_until(lambda: sensor.bus.chip.memory["MSC_CTRL"] == 0)
        client = server.client()
        assert client.open(ALL) == 0
        client.scans(24, 20)
        assert sensor.bus.chip.memory["MSC_CTRL"] == 4
    assert sensor.bus.chip.memory["MSC_CTRL"] == 0
    client.close()


def test_a_bus_without_streams_is_served_by_polling():
    with served("sim:?seed=1&stream=0") as server, server.client() as client:
        assert client.open(ALL) == 0
        assert (np.diff(np.frombuffer(client.scans(24, 200), SCAN)["time_ns"]) > 0).all()


def test_noise_on_the_wire_writes_nothing_and_stops_nobody():
    dice = np.random.default_rng(5)
    bus = CountingBus(World(seed=1))
    with served(sensor=Adis16354(bus)) as server:
        before = len(bus.writes)
        for _ in range(40):
            with server.client() as noisy:
                try:
                    noisy.send(dice.bytes(5000))
                except OSError:
                    continue  # it was refused before all was sent
        with server.client() as client:
            assert client.ask("TIMEOUT 1") == 0
        assert len(bus.writes) == before


def test_the_servers_end_closes_a_connection_whose_answers_nobody_takes():
    with socket.socket() as silent:
        silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        with served() as server, server.client() as other:
            silent.connect(("127.0.0.1", server.port))
            asked = 2 * SEND_BUFFER // len(other.text("PRINT")) + 3  # more than the kernel takes
            silent.sendall(b"PRINT\r\n" * asked + b"EXIT\r\n")
            for _ in range(20):  # turns of the server's loop, in which it comes to EXIT
                assert other.ask("TIMEOUT 1000") == 0
        gc.collect()  # a transport that was left open warns when it is collected
