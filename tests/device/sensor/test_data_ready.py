"""Data-ready: which edge leads the update, what else may be on the line, and what is left behind."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import BusError, ChipError, SilentChipError
from adis_gonio.bench.events import Configured, Problem
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.bus import BusUrl, Capability, FrameBlock, FrameStream, serial
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, ND
from adis_gonio.device.sensor.scanning import JUDGED_SCANS, MASK, PolledScans, ScanLayout, StreamedScans
from adis_gonio.record.plans import plan
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins
from fakes.serial_port import FakePort
from fakes.virtual_clock import VirtualClock

SEED = 4
EDGES = ("first", "last")
SHORT = Settings(dwell_s=0.5, settle_s=0.1)


class Board:
    """Firmware with a chip; `wired` joins its data-ready line, `noise_hz` is on the input otherwise."""

    def __init__(self, monkeypatch, *, wired=True, noise_hz=0.0, options="", **chip):
        self.clock = VirtualClock()
        self.chip = SimulatedChip(World(seed=SEED), start_s=-0.5, **chip)
        pins = ChipPins(self.chip, self.clock)
        if not wired:
            monkeypatch.setattr(pins, "data_ready_edges", lambda: int(noise_hz * self.clock.now_s()))
        port = FakePort(SimulatedFirmware(pins))
        self.bus = serial.open_from_url(BusUrl.parse(f"serial:x{options}"), port=port, clock=self.clock)
        self.chip.run_to(self.clock.now_s())

    @property
    def msc_ctrl(self) -> int:
        return self.chip.memory["MSC_CTRL"]


@pytest.mark.parametrize("options", ["", "?edge=rising"])
@pytest.mark.parametrize("real", EDGES)
def test_no_scan_has_an_update_in_it_whichever_edge_marks_it(monkeypatch, real, options):
    board = Board(monkeypatch, update_edge=real, options=options)
    with Adis16354(board.bus) as sensor:
        with sensor.stream(block_scans=64) as stream:
            assert isinstance(stream, StreamedScans)
            blocks = [next(stream) for _ in range(3)]
            assert board.chip.edge_after_update_s(rising=bool(options)) >= 0
        assert sum(block.dropped + block.lost for block in blocks) == 0
        loan = sensor.lend_data_ready()
        assert loan.edge == real
        loan.give_back()
    assert board.msc_ctrl == 0


@pytest.mark.parametrize("real", EDGES)
def test_the_simulated_bus_starts_scans_at_the_edge_that_its_chip_makes(real):
    world = World(seed=SEED)
    chip = SimulatedChip(world, start_s=-0.5, update_edge=real)
    with Adis16354(SimBus(world=world, chip=chip)) as sensor:
        assert sensor.lend_data_ready(ACCEL_OUT).edge == real


def test_a_stream_at_the_wrong_edge_is_an_error_where_no_register_may_be_written(monkeypatch):
    board = Board(monkeypatch, update_edge="last")
    with Adis16354(board.bus) as sensor:
        sensor.configure(data_ready=True)
        with pytest.raises(ChipError, match="updates fall into scans"):
            sensor.stream(leave_registers=True)
    assert board.msc_ctrl == 0x04


@pytest.mark.parametrize("noise_hz", [50.0, 400.0, 2000.0, 16000.0])
def test_edges_at_another_rate_than_the_samples_are_refused_and_the_register_is_set_back(
    monkeypatch, noise_hz
):
    board = Board(monkeypatch, wired=False, noise_hz=noise_hz)
    with Adis16354(board.bus) as sensor:
        sensor.configure(linear_g=True)
        with pytest.raises(ChipError, match=r"edges a second.*819\.2 times") as caught:
            sensor.stream()
        assert "\n" not in str(caught.value)
        told = float(str(caught.value).split()[1])
        assert told == pytest.approx(noise_hz, rel=0.02, abs=11)  # one edge in 0.1 s
        assert board.msc_ctrl == 0x80
        sensor.configure(data_ready=True)
        with pytest.raises(ChipError, match="edges a second"):
            sensor.stream(leave_registers=True)
        assert board.msc_ctrl == 0x84


@pytest.mark.parametrize("off", [-0.05, 0.05])
def test_a_chip_whose_clock_is_some_percent_off_is_believed(monkeypatch, off):
    from adis_gonio.sim import chip

    nominal = chip.chip_memory.update_period_s
    monkeypatch.setattr(chip.chip_memory, "update_period_s", lambda word: nominal(word) * (1 + off))
    board = Board(monkeypatch)
    with Adis16354(board.bus) as sensor, sensor.stream() as stream:
        assert isinstance(stream, StreamedScans)


def test_edges_at_the_right_rate_that_are_not_the_updates_are_found_by_nd(monkeypatch):
    """Some other thing pulses 800 times a second: the count passes, the scans do not."""
    board = Board(monkeypatch)
    chip, offsets = board.chip, iter(np.random.default_rng(1).uniform(-0.9e-3, 0.0, 100_000))
    next_edge = chip.next_edge_s

    def anywhere(after_s, *, rising):
        return max(after_s + 1e-6, next_edge(after_s, rising=rising) + next(offsets))

    monkeypatch.setattr(chip, "next_edge_s", anywhere)
    with Adis16354(board.bus) as sensor, pytest.raises(ChipError, match="updates fall into scans"):
        sensor.stream()
    assert board.msc_ctrl == 0


def test_without_the_wire_a_stream_polls_says_why_counts_by_time_and_leaves_the_register(monkeypatch):
    board = Board(monkeypatch, wired=False)
    with Adis16354(board.bus) as sensor:
        sensor.configure(data_ready=True)
        with sensor.stream(leave_registers=True) as stream:
            assert isinstance(stream, PolledScans)
            assert len(next(stream)) > 0
        assert board.msc_ctrl == 0x04
        sensor.configure(data_ready=False)
        with sensor.stream() as stream:
            assert stream.how.startswith("no data-ready edge arrives: polling")
            last_s = next(stream).time_s[-1]
            updates = 0
            for _ in range(3):
                sensor.bus.sleep_s(20 / 819.2)
                block = next(stream)
                updates += len(block) + block.lost
            # Counted by time: the bridge's counter of edges has nothing to count.
            assert updates == pytest.approx((block.time_s[-1] - last_s) * 819.2, abs=5)
    assert board.msc_ctrl == 0


def test_a_bus_that_streams_but_does_not_count_edges_is_believed():
    bus = SimBus(world=World(seed=SEED), stream=True)
    bus.capabilities = frozenset({Capability.STREAM})
    with Adis16354(bus) as sensor, sensor.stream() as stream:
        assert isinstance(stream, StreamedScans)


class Played(FrameStream):
    """A stream of given words."""

    def __init__(self, words: np.ndarray, size: int) -> None:
        self.words, self.size = words, size

    def __next__(self) -> FrameBlock:
        part, self.words = self.words[: self.size], self.words[self.size :]
        return FrameBlock(part, np.arange(len(part)) * 1e-3, 0)

    def close(self) -> None:
        pass


def layout(names=ACCEL_OUT) -> ScanLayout:
    from adis_gonio.device.sensor.registers import registers

    return ScanLayout(registers(names), "adis16354", 300, 1e-3)


def test_scans_without_news_are_left_out_and_counted():
    words = np.full((60, 3), ND, np.uint16)
    words[[5, 17, 40], 1] = 7  # old in one register is old
    stream = StreamedScans(Played(words, 20), layout())
    blocks = [next(stream) for _ in range(3)]
    assert [len(block) for block in blocks] == [18, 20, 19]
    assert [block.dropped for block in blocks] == [2, 0, 1]
    assert all((block.words & ND).all() for block in blocks)


def test_the_first_error_in_a_stream_counts_and_a_failed_restoration_is_not_hidden():
    def fail():
        raise BusError("data-ready stays on")

    def stream():
        return StreamedScans(Played(np.full((9, 3), ND, np.uint16), 3), replace(layout(), at_end=fail))

    with pytest.raises(ZeroDivisionError), stream():
        raise ZeroDivisionError
    with pytest.raises(BusError, match="stays on"), stream() as scans:
        next(scans)


@pytest.mark.parametrize(
    ("ones", "names", "stuck"),
    [
        (8, ACCEL_OUT, True),
        (7, ACCEL_OUT, False),
        # One LSB below zero with an error flag: that is likely enough for two registers.
        (8, ACCEL_OUT[:2], False),
    ],
)
def test_eight_scans_of_ones_in_three_registers_prove_a_stuck_line(ones, names, stuck):
    words = np.full((40, len(names)), ND, np.uint16)
    words[14 : 14 + ones] = 0xFFFF  # in two blocks
    stream = StreamedScans(Played(words, 10), layout(names))
    assert len(next(stream)) == len(next(stream)) == 10
    if stuck:
        with pytest.raises(SilentChipError, match="stuck high"):
            next(stream)
    else:
        assert len(next(stream)) == len(next(stream)) == 10


def test_many_scans_without_news_end_the_stream_even_after_a_good_beginning():
    words = np.full((400, 3), ND, np.uint16)
    words[100:200:4, 0] = 7  # three new scans of four are enough
    words[201::4, 0] = words[202::12, 0] = 7
    stream = StreamedScans(Played(words, 10), layout())
    assert sum(next(stream).dropped for _ in range(20)) == 25
    with pytest.raises(ChipError, match=f"of {JUDGED_SCANS} scans"):
        list(stream)


# -- sessions ---------------------------------------------------------------------------------------------


def run(sensor: Adis16354, path: Path, resume: bool = False) -> list:
    made = (
        SessionRunner.resume(sensor, path) if resume else SessionRunner.begin(sensor, path, plan(), SHORT)
    )
    events = []
    for event in made.run(so_far=False):
        events.append(event)
        if type(event).__name__ == "PositionAsked":
            made.answer("confirm")
        elif type(event).__name__ == "ExtensionOffered":
            made.answer("decline")
        elif type(event).__name__ == "GuardRaised":  # nothing turns this board's part
            made.answer("keep")
    return events


def test_a_session_streams_where_the_line_is_wired_and_leaves_the_register_as_it_was(monkeypatch, tmp_path):
    board = Board(monkeypatch)
    with Adis16354(board.bus) as sensor:
        sensor.configure(linear_g=True)
        events = run(sensor, tmp_path / "a.session")
        assert board.msc_ctrl == 0x80
    (configured,) = [event for event in events if isinstance(event, Configured)]
    assert configured.why_polled == ""
    facts = read_session(tmp_path / "a.session").facts
    assert "data-ready edge" in facts["scanning"]["how"]
    assert facts["registers"]["configured"]["MSC_CTRL"] == 0x84
    assert facts["registers"]["after"]["MSC_CTRL"] == 0x80
    assert [dwell["dropped"] for dwell in facts["dwells"]] == [0, 0]


def test_a_session_without_the_wire_polls_says_so_and_leaves_the_register(monkeypatch, tmp_path):
    board = Board(monkeypatch, wired=False)
    with Adis16354(board.bus) as sensor:
        sensor.configure(data_ready=True)
        events = run(sensor, tmp_path / "a.session")
        assert board.msc_ctrl == 0x04
    (configured,) = [event for event in events if isinstance(event, Configured)]
    assert "no data-ready edge arrives" in configured.why_polled
    assert "polling" in read_session(tmp_path / "a.session").facts["scanning"]["how"]


def test_a_session_may_be_resumed_where_the_wire_has_come_off(monkeypatch, tmp_path):
    path = tmp_path / "a.session"
    with Adis16354(Board(monkeypatch).bus) as sensor:
        runner = SessionRunner.begin(sensor, path, plan(), SHORT)
        for event in runner.run(so_far=False):
            if type(event).__name__ == "PositionAsked":
                runner.answer("confirm" if event.place == 0 else "stop")
    with Adis16354(Board(monkeypatch, wired=False).bus) as sensor:
        assert run(sensor, path, resume=True)[-1].complete


def test_noise_on_the_line_ends_a_session_before_it_measures_and_sets_the_register_back(
    monkeypatch, tmp_path
):
    board = Board(monkeypatch, wired=False, noise_hz=2000.0)
    with Adis16354(board.bus) as sensor, pytest.raises(ChipError, match="2000 edges a second"):
        run(sensor, tmp_path / "a.session")
    assert board.msc_ctrl & MASK == 0


def test_dropped_scans_are_told_and_kept_in_the_session(monkeypatch, tmp_path):
    from dataclasses import replace

    board = Board(monkeypatch)
    with Adis16354(board.bus) as sensor:
        following = StreamedScans._next
        monkeypatch.setattr(StreamedScans, "_next", lambda s: replace(following(s), dropped=1))
        events = run(sensor, tmp_path / "a.session")
    problems = [event for event in events if isinstance(event, Problem)]
    assert [problem.kind for problem in problems] == ["dropped", "dropped"]
    session = read_session(tmp_path / "a.session")
    counts = [dwell["dropped"] for dwell in session.facts["dwells"]]
    assert all(2 <= count <= 8 for count in counts)
    said = f"{sum(counts)} scans within the dwells left out"
    assert any(note.startswith(said) for note in session.notes)
