"""Boards as an engineer may find them: a simulated part, and what is wrong between it and the host.

`Board` holds the figures of part and wiring; `SOUND` is a board with nothing wrong, `FAULTY` boards that
differ from it in one way each, with the step of the bring-up that has to name it. What a part does
(offsets, STATUS, self-test) is made here as well, whatever the simulated chip's defaults are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.errors import BusTimeoutError, UsageError
from adis_gonio.device.bus import Capability, FrameBlock, FrameStream, Words
from adis_gonio.device.sensor.registers import ACCEL_OUT, BY_NAME, variant
from adis_gonio.sim import SimBus, SimulatedChip, World, WorldSettings
from adis_gonio.sim.sampling import ACCEL_COLUMNS, SELF_TEST_ACCEL_MG, Inputs, SignalChain

TRIGGER_S = 4e-6
"""From an edge to the fall of chip select."""
_STATUS, _MISC = BY_NAME["STATUS"], BY_NAME["MSC_CTRL"]
_OVER_RANGE = _STATUS.field("over_range").mask
_FALLING = _OVER_RANGE | _STATUS.field("supply_low").mask | _STATUS.field("supply_high").mask


@dataclass(frozen=True)
class Board:
    """A board.

    Attributes
    ----------
    part : str
        What is soldered on it.
    supply_v : float
    hum_mg, hum_hz : float
        Amplitude and frequency of a tone on the X accelerometer.
    offset_lsb : int
        LSB of the accelerometers' offsets, in LSB of the output.
    status_falls : bool
        Supply and over-range bits of STATUS fall by themselves.
    negative_self_test : bool
        The accelerometers answer to the negative stimulus too.
    deaf : tuple of int
        Columns of output registers that do not answer to the self-test.
    rate_error : float
        Relative error of the part's clock.
    data_ready : bool
        DIO1 is wired to the bridge.
    noise_hz : float
        Random edges a second on the bridge's data-ready input.
    pulse_s, lead_s : float
        Width of the pulse, and how long before the update its first edge comes.
    missed : float
        Share of the edges that the bridge does not see.
    miso : {"", "inverted", "low", "high", "late"}
        What becomes of the data line.
    clean_hz, bit_errors : float
        Highest clock without errors, and probability of a wrong bit above it.
    quick : float
        Share of the promised time of a frame that the bridge really takes.
    streams, counts, rising : bool
        What the bridge offers: streams, an event counter, the rising edge as trigger.
    flash : tuple of (name, word)
        Registers that were saved before.
    direction : tuple of float or None
        Attitude: what an ideal sensor reads, in g.
    """

    part: str = "adis16354"
    supply_v: float = 5.0
    hum_mg: float = 0.0
    hum_hz: float = 50.0
    offset_lsb: int = 1
    status_falls: bool = True
    negative_self_test: bool = False
    deaf: tuple[int, ...] = ()
    rate_error: float = 0.0
    data_ready: bool = True
    noise_hz: float = 0.0
    pulse_s: float = 60e-6
    lead_s: float = 0.0
    missed: float = 0.0
    miso: str = ""
    clean_hz: float = np.inf
    bit_errors: float = 1e-3
    quick: float = 1.0
    streams: bool = True
    counts: bool = True
    rising: bool = False
    flash: tuple[tuple[str, int], ...] = ()
    direction: tuple[float, float, float] | None = None

    def open(self, seed: int = 0, **settings) -> BoardBus:
        """A bus to a new board of this kind."""
        return BoardBus(self, seed, **settings)


class BoardWorld(World):
    """The world with a tone on X."""

    def __init__(self, board: Board, seed: int, settings: dict) -> None:
        super().__init__(
            WorldSettings(**{"supply_v": board.supply_v} | settings), part=board.part, seed=seed
        )
        self._board = board

    def sample(self, time_s) -> Inputs:
        inputs = super().sample(time_s)
        if self._board.hum_mg:
            inputs.accel_mg[:, 0] += self._board.hum_mg * np.sin(2 * np.pi * self._board.hum_hz * time_s)
        return inputs


class BoardSampler(SignalChain):
    """Offsets with an LSB of their own, over-range of the output, a self-test with deaf axes."""

    def __init__(self, part, memory, board: Board) -> None:
        self._board = board
        super().__init__(part, memory)

    def configure(self, memory) -> None:
        super().configure(memory)
        self._offset[ACCEL_COLUMNS] *= self._board.offset_lsb

    def update(self, inputs):
        updates = super().update(inputs)
        lsb = self._variant.accel_mg_per_lsb
        row = BY_NAME[ACCEL_OUT[0]]
        words = (updates.words[:, ACCEL_COLUMNS] & row.data_mask).astype(np.int64)
        numbers = words - (words >> row.bits - 1 << row.bits)
        over = np.abs(numbers).max(axis=1) * lsb > 1000 * self._variant.accel_range_g
        return replace(updates, status=updates.status | over * _OVER_RANGE)

    def _scaled(self, inputs):
        values = super()._scaled(inputs)
        stimulus, self._manual_test = self._manual_test, 0.0
        if stimulus:
            without = super()._scaled(inputs)
            moved = stimulus if stimulus > 0 or self._board.negative_self_test else 0.0
            move = np.rint(moved * SELF_TEST_ACCEL_MG * self._gain[ACCEL_COLUMNS]).astype(np.int64)
            values[:, ACCEL_COLUMNS] = without[:, ACCEL_COLUMNS] + move
            values[:, self._board.deaf] = without[:, self._board.deaf]
        self._manual_test = stimulus
        return values


class BoardChip(SimulatedChip):
    """A chip with the part's own habits."""

    def __init__(self, world: World, board: Board) -> None:
        flash = dict(board.flash)
        super().__init__(world, board.part, start_s=-0.5, flash=flash, data_ready_pulse_s=board.pulse_s)
        self._board = board
        self._sampler = BoardSampler(variant(board.part), self.memory, board)
        self._restart_sampling(self._until, empty=True)

    def _restart_sampling(self, now: float, *, empty: bool = False) -> None:
        super()._restart_sampling(now, empty=empty)
        board = getattr(self, "_board", None)
        if board is not None:
            self.update_period_s /= 1 + board.rate_error

    def _take(self, n: int):
        before = self._status
        updates = super()._take(n)
        kept = before | self._status | int(np.bitwise_or.reduce(updates.status))
        if self._board.status_falls:
            kept = kept & ~_FALLING | int(updates.status[-1]) & _FALLING
        self._status = kept
        return updates


class BoardBus(SimBus):
    """The simulated bus with a board's wiring around it."""

    def __init__(self, board: Board, seed: int = 0, **settings) -> None:
        world = BoardWorld(board, seed, settings)
        super().__init__(world=world, chip=BoardChip(world, board), url=f"board:{seed}")
        self.board = board
        self.dice = np.random.default_rng([seed, 77])
        self.capabilities = frozenset(
            {Capability.HARD_RESET}
            | ({Capability.STREAM} if board.streams else set())
            | ({Capability.EVENT_COUNTER} if board.counts else set())
        )
        self.edge_rises = board.rising
        if board.direction is not None:
            self.stage.orient(board.direction)
            self.sleep_s(2.0)
        self._counted_s = self.now_s()
        self._edges_before = 0

    def _exchange(self, frames: Words) -> Words:
        begin_s = self.now_s()
        replies = super()._exchange(frames)
        if self.board.quick != 1.0:  # the chip is spared: a part that dies says nothing about the bridge
            self._now = begin_s + self.board.quick * (self._now - begin_s)
        return self.heard(replies)

    def heard(self, replies: Words) -> Words:
        """What the bridge makes of what the chip sends."""
        board = self.board
        if board.miso in ("low", "high"):
            return np.full(len(replies), 0 if board.miso == "low" else 0xFFFF, np.uint16)
        if board.miso == "inverted":
            replies = replies ^ np.uint16(0xFFFF)
        if board.miso == "late":
            replies = replies >> np.uint16(1)
        if self.timing.clock_hz > board.clean_hz:
            flips = self.dice.random((len(replies), 16)) < board.bit_errors
            replies = replies ^ (flips * (1 << np.arange(16))).sum(axis=1).astype(np.uint16)
        return replies

    def read_event_counter(self) -> int:
        now, board = self.now_s(), self.board
        real = self.chip.data_ready_edges(max(now, self.chip.time_s)) if board.data_ready else 0
        edges, self._edges_before = real - self._edges_before, real
        if board.missed:
            edges = int(self.dice.binomial(edges, 1 - board.missed))
        edges += int(self.dice.poisson(board.noise_hz * (now - self._counted_s)))
        self._counted_s = now
        return edges

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        if Capability.STREAM not in self.capabilities:
            return super().stream(frames, block_scans=block_scans)
        if len(frames) > 28:
            raise UsageError("at most 28 frames")
        return BoardStream(self, np.append(np.array(frames, np.uint16), np.uint16(0)), block_scans)


class BoardStream(FrameStream):
    """Scans at the edges that the bridge sees, whatever makes them."""

    def __init__(self, bus: BoardBus, frames: Words, block: int) -> None:
        self.bus, self.frames, self.block = bus, frames, block
        self.free_s = max(bus.now_s(), bus.chip.time_s)
        self.seen_s = self.free_s
        self.waiting: list[float] = []
        self.lost = 0
        self.open = True
        bus._stream = self

    def __next__(self) -> FrameBlock:
        if not self.open:
            raise StopIteration
        bus, length = self.bus, len(self.frames)
        run_s = TRIGGER_S + length * bus.timing.frame_s
        taken: list[float] = []
        for _ in range(1000):
            if len(taken) == self.block:
                break
            for edge in self._edges():
                if len(taken) == self.block:
                    self.waiting.append(edge)
                elif edge < self.free_s:
                    self.lost += 1
                else:
                    taken.append(edge)
                    self.free_s = edge + run_s
        else:
            raise BusTimeoutError(f"{bus.url}: no data-ready edge")
        edges = np.array(taken)
        starts = (edges + TRIGGER_S)[:, None] + bus.timing.frame_s * np.arange(length)
        replies = bus.chip.frames_at(
            np.tile(self.frames, self.block), starts.ravel(), clock_hz=bus.timing.clock_hz
        )
        words = bus.heard(replies).reshape(self.block, length)[:, 1:]
        bus._last_start = float(starts[-1, -1])
        bus._last_rise = bus._last_start + 16 / bus.timing.clock_hz
        bus._set_now(self.free_s)
        lost, self.lost = self.lost, 0
        return FrameBlock(np.ascontiguousarray(words), edges, lost)

    def _edges(self) -> list[float]:
        """The next edges in order of time, those left over first."""
        left, self.waiting = self.waiting, []
        if left:
            return left
        bus, board = self.bus, self.bus.board
        period, chip = bus.chip.update_period_s, bus.chip
        begin, self.seen_s = self.seen_s, self.seen_s + self.block * period
        found = np.empty(0)
        if board.data_ready and chip.data_ready_enabled:
            high = bool(_MISC.field("polarity").of(chip.memory["MSC_CTRL"]))
            after = -board.lead_s + (0.0 if high == bus.edge_rises else board.pulse_s)
            first = np.ceil((begin - after - chip._epoch) / period)
            last = np.ceil((self.seen_s - after - chip._epoch) / period)
            found = chip._epoch + period * np.arange(max(first, 1), last) + after
            found = found[bus.dice.random(len(found)) >= board.missed]
        noise = bus.dice.uniform(
            begin, self.seen_s, bus.dice.poisson(board.noise_hz * (self.seen_s - begin))
        )
        return sorted([*found.tolist(), *noise.tolist()])

    def close(self) -> None:
        if self.open:
            self.open = False
            self.bus._stream = None


SOUND = Board()


def sound(seed: int) -> Board:
    """A sound board of its own attitude, flash and bridge."""
    dice = np.random.default_rng([seed, 78])
    streams, counts = ((True, True), (False, True), (False, False), (True, False))[dice.integers(4)]
    rate = int(dice.choice([0x01, 0x01, 0x01, 0x03, 0x09, 0x0A, 0x1F]))
    m = int(dice.integers(0, 7))
    ranges = [code for code, least in ((4, 0), (2, 2), (1, 4)) if m >= least]
    direction = dice.standard_normal(3)
    return Board(
        streams=streams,
        counts=counts,
        rising=bool(dice.integers(2)),
        pulse_s=float(dice.uniform(20e-6, 300e-6)),
        direction=tuple(direction / np.linalg.norm(direction)),
        flash=(
            ("SMPL_PRD", rate),
            ("SENS_AVG", int(dice.choice(ranges)) << 8 | m),
            ("MSC_CTRL", int(dice.choice([0x00, 0x04, 0x06, 0xC0]))),
            ("XACCL_OFF", BY_NAME["XACCL_OFF"].word(int(dice.integers(-200, 200)))),
            ("ZGYRO_OFF", BY_NAME["ZGYRO_OFF"].word(int(dice.integers(-200, 200)))),
        ),
    )


FAULTY: dict[str, tuple[Board, str, str]] = {
    "noise on D2 instead of data-ready": (Board(data_ready=False, noise_hz=2000.0), "data-ready", "noise"),
    "wrong edge of data-ready": (Board(lead_s=60e-6), "data-ready", "wrong edge"),
    "data-ready edges missed": (Board(missed=0.1), "data-ready", "missed"),
    "noise beside data-ready, no counter": (Board(noise_hz=100.0, counts=False), "data-ready", "noise"),
    "edges missed, no counter": (Board(missed=0.1, counts=False), "data-ready", "missed"),
    "MISO inverted": (Board(miso="inverted"), "link", "inverted"),
    "MISO stuck low": (Board(miso="low"), "link", "stuck low"),
    "MISO stuck high": (Board(miso="high"), "link", "stuck high"),
    "words a bit late": (Board(miso="late"), "link", "late"),
    "bit errors above 600 kHz": (Board(clean_hz=600e3), "bit errors", "750 kHz"),
    "an ADIS16350": (Board(part="adis16350"), "variant", "ADIS16350"),
    "offset LSB twice as large": (Board(offset_lsb=2), "offset", "2, the table says 1"),
    "STATUS does not fall": (Board(status_falls=False), "status", "over-range stays"),
    "supply at 4.7 V": (Board(supply_v=4.7), "supply", "4.7"),
    "50 Hz hum on X": (Board(hum_mg=2.0), "noise", "50.0 Hz"),
    "gyro Z deaf to its self-test": (Board(deaf=(3,)), "self-test", "ZGYRO_OUT"),
    "stall not kept": (Board(quick=0.9), "timing", "stall is not kept"),
    "update 4 % too slow": (Board(rate_error=-0.04), "sample rate", "786"),
}
"""Board, step that has to name it, and a word of its sentence, by what is wrong."""
