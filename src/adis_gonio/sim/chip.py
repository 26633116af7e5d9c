"""A simulated chip of the ADIS16350 family at frame level, in its own time.

`SimulatedChip.frame` gets one frame as the pins see it: the fall of chip select, the clock and the number
of bits. Between two frames the chip updates its outputs, writes its flash, tests itself or sleeps. It
depends on neither bus nor driver; its registers are the table `adis_gonio.device.sensor.registers`. The
levels of its DIO lines follow the order of precedence data-ready, alarm, general output (data sheet, A).

Choices for behaviour that is not known
---------------------------------------
The confidence is A to D, as in `docs/glossary.md`: D is an estimate.

| situation | here | confidence |
|---|---|---|
| word of a read | taken when chip select rises after the 16th clock | D |
| reply after a write, a reset, a read of COMMAND or of a reserved address | 0x0000 | D |
| stall too short | no answer until a hard reset; the data line floats | C |
| frame during start-up, reset or factory restore | no answer until a hard reset, too | C |
| clock outside the mode's range | not executed, reply XOR 0xA5A5, STATUS[3] | D |
| frame period too short | executed, but its reply repeats the frame before, STATUS[3] | D |
| frame of other than 16 bits | ignored, STATUS[3]; chip select without a clock is only ignored | B, C |
| frame during a flash update or recovery from sleep | ignored, stale reply | D |
| frame while an autonull averages | ignored except a software reset | D |
| self-test running | registers answer, outputs read 0 with ND 0, commands except a reset are ignored | D |
| updates during a flash update, restore or self-test | none; they restart after it | D |
| autonull | takes the filtered gyros of the last update, or a mean over `Electronics.autonull_s` | D |
| precision autonull | mean of the unfiltered gyros over 30 s, or `Electronics.precision_autonull_s` | D |
| content of either mean | a gyro's reading before the offset is added, with gravity, warmth and turns | D |
| supply below 4.75 V at the last update before a flash update ends | nothing saved, STATUS[2] | D |
| bit 14 of a frame, COMMAND's high byte | ignored | D |
| waking | SLP_CNT reads 0 and the taps are empty | D |
| change of SMPL_PRD | updates restart then, the taps are empty | D |
| data-ready pulse | 50 µs wide by default, begins with the update (or ends with it: `update_edge`) | C |

Not simulated
    Edges and levels on the pins within a frame (t_DAV and the like), supply current, brown-out, the noise
    that aligning the accelerometers' origin (MSC_CTRL[6]) takes from the gyros, the 350 Hz analog poles,
    jitter and drift of the chip's own clock, wear of the flash.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum, auto
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME, EA, GYRO_OFF, ND, Variant, variant
from adis_gonio.sim import memory as chip_memory, sampling

_GPIO = BY_NAME["GPIO_CTRL"]


def dio_levels(memory: chip_memory.Memory, *, pulse: bool, status: int) -> tuple[int | None, int | None]:
    """Return the levels that the chip drives on DIO1 and DIO2; None for a line that is an input.

    Parameters
    ----------
    memory : Memory
        Registers of the chip.
    pulse : bool
        True during the data-ready pulse.
    status : int
        Content of STATUS; an alarm output follows its alarm bits, supposedly until STATUS is read.
    """
    result: list[int | None] = [
        memory.field("GPIO_CTRL", f"level{k}") if memory.field("GPIO_CTRL", f"output{k}") else None
        for k in (1, 2)
    ]
    if memory.field("ALM_CTRL", "output"):
        active = bool(status & (sampling.ALARM_BITS[0] | sampling.ALARM_BITS[1]))
        line, polarity = memory.field("ALM_CTRL", "line"), memory.field("ALM_CTRL", "polarity")
        result[line] = int(active == bool(polarity))
    if memory.field("MSC_CTRL", "data_ready"):
        line, polarity = memory.field("MSC_CTRL", "line"), memory.field("MSC_CTRL", "polarity")
        result[line] = int(pulse == bool(polarity))
    return result[0], result[1]


Words = NDArray[np.uint16]

_CHUNK = 1 << 15
_SHORTEST_FAST_RUN = 4
_EDGE_TOLERANCE = 1e-6  # of an update period: an update counts as done when asked for at its own time
_COLUMN = np.full(32, -1)
_COLUMN[[row.address >> 1 for row in sampling.OUTPUTS]] = np.arange(len(sampling.OUTPUTS))
_PLAIN_READ = np.zeros(256, bool)
_PLAIN_READ[: BY_NAME["COMMAND"].address + 2] = True
_PLAIN_READ[BY_NAME["STATUS"].address : BY_NAME["STATUS"].address + 2] = False

_STATUS = BY_NAME["STATUS"]
_COMMAND = BY_NAME["COMMAND"]
_SPI_FAILED = _STATUS.field("spi").mask
_SUPPLY_LOW = _STATUS.field("supply_low").mask
FALLING_BITS = _SUPPLY_LOW | _STATUS.field("supply_high").mask | _STATUS.field("over_range").mask
"""STATUS bits that the chip clears without a read when their condition ends (DS p. 20, A)."""
_SELF_TEST = BY_NAME["MSC_CTRL"].field("self_test").mask
SELF_TEST_BITS = {
    f"{axis}{sensor}": _STATUS.field(f"{name}_{axis}_self_test").mask | _STATUS.field("self_test").mask
    for sensor, name in (("accl", "accel"), ("gyro", "gyro"))
    for axis in "xyz"
}
"""STATUS bits that the self-test sets for each failed sensor axis, by name of the axis such as `xaccl`."""


class State(Enum):
    """Activity of the chip, which determines its answer to a frame.

    A violated timing rule leads to the state `DEAD`, in which the chip answers nothing.
    """

    RUNNING = auto()
    STARTING = auto()
    FLASHING = auto()
    RESTORING = auto()
    TESTING = auto()
    NULLING = auto()
    ASLEEP = auto()
    WAKING = auto()
    DEAD = auto()


_SAMPLING = (State.RUNNING, State.NULLING)


class SimulatedChip:
    """A simulated ADIS1635x chip that answers frames, in its own simulated time.

    Parameters
    ----------
    surroundings : Surroundings
        Gives the analog inputs at each internal update.
    part : str or Variant
        `adis16354`, `adis16350` or `adis16355`.
    start_s : float
        Time of power-on in s; the chip answers 150 ms later.
    flash : mapping of str to int
        Register words by name that were saved earlier; other registers have their defaults.
    endurance : int
        Number of flash updates so far.
    floating_word : int
        Word that a host reads while nothing drives the data line; 0xFFFF if a resistor pulls it up.
    self_test_failures : sequence of str
        Sensor axes that fail the internal self-test: `xaccl`, `zgyro`, …
    data_ready_pulse_s : float
        Width of the data-ready pulse in s.
    update_edge : {"first", "last"}
        Edge of the data-ready pulse at which the outputs change: the pulse begins then, or ends.
    status_falls : bool
        True clears the supply and over-range bits of STATUS when their condition ends; False keeps them
        until a read, like the other bits.
    electronics : Electronics
        Effect of the chip on its gyros and accelerometers; None takes the electronics of the surroundings
        if they have some (a `World` does), else ideal electronics.

    Attributes
    ----------
    variant : Variant
        Row of the variants table for this chip.
    surroundings : Surroundings
        The surroundings that were given.
    external_levels : tuple of int, int
        External levels on DIO1 and DIO2, read if the line is an input.
    memory : Memory
        The chip's registers, for access without frames.
    state : State
        Activity of the chip at the time up to which it was simulated.
    time_s, update_period_s : float
        Time up to which the chip has been simulated, and time between two internal updates of the outputs.

    Raises
    ------
    UsageError
        Unknown variant, register or sensor axis of the self-test.
    """

    def __init__(
        self,
        surroundings: sampling.Surroundings,
        part: str | Variant = "adis16354",
        *,
        start_s: float = 0.0,
        flash: Mapping[str, int] | None = None,
        endurance: int = 0,
        floating_word: int = 0xFFFF,
        self_test_failures: Sequence[str] = (),
        data_ready_pulse_s: float = 50e-6,
        update_edge: Literal["first", "last"] = "first",
        status_falls: bool = True,
        electronics: sampling.Electronics | None = None,
    ) -> None:
        for name in self_test_failures:
            if name not in SELF_TEST_BITS:
                raise UsageError(
                    f"no part of the self-test is called '{name}': {', '.join(SELF_TEST_BITS)}"
                )
        self.variant = variant(part)
        self.floating_word = floating_word
        self.external_levels = (0, 0)
        self.surroundings = surroundings
        self._failures = tuple(self_test_failures)
        self._pulse_s = data_ready_pulse_s
        self._update_edge = update_edge
        self._falling = FALLING_BITS if status_falls else 0
        self.memory = chip_memory.Memory(flash, endurance)
        self._electronics: sampling.Electronics = (
            electronics or getattr(surroundings, "electronics", None) or sampling.IDEAL
        )
        self._sampler = sampling.SignalChain(self.variant, self.memory, self._electronics)
        self._k = self._updates = self._status = self._standing = self._dac = 0
        self._reply = self._shifted = self._null_count = self._edges = 0
        self.state = State.STARTING
        self.time_s = start_s
        self._last_start = self._last_rise = -math.inf
        self._start_up(start_s)
        self.memory.changed = self._follow_registers

    # -- access past the serial port ---------------------------------------------------------------

    @property
    def aux_dac_v(self) -> float:
        """Voltage in V that the auxiliary analog output (AUX_DAC) gives."""
        return self._dac * 2.5 / 4095

    @property
    def data_ready_enabled(self) -> bool:
        """True if DIO1 or DIO2 carries the data-ready pulse."""
        return bool(self.memory.field("MSC_CTRL", "data_ready"))

    @property
    def pending_reply(self) -> int:
        """Word that the chip would send in the next valid frame.

        Models of a bridge need it before the frame.
        """
        if self.state in (State.STARTING, State.RESTORING, State.ASLEEP, State.DEAD):
            return self.floating_word
        return self._reply

    def run_to(self, time_s: float) -> None:
        """Simulate the chip up to a time in s; a time that is already simulated does nothing."""
        if time_s > self.time_s:
            self._advance(time_s)

    def data_ready_edges(self, time_s: float) -> int:
        """Return the number of data-ready pulses from power-on to a time in s."""
        self.run_to(time_s)
        return self._edges

    def next_update_s(self, after_s: float) -> float | None:
        """Return the time in s of the next internal update after `after_s`.

        Return None if only a frame can start the updates again (a sleeping or dead chip). Activities that
        end before then (a start-up, a flash update) are completed.
        """
        self.run_to(after_s)
        while self.state not in _SAMPLING:
            if math.isinf(self._until):
                return None
            after_s = max(after_s, self._until)
            self.run_to(after_s)
        count = math.floor((after_s - self._epoch) / self.update_period_s + _EDGE_TOLERANCE)
        return self._epoch + (count + 1) * self.update_period_s

    def edge_after_update_s(self, *, rising: bool) -> float:
        """Return the time in s from an update to the rising or falling edge of its data-ready pulse.

        It is negative if the edge comes before the update.
        """
        begins = bool(self.memory.field("MSC_CTRL", "polarity")) == rising
        at_first = 0.0 if self._update_edge == "first" else -self._pulse_s
        return at_first if begins else at_first + self._pulse_s

    def next_edge_s(self, after_s: float, *, rising: bool) -> float | None:
        """Return the time in s of the first data-ready edge after `after_s`; None if no edge follows.

        `rising` selects the rising edge, otherwise the falling edge counts.
        """
        update_s = self.next_update_s(after_s)
        if update_s is None:
            return None
        edge_s = update_s + self.edge_after_update_s(rising=rising)
        return edge_s if edge_s > after_s else edge_s + self.update_period_s

    def dio(self, time_s: float) -> tuple[int | None, int | None]:
        """Return the levels (0 or 1) that the chip drives on DIO1 and DIO2 at a time in s.

        The level of an input is None.
        """
        self.run_to(time_s)
        since = time_s - (self._epoch + self._k * self.update_period_s)
        if self._update_edge == "last":
            since += self._pulse_s - self.update_period_s
        pulse = self.state in _SAMPLING and self._k > 0 and 0 <= since < self._pulse_s
        return dio_levels(self.memory, pulse=pulse, status=self._status)

    def hard_reset(self, time_s: float) -> None:
        """End a reset by the RST line at a time in s; the start-up of 150 ms follows."""
        self.run_to(time_s)
        self._start_up(max(time_s, self.time_s))

    # -- frames -----------------------------------------------------------------------------------

    def frame(
        self, word: int, *, start_s: float, clock_hz: float, bits: int = 16, cs_hold_s: float = 0.0
    ) -> int:
        """Take one SPI frame and return the word that the chip shifts out during it.

        Parameters
        ----------
        word : int
            Word that is shifted in.
        start_s : float
            Time at which chip select falls; the stall before it is counted from the last rise.
        clock_hz : float
            SPI clock; chip select rises `bits / clock_hz + cs_hold_s` after its fall.
        bits : int
            Number of clocks while chip select is low.
        cs_hold_s : float
            Time from the last clock to the rise of chip select.

        Returns
        -------
        int
            Word that is shifted out: the reply to the frame before.

        Raises
        ------
        UsageError
            The frame begins before the last frame.
        """
        if start_s < self._last_start or start_s < self.time_s - chip_memory.TOLERANCE_S:
            raise UsageError(
                f"frame at {start_s:.9g} s: the chip is already simulated until {self.time_s:.9g} s"
            )
        self._advance(start_s)
        rise = start_s + bits / clock_hz + cs_hold_s
        stall, period = start_s - self._last_rise, start_s - self._last_start
        self._last_start, self._last_rise = start_s, rise
        self._shifted = self._answer(word, bits, clock_hz, cs_hold_s, stall, period)
        return self._shifted

    def frames_at(self, words: Words, starts_s: Floats, *, clock_hz: float) -> Words:
        """Take n frames that start at increasing times (n,) in s; return the n replies.

        The result equals the result of n calls of `frame`, but comes faster. `clock_hz` is the SPI clock.
        """
        n = len(words)
        replies = np.empty(n, np.uint16)
        hard = np.append(np.flatnonzero(~_PLAIN_READ[words >> 8]), n)
        i = 0
        while i < n:
            end = int(hard[np.searchsorted(hard, i)])
            done = 0
            if end - i >= _SHORTEST_FAST_RUN:
                done = self._fast(words[i:end], starts_s[i:end], clock_hz, replies[i:end])
            if not done:
                done = min(_SHORTEST_FAST_RUN, n - i)
                few = zip(words[i : i + done].tolist(), starts_s[i : i + done].tolist(), strict=True)
                replies[i : i + done] = [self.frame(w, start_s=at, clock_hz=clock_hz) for w, at in few]
            i += done
        return replies

    def _fast(self, words: Words, starts: Floats, clock_hz: float, out: Words) -> int:
        """Answer the first frames of a run of reads together, if possible; return their number.

        `words` and `starts` are the frames and their start times in s, both (n,), `clock_hz` is the SPI
        clock. The replies are written to the beginning of `out` (n,). Only frames before the first
        violation of a timing limit are answered. The number is 0 if the chip is not running, or if single
        answers are as fast because the frames are few.
        """
        first = float(starts[0])
        if first < max(self._last_start, self.time_s - chip_memory.TOLERANCE_S):
            return 0
        if self._until <= first:
            self._advance(first)
        limits = chip_memory.serial_limits(self.memory["SMPL_PRD"])
        if self.state is not State.RUNNING or not limits.clock_ok(clock_hz):
            return 0
        starts = starts[:_CHUNK]
        rises = starts + 16 / clock_hz
        stall = starts - np.append(self._last_rise, rises[:-1])
        period = np.diff(starts, prepend=self._last_start)
        kept = (stall >= limits.stall_s - chip_memory.TOLERANCE_S) & (
            period >= limits.period_s - chip_memory.TOLERANCE_S
        )
        n = len(starts) if kept.all() else int(np.argmin(kept))
        done = np.floor((rises[:n] - self._epoch) / self.update_period_s + _EDGE_TOLERANCE).astype(np.int64)
        index = done - self._k
        n = int(np.searchsorted(index, _CHUNK, side="right"))
        if n < _SHORTEST_FAST_RUN:
            return 0
        index = index[:n]
        seen = self._updates + index
        rows, status = self._row[None, :], np.array([self._status])
        if index[-1]:
            updates = self._take(int(index[-1]))
            rows = np.concatenate([rows, updates.words])
            stood = np.concatenate([status, updates.status])
            status = stood & self._falling | np.bitwise_or.accumulate(stood & ~self._falling)
        self.time_s = float(rises[n - 1])
        # Words that the reads return, with the flags ND (new data) and EA (error or alarm).
        slots = words[:n] >> np.uint16(9)
        values: Words = rows[index, _COLUMN[slots]]
        values[(status != 0)[index]] |= EA
        for slot in np.flatnonzero(np.bincount(slots, minlength=32)):
            chosen = np.flatnonzero(slots == slot)
            column = _COLUMN[slot]
            if column < 0:
                values[chosen] = self._control_word(2 * int(slot))
                continue
            at = seen[chosen]
            fresh = at > np.concatenate([self._read_at[column : column + 1], at[:-1]])
            values[chosen[fresh]] |= ND
            self._read_at[column] = at[-1]
        out[0], out[1:n] = self._reply, values[:-1]
        self._reply = int(values[-1])
        self._shifted = int(out[n - 1])
        self._last_start, self._last_rise = float(starts[n - 1]), float(rises[n - 1])
        return n

    # -- one frame ---------------------------------------------------------------------------------

    def _answer(
        self, word: int, bits: int, clock_hz: float, cs_hold_s: float, stall: float, period: float
    ) -> int:
        """Execute a frame if state and timing allow it; return the word that the chip shifts out.

        `bits` is the number of clocks; `stall` and `period` are the times in s since the end and since the
        start of the frame before.
        """
        limits = chip_memory.serial_limits(self.memory["SMPL_PRD"])
        refused = self._refusal(bits, clock_hz, stall, limits)
        if refused is not None:
            return refused
        reply = self._reply
        if period < limits.period_s - chip_memory.TOLERANCE_S:
            self._status |= _SPI_FAILED
            reply = self._shifted
        self._advance(self._last_rise)
        if self.state is State.NULLING:
            reset = word & _COMMAND.field("reset").mask
            if word >> 15 and (word >> 8) & 0x3F == _COMMAND.address and reset:
                self._start_up(self._last_rise)
        elif word >> 15:
            self._reply = 0
            self._write(word >> 8 & 0x3F, word & 0xFF, cs_hold_s, limits)
        else:
            self._reply = self._read(word >> 8 & 0x3F)
        return reply

    def _refusal(
        self, bits: int, clock_hz: float, stall: float, limits: chip_memory.SerialLimits
    ) -> int | None:
        """Return the reply to a frame that the chip ignores; None if the chip takes the frame.

        It ignores frames while it is not running, and frames that are broken. `bits` is the number of
        clocks, `stall` the time in s before the frame, `limits` are the limits of the present speed mode.
        """
        if self.state in (State.STARTING, State.RESTORING):
            self.state, self._until = State.DEAD, math.inf
        if self.state is State.DEAD:
            return self.floating_word
        if self.state is State.ASLEEP:
            self.state, self._until = State.WAKING, self._last_rise + chip_memory.WAKE_S
            return self.floating_word
        if self.state in (State.FLASHING, State.WAKING):
            return self._reply
        if stall < limits.stall_s - chip_memory.TOLERANCE_S:
            self.state, self._until = State.DEAD, math.inf
            return self.floating_word
        if bits == 0:
            return self._reply
        if bits != 16:
            self._status |= _SPI_FAILED
            return (self._reply >> (16 - bits) if bits < 16 else self._reply << (bits - 16)) & 0xFFFF
        if not limits.clock_ok(clock_hz):
            self._status |= _SPI_FAILED
            return self._reply ^ 0xA5A5
        return None

    def _read(self, address: int) -> int:
        column = int(_COLUMN[address >> 1])
        if column < 0:
            if address & ~1 == _STATUS.address:
                word, self._status = self._status, 0
                return word
            return self._control_word(address)
        if self.state is State.TESTING:
            return EA if self._status else 0
        word = int(self._row[column]) | (EA if self._status else 0)
        if self._updates > self._read_at[column]:
            word |= ND
        self._read_at[column] = self._updates
        return word

    def _control_word(self, address: int) -> int:
        if address & ~1 == BY_NAME["GPIO_CTRL"].address:
            word = self.memory["GPIO_CTRL"]
            for k, level in enumerate(self.external_levels, 1):
                if not _GPIO.field(f"output{k}").of(word):  # an input shows the external level of the line
                    mask = _GPIO.field(f"level{k}").mask
                    word = word | mask if level else word & ~mask
            return word
        return self.memory.at(address)

    def _write(self, address: int, data: int, cs_hold_s: float, limits: chip_memory.SerialLimits) -> None:
        row = self.memory.write_byte(address, data)
        if row is None:
            return
        now = self._last_rise
        if row is _COMMAND:
            if not address & 1:
                self._command(data, now)
            return
        if self.state is not State.RUNNING:
            return
        if row.name == "MSC_CTRL" and self.memory["MSC_CTRL"] & _SELF_TEST:
            self.state, self._until = State.TESTING, now + chip_memory.SELF_TEST_S
        elif row.name == "SLP_CNT" and self.memory["SLP_CNT"] and cs_hold_s <= limits.sleep_cs_s:
            self.state = State.ASLEEP
            self._until = now + chip_memory.SLEEP_UNIT_S * (self.memory["SLP_CNT"] & 0xFF)

    def _command(self, data: int, now: float) -> None:
        """Execute a write of `data` to COMMAND at the time `now` in s.

        If several bits are set, only the first in the order of this method acts, which is an assumption.
        """
        if data & _COMMAND.field("reset").mask:
            self._start_up(now)
        elif self.state is not State.RUNNING:
            return
        elif data & _COMMAND.field("restore").mask:
            for name in (*GYRO_OFF, *ACCEL_OFF):
                self.memory[name] = 0
            self.state, self._until = State.RESTORING, now + chip_memory.FLASH_S
        elif data & _COMMAND.field("autonull").mask:
            self._begin_null(now, self._electronics.autonull_s)
        elif data & _COMMAND.field("precision_autonull").mask:
            self._begin_null(now, self._electronics.precision_autonull_s)
        elif data & _COMMAND.field("flash_update").mask:
            self.state, self._until = State.FLASHING, now + chip_memory.FLASH_S
        elif data & _COMMAND.field("latch_dac").mask:
            self._dac = self.memory["AUX_DAC"]

    def _begin_null(self, now: float, average_s: float) -> None:
        """Start an autonull at the time `now` in s that averages the gyros for `average_s`.

        If `average_s` is 0 it uses the present output of the filter.
        """
        if average_s:
            self._null_sum, self._null_count = np.zeros(3), 0
            self.state, self._until = State.NULLING, now + average_s
            return
        self._null(self._sampler.gyro_mean())
        self.state, self._until = State.FLASHING, now + chip_memory.FLASH_S

    # -- time ---------------------------------------------------------------------------------------

    def _start_up(self, now: float) -> None:
        self.state, self._until = State.STARTING, now + chip_memory.START_UP_S
        self._status = self._standing = self._dac = 0
        self._reply = self._shifted = self._updates = 0
        self.memory.load()
        self._read_at: NDArray[np.int64] = np.zeros(len(sampling.OUTPUTS), np.int64)
        self._row: Words = np.zeros(len(sampling.OUTPUTS), np.uint16)
        self._null_sum, self._null_count = np.zeros(3), 0
        self._restart_sampling(self._until, empty=True)

    def _follow_registers(self) -> None:
        """Make the simulation follow the present contents of the registers.

        The settings of the filter and the ranges are taken over. If SMPL_PRD has changed, the updates
        restart.
        """
        self._sampler.configure(self.memory)
        if self.memory["SMPL_PRD"] != self._smpl_prd:
            self._restart_sampling(self.time_s, empty=True)

    def _restart_sampling(self, now: float, *, empty: bool = False) -> None:
        self._smpl_prd = self.memory["SMPL_PRD"]
        self._epoch, self._k = now, 0
        self.update_period_s = chip_memory.update_period_s(self.memory["SMPL_PRD"])
        if empty:
            self._sampler.clear()
        self._sampler.configure(self.memory)

    def _advance(self, time_s: float) -> None:
        while self._until <= time_s:
            end = self._until
            self._sample_to(end)
            self._finish(end)
        self._sample_to(time_s)
        self.time_s = max(self.time_s, time_s)

    def _finish(self, now: float) -> None:
        """End the activity of the chip at the time `now` in s, and begin the activity that follows it."""
        state, self.state, self._until = self.state, State.RUNNING, math.inf
        if state in (State.FLASHING, State.RESTORING):
            self._save()
        elif state is State.TESTING:
            self.memory["MSC_CTRL"] = self.memory["MSC_CTRL"] & ~_SELF_TEST
            for name in self._failures:
                self._status |= SELF_TEST_BITS[name]
        elif state is State.NULLING:
            self._null(self._null_sum / max(self._null_count, 1))
            self.state, self._until = State.FLASHING, now + chip_memory.FLASH_S
            return
        elif state is State.ASLEEP:
            self.state, self._until = State.WAKING, now + chip_memory.WAKE_S
            return
        elif state is State.WAKING:
            self.memory["SLP_CNT"] = 0
        self._restart_sampling(now, empty=state is State.WAKING)

    def _save(self) -> None:
        if self._standing & _SUPPLY_LOW:
            self._status |= _STATUS.field("flash").mask
        else:
            self.memory.save()

    def _null(self, mean: Floats) -> None:
        for name, number in zip(GYRO_OFF, self._sampler.null_offset(mean), strict=True):
            self.memory[name] = BY_NAME[name].word(number)

    def _sample_to(self, time_s: float) -> None:
        if self.state not in _SAMPLING:
            return
        wanted = math.floor((time_s - self._epoch) / self.update_period_s + _EDGE_TOLERANCE)
        while self._k < wanted:
            self._take(min(wanted - self._k, _CHUNK))

    def _take(self, n: int) -> sampling.Updates:
        """Simulate the next n internal updates and return their outputs."""
        count = np.arange(self._k + 1, self._k + n + 1, dtype=np.float64)
        times = self._epoch + count * self.update_period_s
        updates = self._sampler.update(self.surroundings.sample(times))
        self._standing = int(updates.status[-1])
        kept = (self._status | int(np.bitwise_or.reduce(updates.status))) & ~self._falling
        self._status = kept | self._standing & self._falling
        self._row = updates.words[-1]
        self._k += n
        self._updates += n
        if self.data_ready_enabled:
            self._edges += n
        if self.state is State.NULLING:
            self._null_sum += updates.unfiltered[:, sampling.GYRO_COLUMNS].sum(axis=0)
            self._null_count += n
        return updates
