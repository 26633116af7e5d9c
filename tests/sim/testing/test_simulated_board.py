"""The fixture `simulated_board`: any program can open it, and it moves while the host looks."""

import contextlib
import os
import struct
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import open_sensor
from adis_gonio.base.errors import BusTimeoutError, UsageError
from adis_gonio.sim.testing import Faults, SimulatedBoard, open_board, open_simulated
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins
from fakes.virtual_clock import VirtualClock

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")

FAST = "sim:?seed=4&move_speed_dps=720&delta_k=0.01"


@pytest.mark.adis_gonio(url=FAST)
def test_the_drivers_serial_bus_finds_the_part_on_it(simulated_board):
    with open_sensor(simulated_board.url) as sensor:
        scans = sensor.read_scans(64).accel_mg
    with open_simulated(FAST) as twin:
        expected = twin.read_scans(64).accel_mg
    # One part in two worlds of the same seed: the noise falls on other samples, the part is the same.
    limit = 5 * expected.std(axis=0, ddof=1) / np.sqrt(32)
    assert (np.abs(scans.mean(axis=0) - expected.mean(axis=0)) < limit).all()


@pytest.mark.adis_gonio(url=FAST)
@pytest.mark.parametrize("stage", ["plane", "space"])
def test_the_stage_moves_while_a_host_is_connected(simulated_board, stage):
    with open_sensor(simulated_board.url) as sensor:
        before = sensor.read_scans(32).accel_mg.mean(axis=0)
        if stage == "plane":
            simulated_board.stage.move_to(90)
            assert simulated_board.stage.angle_deg == 90
        else:
            simulated_board.stage.orient((0, -1, 0))
        after = sensor.read_scans(32).accel_mg.mean(axis=0)
    assert before[0] > 900
    assert after[1] < -900
    assert abs(after[0]) < 200


def stuffed(raw: bytes) -> bytes:
    """COBS of fewer than 254 bytes, from PROTOCOL.md."""
    out = b""
    for part in raw.split(b"\0"):
        out += bytes([len(part) + 1]) + part
    return out + b"\0"


def unstuffed(data: bytes) -> bytes:
    parts, k = [], 0
    while k < len(data):
        parts.append(data[k + 1 : k + data[k]])
        k += data[k]
    return b"\0".join(parts)


def asked(line: int, kind: int, request_id: int, body: bytes) -> bytes:
    """Reply of the board, by nothing but its port and the protocol's text."""
    raw = struct.pack("<BH", kind, request_id) + body
    os.write(line, stuffed(raw + struct.pack("<I", zlib.crc32(raw))))
    data = b""
    while not data.endswith(b"\0"):
        data += os.read(line, 4096)
    reply = unstuffed(data[:-1])
    assert zlib.crc32(reply[:-4]) == struct.unpack("<I", reply[-4:])[0]
    assert struct.unpack("<BH", reply[:3]) == (kind | 0x80, request_id)
    return reply[3:-4]


@contextlib.contextmanager
def opened(path):
    line = os.open(path, os.O_RDWR | os.O_NOCTTY)
    yield line
    os.close(line)


def test_a_host_without_a_driver_reads_a_register_and_the_next_host_too(simulated_board):
    for nonce in (7, 8):
        with opened(simulated_board.path) as line:
            asked(line, 1, 100, struct.pack("<BI", 1, nonce))
            words = asked(line, 3, 101, struct.pack("<BHH", 0, 0x3800, 0))
            assert struct.unpack("<HH", words)[1] == 0x0402, "SENS_AVG's default"


def test_a_board_streams_to_the_driver_without_a_loss(simulated_board):
    assert simulated_board.url == f"serial:{simulated_board.path}"
    with open_sensor(simulated_board.url) as sensor:
        sensor.configure(sample_rate_hz=100)  # a busy machine keeps up with it
        with sensor.stream(block_scans=16) as stream:
            blocks = [next(stream) for _ in range(3)]
            assert "data-ready edge" in stream.how
    assert sum(len(block) for block in blocks) >= 48
    assert sum(block.lost for block in blocks) == 0


@pytest.mark.adis_gonio(faults=Faults(seed=2, flip=0.004))
def test_flipped_bits_on_the_line_never_become_a_wrong_word(simulated_board):
    answered = 0
    with open_sensor(simulated_board.url, check=False) as sensor:
        for _ in range(60):
            try:
                words = sensor.read_words(["SENS_AVG", "SMPL_PRD"])
            except BusTimeoutError:  # each try was hit, which retries of a busy machine can bring about
                continue
            assert words == [0x0402, 0x0001]
            answered += 1
    assert answered >= 50
    assert simulated_board.faults.seen["flip"] > 0


def test_another_program_opens_the_pty_by_its_path(simulated_board):
    command = [sys.executable, "-m", "adis_gonio", "registers", simulated_board.url, "SENS_AVG", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    assert "1026" in done.stdout


def test_boards_of_one_mark_have_dice_of_their_own():
    faults = Faults(seed=2, flip=0.5)
    with open_board(faults=faults) as one, open_board(faults=faults) as other:
        one.faults.happens("flip")
        assert one.faults.dice.getstate() != faults.dice.getstate() == other.faults.dice.getstate()


def test_the_end_of_the_board_ends_its_thread_and_may_come_twice():
    before = threading.active_count()
    board = open_board()
    board.close()
    board.close()
    assert threading.active_count() == before
    assert not Path(board.path).exists()


def test_a_host_that_goes_away_and_one_that_never_reads_do_not_stop_the_board():
    with open_board() as board:
        hello = struct.pack("<BH", 1, 1) + struct.pack("<BI", 1, 5)
        packet = stuffed(hello + struct.pack("<I", zlib.crc32(hello)))
        with opened(board.path) as deaf:
            for _ in range(100):
                os.write(deaf, packet)
        with open_sensor(board.url) as sensor:
            assert sensor.read("SMPL_PRD") == 1


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: open_board("serial:/dev/ttyUSB0"), "a test double is simulated"),
        (lambda: open_board("sim:?sede=1"), "seed"),
        (
            lambda: SimulatedBoard(SimulatedFirmware(ChipPins(open_simulated().chip, VirtualClock()))),
            "WorkClock",
        ),
    ],
)
def test_a_mistake_is_said_in_one_line(make, says):
    with pytest.raises(UsageError, match=says):
        make()
