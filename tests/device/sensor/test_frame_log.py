"""The log of a recording or capture: register names, decoded words, broken rules of timing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import DataError
from adis_gonio.device.bus import FrameBlock, SpiTiming
from adis_gonio.device.bus.capture import LogicCapture
from adis_gonio.device.bus.recording import BusRecording, Call, RecordingBus
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.frame_log import FrameLog, FrameRow
from adis_gonio.device.sensor.registers import variant
from adis_gonio.faces.cli import main
from adis_gonio.sim import SimBus, World


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "run.rec"
    with Adis16354(RecordingBus(SimBus(World(seed=3)), path)) as sensor:
        sensor.read_all()
        sensor.scan()
        sensor.reset()
        sensor.scan()
    return path


def rows_of(path: Path) -> list[FrameRow]:
    return list(FrameLog(variant("adis16354")).rows(BusRecording(path)))


def test_the_log_names_registers_and_decodes_words(recorded: Path) -> None:
    rows = rows_of(recorded)
    assert not any(row.problem for row in rows)
    accel = [row for row in rows if row.register == "XACCL_OUT" and row.word is not None]
    assert accel
    for row in accel:
        number = (row.word & 0x3FFF) - (0x4000 if row.word & 0x2000 else 0)
        assert float(row.value.split()[0]) == pytest.approx(number * 0.4672, rel=1e-5)
    written = [row for row in rows if row.action == "write"]
    assert "COMMAND" in {row.register for row in written}
    assert any("reset" in row.value for row in written)


def test_the_log_shows_addresses_without_a_register_and_answers_of_the_bus(tmp_path: Path) -> None:
    path = tmp_path / "run.rec"
    with RecordingBus(SimBus(World(seed=3)), path) as bus:
        bus.exchange([0x1800, 0x0000])  # address 0x18 is reserved
        bus.sleep_s(0.25)
        edges = bus.read_event_counter()
    rows = rows_of(path)
    first, last = (row.time_s for row in rows if row.frame is not None)
    assert last - first == pytest.approx(bus.timing.frame_s)
    assert [row.register for row in rows if row.frame == 0x1800] == ["0x18"]
    assert [row.word is None for row in rows if row.frame is not None] == [False, True]  # one frame late
    values = {row.action: row.value for row in rows}
    assert values["sleep_s"] == "0.25"
    assert values["read_event_counter"] == f" → {edges}"


@pytest.mark.parametrize(
    ("lost", "value"), [(0, "3 scans of 2 words"), (4, "3 scans of 2 words, 4 lost before their end")]
)
def test_the_log_counts_the_scans_of_a_block_and_the_lost_ones(lost: int, value: str) -> None:
    block = FrameBlock(np.zeros((3, 2), np.uint16), np.arange(3.0), lost)
    (row,) = FrameLog(variant("adis16354")).rows([Call(7, "block", 0.0, 3.5, result=block)])
    assert (row.record, row.time_s, row.action, row.value) == (7, 3.5, "block", value)


@pytest.mark.parametrize(
    ("smpl_prd", "timing", "problem"),
    [
        # Fast mode: at most 2 MHz, at least 40 µs a frame and 9 µs between frames, each within 1 %.
        (0x09, SpiTiming(2.01e6, 32.0, 40.0), ""),
        (0x09, SpiTiming(2.03e6, 32.0, 40.0), "clock 2030 kHz, at most 2000 kHz"),
        (0x09, SpiTiming(1e6, 9.0, 39.7), ""),
        (0x09, SpiTiming(1e6, 9.0, 39.5), "period 39.5 µs, at least 40 µs"),
        (0x09, SpiTiming(250e3, 8.95, 72.95), ""),
        (0x09, SpiTiming(250e3, 8.8, 72.8), "stall 8.8 µs, at least 9 µs"),
        # Normal mode: 300 kHz, 160 µs, 75 µs.
        (0x0A, SpiTiming(302e3, 107.0, 160.0), ""),
        (0x0A, SpiTiming(304e3, 107.0, 160.0), "clock 304 kHz, at most 300 kHz"),
        (0x0A, SpiTiming(250e3, 75.0, 159.0), ""),
        (0x0A, SpiTiming(250e3, 75.0, 158.0), "period 158 µs, at least 160 µs"),
        (0x0A, SpiTiming(100e3, 74.5, 235.0), ""),
        (0x0A, SpiTiming(100e3, 74.0, 235.0), "stall 74 µs, at least 75 µs"),
    ],
)
def test_the_log_finds_frames_that_break_a_rule_of_timing(
    smpl_prd: int, timing: SpiTiming, problem: str
) -> None:
    facts = {"clock_hz": timing.clock_hz, "stall_us": timing.stall_us, "period_us": timing.period_us}
    mode = np.array([0xB600 | smpl_prd], np.uint16)
    calls = [
        Call(1, "exchange", 0.0, 0.1, mode, result=np.zeros(1, np.uint16)),
        Call(2, "configure", 0.1, 0.1, result=facts),
        Call(3, "exchange", 0.2, 0.3, np.array([0x0A00], np.uint16), result=np.zeros(1, np.uint16)),
    ]
    *_, row = FrameLog(variant("adis16354")).rows(calls)
    assert (row.register, row.problem) == ("XACCL_OUT", problem)


@pytest.mark.parametrize(
    ("command", "busy_s"),
    [(0x80, 0.15), (0x02, 0.15), (0x08, 0.1), (0x01, 0.1), (0x10, 30.1), (0x04, 0.0)],
)
def test_the_log_finds_frames_while_the_chip_carries_out_a_command(command: int, busy_s: float) -> None:
    def frame(number: int, time_s: float, word: int) -> Call:
        return Call(
            number, "exchange", time_s, time_s, np.array([word], np.uint16), result=np.zeros(1, np.uint16)
        )

    log = FrameLog(variant("adis16354"))
    calls = [frame(1, 0.0, 0xBE00 | command), frame(2, busy_s - 0.02, 0x0A00), frame(3, busy_s, 0x0C00)]
    _, during, after = log.rows(calls)
    assert during.problem.startswith("sent 0.02 s before the end of" if busy_s else "")
    assert bool(during.problem) == bool(busy_s)
    assert not after.problem


@pytest.mark.parametrize("way", ["command", "hard"])
def test_the_log_judges_no_timing_after_a_reset_until_the_mode_is_read(tmp_path: Path, way: str) -> None:
    path = tmp_path / "reset.rec"
    with RecordingBus(SimBus(World(seed=1)), path) as bus:
        bus.exchange([0xB60A, 0x0A00])  # normal mode
        bus.configure(SpiTiming(1e6, 9.0, 40.0))
        bus.exchange([0x0A00, 0xBE80 if way == "command" else 0x0000])
        if way == "hard":
            bus.hard_reset()
        bus.sleep_s(0.3)
        bus.exchange([0x0C00, 0xB60A, 0x0E00])
    problems = [
        row.problem for row in rows_of(path) if row.register in ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT")
    ]
    assert [bool(problem) for problem in problems] == [False, True, False, True]


def test_the_log_finds_frames_too_soon_after_a_hard_reset(tmp_path: Path) -> None:
    path = tmp_path / "reset.rec"
    with RecordingBus(SimBus(World(seed=1)), path) as bus:
        bus.hard_reset()
        bus.exchange([0x0A00, 0x0000])
        bus.sleep_s(0.5)
        bus.exchange([0x0C00, 0x0000])
    problems = {row.register: row.problem for row in rows_of(path) if row.frame}
    assert "before the end of a hard reset" in problems["XACCL_OUT"]
    assert not problems["YACCL_OUT"]


def test_the_command_lists_frames(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(recorded)
    assert main(["frames", path]) == 0
    lines = capsys.readouterr().out.splitlines()
    sample_rate = [line for line in lines if "SMPL_PRD" in line]
    assert sample_rate
    assert max(map(len, sample_rate)) <= 80
    assert not [line for line in lines if "!" in line]
    Path(path).write_bytes(Path(path).read_bytes()[:-3])
    assert main(["frames", path]) == 1
    assert path in capsys.readouterr().err


def write_vcd(path: Path, frames: list[tuple[float, float, int, int, int]], names: str) -> None:
    """Write frames (begin in µs, clock in kHz, frame, reply, bits) in steps of 10 ns."""
    cs, clock, mosi, miso = names.split()
    lines = ["$timescale 10 ns $end", "$scope module top $end"]
    lines += [
        f"$var wire 1 {code} {name} $end"
        for code, name in zip("!#%&", (cs, clock, mosi, miso), strict=True)
    ]
    lines += ["$upscope $end", "$enddefinitions $end", "$dumpvars", "1!", "1#", "0%", "z&", "$end"]
    changes: list[tuple[int, str]] = []
    for begin_us, khz, frame, reply, bits in frames:
        half = 1e5 / khz / 2
        at = begin_us * 100
        changes.append((round(at), "0!"))
        for k in range(bits):
            down = at + 20 + 2 * half * k
            changes += [(round(down), "0#"), (round(down) + 1, f"{frame >> (15 - k) & 1}%")]
            changes += [(round(down) + 1, f"{reply >> (15 - k) & 1}&"), (round(down + half), "1#")]
        changes += [
            (round(at + 20 + 2 * half * bits) + 5, "1!"),
            (round(at + 20 + 2 * half * bits) + 6, "z&"),
        ]
    for time, change in changes:
        lines += [f"#{time}", change]
    path.write_text("\n".join(lines) + "\n")


def test_a_capture_of_a_logic_analyser_is_decoded_and_judged_by_its_own_times(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "capture.VCD"
    frames = [
        (100, 1000, 0x3600, 0x0402, 16),  # read SMPL_PRD
        (150, 1000, 0x0A00, 0x0001, 16),  # its word is 1: fast mode; read XACCL_OUT
        (200, 1000, 0x0C00, 0x8852, 16),
        (235, 1000, 0x0E00, 0x0000, 16),  # a period of 35 µs is too short
        (300, 3000, 0x0200, 0x0000, 16),  # 3 MHz are too fast
        (400, 1000, 0x1000, 0x0000, 15),  # one clock is missing
        (500, 1000, 0x0000, 0x0000, 16),
    ]
    write_vcd(path, frames, "CS SCLK MOSI MISO")
    assert main(["frames", str(path), "--json"]) == 1
    document = json.loads(capsys.readouterr().out)
    rows = document["frames"]
    assert [row["frame"] for row in rows if row["register"] != "XTEMP_OUT"][:5] == [
        f[2] for f in frames[:5]
    ]
    by_name = {row["register"]: row for row in rows}
    assert by_name["SMPL_PRD"]["word"] == 1
    assert by_name["XACCL_OUT"]["value"].startswith("995.136 mg")
    assert by_name["XACCL_OUT"]["time_s"] == pytest.approx(150e-6)
    for name in ("SMPL_PRD", "XACCL_OUT", "YACCL_OUT"):
        assert not by_name[name]["problem"]
    assert "period 35 µs" in by_name["ZACCL_OUT"]["problem"]
    assert "3000 kHz" in by_name["SUPPLY_OUT"]["problem"]
    assert sum("15 clocks" in row["problem"] for row in rows) == 1
    assert document["problems"] == 3


def test_a_capture_without_a_signal_names_the_signals_that_it_has(tmp_path: Path) -> None:
    path = tmp_path / "capture.vcd"
    write_vcd(path, [], "CS D1 MOSI MISO")
    assert main(["frames", str(path)]) == 1
    with pytest.raises(DataError, match=r"sclk.*d1"):
        LogicCapture(path)
    path.write_text("time,cs,sclk\n0,1,1\n")
    with pytest.raises(DataError, match="no VCD file"):
        LogicCapture(path)


def test_of_two_signals_for_one_line_the_more_usual_name_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "capture.vcd"
    write_vcd(path, [(100, 1000, 0x3600, 0x0402, 16)], "CS SCLK MOSI MISO")
    path.write_text(path.read_text().replace("$upscope", "$var wire 1 ( CLK $end\n$upscope"))
    rows = FrameLog(variant("adis16354")).rows(LogicCapture(path))
    assert [row.frame for row in rows if row.frame is not None] == [0x3600]
