"""The simulated bench: one part, one clock, one disk and one operator, and the real commands run on them.

`Bench.run` runs a command line of the package in this process, with virtual time, as a process of its own
would run: the part stays powered between two commands, files stay in the folder, and a killed command
leaves behind what a killed process leaves. Everything random is drawn from the seed of the bench.
"""

from __future__ import annotations

import gc
import io
import os
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np

from adis_gonio.base.errors import BusTimeoutError, ProtocolError
from adis_gonio.device.bus import FrameBlock
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.device.sensor.registers import READING_BITS
from adis_gonio.faces.cli import line_prompts, live_commands, main as run_program
from adis_gonio.sim import SimBus, SimulatedChip, State
from fakes.faulty_chip import FAULTS, CutStream, FaultyChip
from fakes.hand_part import HandPart, ShakenWorld
from simulated_bench.disk import Disk, DiskFault, Killed, OvertimeError, press_ctrl_c
from simulated_bench.operator_at_bench import DeadEndError, Operator
from simulated_bench.served import Client, virtual_serving

URL = "bench:"
BEGIN = datetime(2026, 1, 1, 8, 0, tzinfo=UTC)
PATIENCE_S = 3600.0
"""No command may take more virtual time than this beyond the operator's own pauses."""
HOST_LIMIT_S = 600.0
"""No command may take more processor time than this; the time of a stopped process does not count."""
UNREAD_S, UNREAD_SAMPLES = 300.0, 50_000
UNPLUGGED, BUSY, SHORT, LATE = "unplug", "busy", "short", "late"
NOISE, SHAKE, KILL = "noise-on-data-ready", "shake", "kill"
LINE_KINDS = (*FAULTS, UNPLUGGED, BUSY, SHORT, LATE, NOISE, SHAKE, KILL)
SHAKEN_MG = 30.0


@dataclass(frozen=True)
class LineFault:
    """A fault of line or device at a time in s after a command began; `size` is by kind.

    Kinds are those of `fakes.faulty_chip.FAULTS`, and `unplug` (until the command ends), `busy` (the bridge
    refuses a batch), `short` (a batch is answered with `size` words too few), `late` (a batch takes `size`
    seconds), `noise-on-data-ready` (a stream loses scans), `shake` (the table shakes for `size` seconds),
    `kill` (the program is killed).
    """

    kind: str
    at_s: float
    size: float = 1.0


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes
    ----------
    words : tuple of str
    how : str
        `exit`, `killed`, `cut`, `overtime`, `dead end` or `traceback`.
    status : int or None
        Exit status, if it came to one.
    out, err : str
        Standard output and standard error.
    began_s, ended_s : float
        Times on the clock of the bench.
    clients : tuple of str
        What each client of `serve` did and got.
    """

    words: tuple[str, ...]
    how: str
    status: int | None
    out: str
    err: str
    began_s: float
    ended_s: float
    clients: tuple[str, ...] = ()

    @property
    def last_line(self) -> str:
        """Last line of standard error."""
        lines = [line for line in self.err.splitlines() if line.strip()]
        return lines[-1].strip() if lines else ""


class _BenchChip(SimulatedChip):
    """A chip that counts its restarts, and does not compute the samples of a night without a reader.

    Attributes
    ----------
    sent : list of (frames, replies, times) or None
        All that it answered, while somebody wants to know.
    """

    restarts = 0
    sent: list[tuple[np.ndarray, np.ndarray, np.ndarray]] | None = None

    def frames_at(self, words, starts_s, *, clock_hz):
        replies = super().frames_at(words, starts_s, clock_hz=clock_hz)
        if self.sent is not None:
            self.sent.append((np.array(words), replies.copy(), np.array(starts_s)))
        return replies

    def hard_reset(self, time_s: float) -> None:
        super().hard_reset(time_s)
        self.restarts += 1

    def _sample_to(self, time_s: float) -> None:
        unread = int((time_s - self._epoch) / self.update_period_s) - self._k - UNREAD_SAMPLES
        if unread > 0 and self.state is State.RUNNING:
            self._k += unread
            self._updates += unread
            if self.data_ready_enabled:
                self._edges += unread
        super()._sample_to(time_s)


class _BenchWorld(ShakenWorld):
    """A world that does not compute the 1/f noise of a night, but draws its state in the morning."""

    def _flicker_at(self, time_s):
        flicker = self._flicker
        if flicker is not None:
            steps = int((time_s[0] - flicker._origin_s) / flicker._step_s) - len(flicker._grid)
            if steps * flicker._step_s > UNREAD_S:
                memory = flicker._memory**steps
                drawn = flicker._rng.standard_normal(flicker._state.shape)
                flicker._state = memory * flicker._state + np.sqrt(1 - memory**2) * drawn
                flicker._origin_s = float(np.floor(time_s[0]))
                flicker._grid = flicker._grid[:0]
        return super()._flicker_at(time_s)


class BenchBus(SimBus):
    """The bridge to the part: one process's opening of it, with faults of line and device."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(world=bench.world, chip=bench.chip, stream=bench.streams, url=URL)
        self.bench = bench
        self.hands = bench.world.stage
        self.world = None
        self.stage = _Motor(self) if bench.motor else None
        self._now = bench.now_s
        self._counted = bench.chip.data_ready_edges(bench.now_s)

    @property
    def virtual_time(self) -> bool:
        return False

    def witness(self, name: str, observe: Callable[[], Any]) -> Any:
        return self.bench.utc() if name == "utc" else observe()

    def _set_now(self, time_s: float) -> None:
        super()._set_now(time_s)
        self.bench.pass_to(self._now)

    def _exchange(self, frames):
        self._meet_faults()
        replies = super()._exchange(frames)
        self.bench.note_settings()
        short = self.bench.take_fault(SHORT)
        return replies if short is None else replies[: max(0, len(replies) - int(short.size))]

    def _meet_faults(self) -> None:
        bench = self.bench
        bench.require_alive()
        if bench.take_fault(KILL) is not None:
            bench.disk.die()
        if bench.unplugged:
            raise BusTimeoutError(f"{self.url}: no answer; is the cable plugged in?")
        if bench.take_fault(BUSY) is not None:
            raise ProtocolError(f"{self.url}: the bridge is busy and has sent nothing")
        late = bench.take_fault(LATE)
        if late is not None:
            self._set_now(self.now_s() + late.size)

    def stream(self, frames, *, block_scans: int = 256):
        self._meet_faults()
        super().stream(frames, block_scans=block_scans).close()
        self._stream = _Stream(self, np.array(frames, np.uint16), block_scans)
        return self._stream


class _Stream(CutStream):
    """A stream that ends with the cable, and loses scans by noise on data-ready."""

    def __next__(self):
        bus = self._bus
        bus._meet_faults()
        block = super().__next__()
        if bus.bench.unplugged:
            raise BusTimeoutError(f"{bus.url}: no answer; is the cable plugged in?")
        if bus.bench.take_fault(NOISE) is not None:
            keep = bus.bench.rng.random(len(block.words)) > 0.3
            lost = block.lost + int((~keep).sum())
            block = FrameBlock(block.words[keep], block.time_s[keep], lost)
        bus.bench.note_settings()
        bus.bench.delivered.append(block)
        return block


@dataclass(frozen=True)
class Held:
    """Settings of the part that shift or scale a reading, from a time in s on.

    Attributes
    ----------
    since_s : float
        Time at which they were first seen, at most one exchange too late.
    words : tuple of int
        Contents of the registers of `READING_BITS`.
    restarts : int
        Number of restarts of the part so far.
    """

    since_s: float
    words: tuple[int, ...]
    restarts: int


class _Motor:
    """A stage that the program moves, with the error of the fixture."""

    def __init__(self, bus: BenchBus) -> None:
        self._bus = bus

    def move_to(self, angle_deg: float, approach: int = 1) -> None:
        bus, bench = self._bus, self._bus.bench
        error_deg = bench.fixture_deg * bench.rng.standard_normal()
        bus._set_now(bus.hands.move_to(bench.may_move_s(), angle_deg + error_deg))


class Bench:
    """See the module.

    Parameters
    ----------
    seed : int
        Draws the part, its noise, the operator and the details of all faults.
    folder : Path
        Folder of all files; it becomes the working directory of the commands.
    motor : bool
        The program moves the stage instead of the operator.
    streams : bool
        The bridge can stream scans.
    plan, positions : str, int or None
        What the operator has on the wall.
    drift_c_per_h : float
        Drift of the ambient temperature.
    only : str
        The one kind of mistake that the operator makes; `none` for a perfect one.
    """

    fixture_deg = 0.02

    def __init__(
        self,
        seed: int,
        folder: Path,
        *,
        motor: bool = False,
        streams: bool = True,
        plan: str = "four-position",
        positions: int | None = None,
        drift_c_per_h: float = 0.0,
        only: str = "",
    ) -> None:
        self.folder, self.motor, self.streams = folder, motor, streams
        self.rng = np.random.default_rng([seed, 31])
        self.part = HandPart(seed)
        settings = replace(self.part.settings, ambient_drift_c_per_h=drift_c_per_h)
        self.world = _BenchWorld(settings, seed=seed)
        chip = _BenchChip(self.world, self.world.variant, start_s=-0.5)
        self.chip = FaultyChip(chip, np.random.default_rng([seed, 32]))
        self.now_s = 0.0
        self.disk = Disk(folder, np.random.default_rng([seed, 33]), self.advance)
        self.operator = Operator(self, seed, plan, positions, only)
        self.delivered: list[FrameBlock] = []
        self.clients: list[Client] = []
        self.held: list[Held] = []
        self.note_settings()
        self._line: list[LineFault] = []
        self._began_s = self._limit_s = 0.0
        self.unplugged = False
        self._interrupts: list[float] = []

    # -- time ------------------------------------------------------------------------------------------

    begin_ns = round(BEGIN.timestamp()) * 10**9
    """Time in ns since 1970 at which the clock of the bench began."""

    def utc(self) -> str:
        """UTC of the bench as ISO 8601 text, as the archive writes it."""
        return (BEGIN + timedelta(seconds=self.now_s)).isoformat(timespec="milliseconds")

    def advance(self, seconds: float) -> None:
        """Let time pass without frames."""
        self.pass_to(self.now_s + seconds)
        for bus in self._buses:
            bus._now = max(bus._now, self.now_s)

    _buses: tuple[BenchBus, ...] = ()

    def pass_to(self, time_s: float) -> None:
        """Let the clock reach a time: faults begin, Ctrl-C comes, patience ends."""
        self.now_s = max(self.now_s, time_s)
        for fault in [f for f in self._line if f.kind == UNPLUGGED and self._due(f)]:
            self._line.remove(fault)
            self.unplugged = True
        if self.now_s > self._limit_s:
            raise OvertimeError(f"{self.now_s - self._began_s:.0f} s of virtual time")
        due = self._interrupts and self.now_s >= self._interrupts[0] and not self.disk.dead
        if due and threading.current_thread() is threading.main_thread():
            self._interrupts.pop(0)
            press_ctrl_c()

    def next_event_s(self, timeout_s: float | None) -> float:
        """Time in s at which a program that waits for so long goes on; Ctrl-C ends the wait."""
        end_s = np.inf if timeout_s is None else self.now_s + timeout_s
        return min([end_s, *self._interrupts])

    def interrupt_in(self, seconds: float) -> None:
        """Let Ctrl-C come after some seconds."""
        self._interrupts = sorted([*self._interrupts, self.now_s + seconds])

    def unplug_in(self, seconds: float) -> None:
        """Let the cable come out after some seconds."""
        self._line.append(LineFault(UNPLUGGED, self.now_s + seconds - self._began_s))

    def be_patient(self, seconds: float) -> None:
        """Let the command wait for so much longer, because the operator has gone."""
        self._limit_s += seconds

    def may_move_s(self) -> float:
        """Earliest time in s at which the stage can begin to move."""
        return max(self.now_s, self.chip.inner.time_s, self.world.stage.still_at_s)

    # -- faults ----------------------------------------------------------------------------------------

    def _due(self, fault: LineFault) -> bool:
        return self.now_s >= self._began_s + fault.at_s

    def take_fault(self, kind: str) -> LineFault | None:
        """Return and forget a fault of a kind that is due now; None if there is none."""
        due = next((fault for fault in self._line if fault.kind == kind and self._due(fault)), None)
        if due is not None:
            self._line.remove(due)
        return due

    def require_alive(self) -> None:
        """Raise `Killed` if the program has been killed."""
        if self.disk.dead:
            raise Killed

    def switch_part_off_and_on(self) -> None:
        """The part loses its power for a moment, between two commands."""
        self.chip.actions.clear()
        self.chip.inner.hard_reset(max(self.now_s, self.chip.inner.time_s))
        self.now_s = max(self.now_s, self.chip.inner.time_s) + 1.0
        self.note_settings()

    def lose_power(self) -> None:
        """Computer and part lose their power right after a command, and have it again."""
        self.disk.lose_power()
        self.switch_part_off_and_on()

    def note_settings(self) -> None:
        """Note the settings of the part if they have changed."""
        chip = self.chip.inner
        now = tuple(chip.memory[name] & bits for name, bits in READING_BITS.items()), chip.restarts
        if not self.held or now != (self.held[-1].words, self.held[-1].restarts):
            self.held.append(Held(self.now_s, *now))

    def held_between(self, begin_s: float, end_s: float) -> list[Held]:
        """Settings of the part from a time to a later one, in order."""
        earlier = [held for held in self.held if held.since_s <= begin_s][-1:]
        return earlier + [held for held in self.held if begin_s < held.since_s <= end_s]

    def wait(self, seconds: float) -> None:
        """Let time pass between two commands, in which all data reaches the disk."""
        self.now_s += seconds
        self.disk.rest()

    # -- commands --------------------------------------------------------------------------------------

    def run(
        self,
        words: Sequence[str],
        *,
        line: Sequence[LineFault] = (),
        disk: DiskFault | None = None,
        interrupt_s: float | None = None,
        patience_s: float = PATIENCE_S,
        draw: int = 0,
    ) -> Ended:
        """Run a command line as a process of its own, with faults, to its end; `draw` draws clients."""
        self._line = list(line)
        self._began_s, self._limit_s, self.unplugged = self.now_s, self.now_s + patience_s, False
        self._interrupts = [] if interrupt_s is None else [self.now_s + interrupt_s]
        self.chip.cut_s = np.inf
        self.delivered.clear()
        for fault in line:
            if fault.kind == SHAKE:
                self.world.shakes += ((self.now_s + fault.at_s, SHAKEN_MG, fault.size),)
            if fault.kind in FAULTS:
                FAULTS[fault.kind](self.chip, self.now_s + fault.at_s)
        self.chip.actions.sort(key=lambda action: action[0])
        self.disk.begin(disk)
        out, err = io.StringIO(), io.StringIO()
        how, status = "exit", None
        serves = words[0] == "serve"
        self.clients, self.chip.inner.sent = [], [] if serves else None
        with (
            self._surroundings(out, err),
            virtual_serving(self, draw) if serves else nullcontext(),
        ):
            try:
                status = run_program(list(words))
            except Killed:
                how = "cut" if disk is not None and disk.kind == "cut" else "killed"
            except OvertimeError as error:
                how = "overtime"
                err.write(str(error))
            except DeadEndError as error:
                how = "dead end"
                err.write(str(error))
            except Exception:
                how = "traceback"
                err.write(traceback.format_exc())
        self._buses = ()
        if self.disk.dead:
            gc.collect()  # connections of a killed program are closed before its files are as it left them
        self.disk.end()
        self._end_line()
        told = tuple(client.told for client in self.clients)
        return Ended(
            tuple(words), how, status, out.getvalue(), err.getvalue(), self._began_s, self.now_s, told
        )

    def _end_line(self) -> None:
        """Faults that have not come by the end of a command never come; the cable is in again."""
        self.chip.actions.clear()
        self.chip.windows = [window for window in self.chip.windows if window.begin_s < self.now_s]
        self.chip.windows = [replace(w, end_s=min(w.end_s, self.now_s)) for w in self.chip.windows]
        shakes = [shake for shake in self.world.shakes if shake[0] < self.now_s]
        self.world.shakes = tuple((at_s, mg, min(long_s, self.now_s - at_s)) for at_s, mg, long_s in shakes)
        self.unplugged, self._line, self._limit_s = False, [], np.inf

    @contextmanager
    def _surroundings(self, out: io.StringIO, err: io.StringIO) -> Iterator[None]:
        _OPEN.append(self)
        here = Path.cwd()
        os.chdir(self.folder)
        clock = SimpleNamespace(sleep=self.advance, monotonic=lambda: self.now_s)
        handler = signal.signal(signal.SIGINT, signal.default_int_handler)
        alarm = signal.signal(signal.SIGPROF, _host_overtime)
        signal.setitimer(signal.ITIMER_PROF, HOST_LIMIT_S)
        try:
            with ExitStack() as stack:
                enter = stack.enter_context
                enter(redirect_stdout(out))
                enter(redirect_stderr(err))
                enter(mock.patch.object(sys, "path", [_package_of_scheme().name, *sys.path]))
                enter(mock.patch.object(sys, "stdin", io.StringIO()))
                enter(mock.patch.dict(os.environ, {"TERM": "dumb", "COLUMNS": "200"}))
                ears = self.operator.listening(err)
                enter(mock.patch.object(line_prompts, "Lines", return_value=ears))
                enter(mock.patch.object(live_commands, "time", clock))
                for name, module in list(sys.modules.items()):
                    if name.startswith("adis_gonio") and hasattr(module, "utc_now"):
                        enter(mock.patch.object(module, "utc_now", self.utc))
                enter(self.disk.hooked())
                yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, alarm)
            signal.signal(signal.SIGINT, handler)
            os.chdir(here)
            _OPEN.pop()

    def open(self) -> BenchBus:
        """Open the bridge, as the program does by its URL."""
        bus = BenchBus(self)
        self._buses = (*self._buses, bus)
        bus._meet_faults()
        return bus

    # -- what is known of the part ----------------------------------------------------------------------

    def truth(self, times_s: Sequence[float]) -> dict[str, float]:
        """True parameters of the part at the mean of some times."""
        return self.world.truth(np.asarray(times_s))


_OPEN: list[Bench] = []


def open_from_url(url: BusUrl) -> BenchBus:
    """Open the bridge of the bench whose command runs."""
    return _OPEN[-1].open()


def _host_overtime(number: int, frame: object) -> None:
    raise OvertimeError(f"{HOST_LIMIT_S:g} s of processor time")


@cache
def _package_of_scheme() -> tempfile.TemporaryDirectory[str]:
    """Folder with the metadata of a package that registers `bench:` while it is on the path."""
    folder = tempfile.TemporaryDirectory()
    info = Path(folder.name) / "simulated_bench-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: simulated-bench\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[adis_gonio.bus]\nbench = simulated_bench.bench:open_from_url\n"
    )
    return folder
