"""Driver, pyserial and a pty, the firmware's binary on a second emulator, a second chip at its pins.

The rig shares no line with the simulator, nor with the rig in tests/firmware: what both get wrong, one mind
got wrong twice. Every test ends with the chip's own verdict on its pins (fixture make_board).
"""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.device.bus import SpiTiming
from adis_gonio.device.sensor import Adis16354
from firmware.captures import compare, exercise
from rig_simavr.board import violations
from rig_simavr.client import RATE_HZ, Streamed, open_board, stream


def test_registers_are_read_written_and_read_back(make_board):
    board = make_board(boot=0)
    with Adis16354(open_board(board)) as sensor:
        assert sensor.bus.firmware.board == "atmega328p"
        assert sensor.scan()["ZACCL_OUT"] == pytest.approx(-1000, abs=0.5)
        assert sensor.read("SMPL_PRD") == 1
        for name, number in {
            "XACCL_OFF": -1000,
            "ZGYRO_OFF": 4095,
            "SMPL_PRD": 3,
            "AUX_DAC": 0xABC,
        }.items():
            sensor.write(name, number)
            assert sensor.read(name) == number, name
        board.input("accl_x", 250.0)
        board.sleep_s(0.1)
        assert sensor.scan()["XACCL_OUT"] == pytest.approx(250 - 1000 * 0.4672, abs=0.5)


def test_the_slow_mode_gets_its_slow_frames(make_board):
    board = make_board(boot=0)
    with Adis16354(open_board(board)) as sensor:
        sensor.configure(smpl_prd=0x0A)
        board.forget_extremes()
        sensor.scan()
        slow = board.report()["extremes_us"]
        sensor.configure(smpl_prd=1)
        board.forget_extremes()
        sensor.scan()
        fast = board.report()["extremes_us"]
    assert slow["period"] >= 160
    assert slow["stall"] >= 75
    assert slow["sclk"] >= 3.34
    assert 40 <= fast["period"] < 45
    assert fast["stall"] >= 9
    assert fast["sclk"] == 1.0


@pytest.mark.parametrize(
    ("baud", "latency_ms"), [(500_000, 1), (490_000, 16), (510_000, 1)], ids=["exact", "slow", "fast"]
)
def test_no_scan_is_lost_or_repeated_whatever_the_baud_error_and_the_adapters_latency(
    make_board, baud, latency_ms
):
    board = make_board(baud=baud, latency_ms=latency_ms)
    got = stream(board, 5.0 if baud == 500_000 else 1.0)
    assert len(got.words) >= (4000 if baud == 500_000 else 700)
    assert (got.lost, got.skipped, got.repeated, got.mixed, got.stale) == (0, 0, 0, 0, 0)
    assert np.abs(np.diff(got.time_s) * RATE_HZ - 1).max() < 0.1
    report = got.report
    assert report["board_framing"] == report["host_framing"] == report["board_overruns"] == 0
    assert report["extremes_us"]["period"] >= 40
    assert report["extremes_us"]["stall"] >= 9


def test_a_resonator_that_is_half_a_percent_off_does_no_harm(make_board):
    got = stream(make_board(boot=0, cpu_ppm=5000), 0.6)
    assert got.sound
    assert len(got.words) > 400


def test_a_host_that_asks_for_too_quick_frames_is_seen_at_the_pins(make_board):
    board = make_board(sound=False, boot=0)
    bus = open_board(board)
    board.sleep_s(0.2)
    bus.configure(SpiTiming(clock_hz=1e6, stall_us=2, period_us=20))
    bus.exchange([0, 0, 0])
    found = violations(board.report())
    bus.close()
    assert found == {"stall": 2, "period": 2}


def test_lost_repeated_and_mixed_scans_are_seen_in_the_data():
    updates = np.array([[4094], [4095], [0], [2], [2], [3]]) + np.zeros(7, int)
    updates[5, 6] = 4
    starts = 100 * np.array([1, 2, 3, 4, 5, 6, 0])
    words = ((updates + starts) % 4096 | 0x8000).astype(np.uint16)
    words[4] &= 0x7FFF
    got = Streamed(words, np.arange(6.0), 0, 0, {"violations": {}})
    assert (got.skipped, got.repeated, got.mixed, got.stale, got.sound) == (1, 1, 1, 1, False)


def test_chip_select_rises_in_time_for_sleep(make_board):
    board = make_board(boot=0)
    with Adis16354(open_board(board)) as sensor:
        board.forget_extremes()
        sensor.sleep(0.5)
        asleep = board.report()
        assert asleep["extremes_us"]["select"] < 10
        board.sleep_s(0.2)
        assert board.report()["updates"] == asleep["updates"]
        sensor.wake()
        board.sleep_s(0.05)
        assert board.report()["updates"] > asleep["updates"]
        assert sensor.read("SMPL_PRD") == 1


def test_the_reset_line_restarts_the_chip(make_board):
    board = make_board(boot=0)
    with Adis16354(open_board(board)) as sensor:
        sensor.write("XACCL_OFF", 100)
        sensor.bus.hard_reset()
        board.sleep_s(0.3)
        assert sensor.read("XACCL_OFF") == 0


def test_opening_restarts_the_board_each_time_and_the_boot_loader_is_lived_through(make_board):
    board = make_board(latency_ms=16)
    for count in (1, 2):
        with Adis16354(open_board(board)) as sensor:
            assert sensor.read("SMPL_PRD") == 1
        report = board.report()
        assert report["openings"] == count
    assert report["boot"]["bytes"] > 0


def test_without_a_pull_up_the_boot_loaders_led_clocks_the_selected_chip(make_board):
    board = make_board(sound=False, cs_pull=0)
    open_board(board).close()
    assert "reset_traffic" in violations(board.report())
    open_board(board).close()  # by now the chip has started
    assert "clocks" in violations(board.report())


def test_a_line_that_is_six_percent_off_is_silence_not_nonsense(make_board):
    board = make_board(boot=0, baud=530_000)
    with pytest.raises(BusTimeoutError):
        open_board(board, boot_ms=700)
    assert board.report()["board_framing"] > 0
    assert board.report()["frames"] == 0


def test_a_capture_of_the_pins_has_the_frames_and_words_of_the_host(make_board, tmp_path):
    capture, recording = tmp_path / "pins.vcd", tmp_path / "host.rec"
    board = make_board(boot=0, vcd=capture)
    exercise(open_board(board), recording)
    board.report()
    assert compare(capture, recording) > 100
