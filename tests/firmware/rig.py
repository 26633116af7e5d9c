"""The real firmware binary in a simulated ATmega328P, with the simulated chip on its pins.

Everything happens in simulated time, one cycle of 62.5 ns after the other; the chip sees the edges that
the port makes, and every frame is judged by `PinLog`. `Rig.port` is the other end of the UART.

What yasimavr 0.1.6 does otherwise than the part: edges come at the end of an instruction, up to three
cycles late, and a byte that is sent while a received one waits in UDR0 overwrites it. The latter costs a
request now and then; hosts repeat it.
"""

from __future__ import annotations

import bisect
import math
from pathlib import Path
from typing import Any

import numpy as np
import yasimavr.lib.core as core
from yasimavr.device_library import load_device

from adis_gonio.device.bus.wire.protocol import BAUD
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.sim.chip import SimulatedChip, State, dio_levels
from adis_gonio.sim.world import World
from firmware.pins import F_CPU, FAST, LAST_FAST, NORMAL, FrameEdges, PinLog

POWERED_BEFORE_S = 0.5
PULSE_S = 50e-6
SLICE = F_CPU // 10_000
RAM_START, RAM_END = 0x100, 0x8FF
PAINT = 0xC5

_DIGITAL = core.Wire.SignalId.DigitalChange
_SAMPLING = (State.RUNNING, State.NULLING)


class Rig:
    """Firmware, chip and world.

    Parameters
    ----------
    elf : Path
        The firmware.
    world : World
        Surroundings of the chip.
    chip : SimulatedChip
        A chip of one's own; powered since `-POWERED_BEFORE_S` otherwise.
    baud : int
        Of the host's side of the line.
    """

    def __init__(
        self, elf: Path, world: World, chip: SimulatedChip | None = None, *, baud: int = BAUD
    ) -> None:
        self.world = world
        self.chip = chip or SimulatedChip(
            world, world.variant, start_s=-POWERED_BEFORE_S, data_ready_pulse_s=PULSE_S
        )
        self.log = PinLog()
        self.edges_s: list[float] = []
        self.replies: list[int] = []
        self.resets: list[tuple[float, float]] = []
        self.mismatches: list[str] = []
        self._device = load_device("atmega328p")
        self._loop = core.SimLoop(self._device)
        self._loop.set_fast_mode(True)
        firmware = core.Firmware.read_elf(str(elf))
        firmware.frequency, firmware.vcc = F_CPU, 5.0
        self._device.load_firmware(firmware)
        self._probe = core.DeviceDebugProbe(self._device)
        self.cycles = self._loop.cycle_manager()
        self._frame: FrameEdges | None = None
        self._reply = 0
        self._hooks: list[Any] = []
        self._cs = self._wire("PB2", self._on_select)
        self._clock = self._wire("PB5", self._on_clock)
        self._mosi = self._wire("PB3", self._on_data)
        self._miso = self._wire("PB4")
        self._miso_level: bool | None = None
        self._reset = self._wire("PB1", self._on_reset, state="U")
        self._ready = self._wire("PD2")
        self._ready_state = "Z"
        self._ready_timer = core.CallableCycleTimer(self._on_ready_timer)
        self._pulse = False
        self._updated = 0
        self._reset_from_s = 0.0
        self.port = RigPort(self, self._device, baud)
        self._plan_ready()

    def _wire(self, pin: str, callback: Any = None, state: str = "Z") -> Any:
        wire = core.Wire()
        wire.set_state(state)
        self._device.find_pin(pin).attach(wire)
        if callback is not None:
            hook = core.CallableSignalHook(callback)
            wire.signal().connect(hook)
            self._hooks.append(hook)
        return wire

    # -- time ------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Simulated time in s."""
        return float(self._loop.cycle()) / F_CPU

    def sleep_s(self, seconds: float) -> None:
        """Let the firmware run for a time."""
        self.run(math.ceil(seconds * F_CPU))

    def run(self, cycles: int) -> None:
        """Let the firmware run for so many cycles."""
        if cycles > 0:
            self._loop.run(cycles)
            state = self._loop.state()
            if state == core.SimLoop.State.Done:
                raise RuntimeError("the firmware crashed")

    # -- chip select, clock, data --------------------------------------------------------------------

    def _on_select(self, signal: Any, _: Any) -> None:
        if signal.sigid != _DIGITAL:
            return
        now = self._loop.cycle()
        if not signal.data.as_uint():
            # Chip select falls: what the chip shifts out is settled now.
            self.chip.run_to(now / F_CPU)
            limits = FAST if self.chip.memory["SMPL_PRD"] & 0xFF <= LAST_FAST else NORMAL
            self._frame = FrameEdges(limits, now, bool(self._clock.digital_state()))
            self._reply = self.chip.pending_reply
        elif self._frame is not None:
            self._end_frame(self._frame, now)

    def _on_clock(self, signal: Any, _: Any) -> None:
        frame = self._frame
        if frame is None or signal.sigid != _DIGITAL:
            return
        now = self._loop.cycle()
        if signal.data.as_uint():
            frame.rising.append(now)
            frame.word_in = frame.word_in << 1 | int(self._mosi.digital_state())
        else:
            level = bool(self._reply >> (15 - len(frame.falling)) & 1) if len(frame.falling) < 16 else False
            frame.falling.append(now)
            if level is not self._miso_level:
                self._miso_level = level
                self._miso.set_state("H" if level else "L")

    def _on_data(self, signal: Any, _: Any) -> None:
        if self._frame is not None and signal.sigid == _DIGITAL:
            self._frame.data_changes.append(self._loop.cycle())

    def _end_frame(self, frame: FrameEdges, now: int) -> None:
        self._frame = None
        self._miso.set_state("Z")
        self._miso_level = None
        frame.rise, frame.clock_at_rise = now, bool(self._clock.digital_state())
        self.log.judge(frame)
        clock_hz = F_CPU / frame.usual_clock
        start = frame.fall / F_CPU
        hold = now / F_CPU - start - frame.bits / clock_hz
        reply = self.chip.frame(
            frame.word_in & 0xFFFF,
            start_s=start,
            clock_hz=clock_hz,
            bits=frame.bits,
            cs_hold_s=max(0.0, hold),
        )
        if self.log.keep_words:
            self.replies.append(reply)
        if reply != self._reply:
            self.mismatches.append(
                f"frame {self.log.frames - 1}: shifted 0x{self._reply:04X}, chip 0x{reply:04X}"
            )
        if frame.word_in & 0x8000:
            self._plan_ready()  # the write may have changed the rate or the line

    # -- RST ------------------------------------------------------------------------------------------

    def _on_reset(self, signal: Any, _: Any) -> None:
        if signal.sigid != _DIGITAL:
            return
        if not signal.data.as_uint():
            self._reset_from_s = self.now_s()
        else:
            self.resets.append((self._reset_from_s, self.now_s()))
            self.chip.hard_reset(self.now_s())
            self._plan_ready()

    # -- data-ready -------------------------------------------------------------------------------------

    def _plan_ready(self) -> None:
        """Schedule the next update; not while a frame runs, for the chip must not live past its start."""
        now_s = self.now_s()
        self.chip.run_to(now_s)
        self._pulse = False
        if self.chip.state in _SAMPLING:
            update = self.chip.next_update_s(now_s)
            assert update is not None
            self._schedule(update)
        else:
            self._schedule(now_s + 1e-3)
        self._drive_ready()

    def _schedule(self, time_s: float) -> None:
        self.cycles.schedule(self._ready_timer, max(math.ceil(time_s * F_CPU), self._loop.cycle() + 1))

    def _on_ready_timer(self, when: int) -> int:
        if self._pulse:
            self._pulse = False
            self._drive_ready()
            return self._next_update(when)
        if self._frame is None:
            self.chip.run_to(when / F_CPU)
        if self.chip.state not in _SAMPLING:
            self._drive_ready()
            return when + F_CPU // 1000
        self._pulse = True
        if self.chip.data_ready_enabled:
            self.edges_s.append(when / F_CPU)
        self._drive_ready()
        self._updated = when
        return when + math.ceil(PULSE_S * F_CPU)

    def _next_update(self, when: int) -> int:
        if self._frame is None:
            self.chip.run_to(when / F_CPU)
            if self.chip.state in _SAMPLING:
                update = self.chip.next_update_s(when / F_CPU)
                assert update is not None
                return max(math.ceil(update * F_CPU), when + 1)
            return when + F_CPU // 1000
        return self._updated + round(self.chip.update_period_s * F_CPU)

    def _drive_ready(self) -> None:
        state = "Z"
        if self.chip.data_ready_enabled:
            line = BY_NAME["MSC_CTRL"].field("line").of(self.chip.memory["MSC_CTRL"])
            level = dio_levels(self.chip.memory, pulse=self._pulse, status=0)[line]
            state = "H" if level else "L"
        if state != self._ready_state:
            self._ready_state = state
            self._ready.set_state(state)

    def edge_at(self, cycle: int) -> None:
        """A rising edge of data-ready at a cycle, whatever the chip does; it is low again 20 µs later."""
        states = ["H", "L"]

        def drive(when: int) -> int:
            self._ready.set_state(states.pop(0))
            return when + 320 if states else 0

        self._ready.set_state("L")
        self._own_edge = core.CallableCycleTimer(drive)
        self.cycles.schedule(self._own_edge, cycle)

    @property
    def ready_wire(self) -> str:
        """State of the wire at PD2: `High` and `Low` where it is driven, `Pull up`, `Floating`."""
        return str(self._ready.state())

    def noise_on_ready(self, seed: int, mean_cycles: int) -> None:
        """Edges of data-ready at random times from now on, whatever the chip does."""
        rng = np.random.default_rng(seed)
        high = False

        def drive(when: int) -> int:
            nonlocal high
            high = not high
            self._ready.set_state("H" if high else "L")
            return when + 1 + int(rng.exponential(mean_cycles / 2))

        self._noise = core.CallableCycleTimer(drive)
        self.cycles.schedule(self._noise, self._loop.cycle() + 1)

    # -- memory -------------------------------------------------------------------------------------------

    def paint_stack(self, first_free: int) -> None:
        """Fill the RAM above the variables, below the present stack."""
        top = self._probe.read_sp() - 8
        self._probe.write_data(first_free, bytes([PAINT]) * (top - first_free))

    def deepest_stack(self, first_free: int) -> int:
        """Bytes of stack that were ever used since `paint_stack`."""
        ram = bytes(self._probe.read_data(first_free, RAM_END + 1 - first_free))
        untouched = len(ram) - len(ram.lstrip(bytes([PAINT])))
        return RAM_END + 1 - first_free - untouched

    def register(self, name: str) -> int:
        """What the chip holds in a register."""
        return int(self.chip.memory[name])

    def edges_before(self, time_us: float) -> int:
        """Data-ready edges until a time of the firmware's clock, which began with the simulation."""
        return bisect.bisect(self.edges_s, time_us * 1e-6)

    def check(self) -> None:
        """Every frame so far kept the chip's limits, and the chip shifted out what the rig said."""
        assert not self.log.violations, self.log.violations[:5]
        assert not self.mismatches, self.mismatches[:5]


class HostLine(core.UART.USART):  # type: ignore[misc]
    """The host's transmitter: drives the firmware's RXD bit by bit."""

    def __init__(self, manager: Any, pin: Any, bit_cycles: int) -> None:
        super().__init__()
        self.wire = core.Wire()
        self.wire.set_state("H")
        pin.attach(self.wire)
        self.init(manager)
        self.set_bit_delay(bit_cycles)
        # yasimavr's receiver waits for the end of the stop bit, where the next start bit would begin; a
        # real one is satisfied in its middle.
        self.set_stopbits(2)

    def set_line_state(self, line: Any, state: bool) -> None:
        """Called for every bit."""
        if line == core.UART.Line.TXD:
            self.wire.set_state("H" if state else "L")

    def get_line_state(self, line: Any) -> bool:
        """Nothing comes in here."""
        return True


class RigPort:
    """The host's end of the UART; its time-outs are simulated time.

    Bytes take the line's own time both ways; the host's side has no buffers that could overflow.
    """

    def __init__(self, rig: Rig, device: Any, baud: int) -> None:
        self.sent = self.received = 0
        self._rig = rig
        self._line = HostLine(rig.cycles, device.find_pin("PD0"), F_CPU // baud)
        self._arrived = bytearray()
        self._phase = np.random.default_rng(0)
        self._byte_cycles = 10 * F_CPU // baud
        found, answer = device.ctlreq(core.IOCTL_UART("0"), core.CTLREQ_GET_SIGNAL)
        assert found
        self._hook = core.CallableSignalHook(self._on_byte)
        answer.data.value(core.Signal).connect(self._hook)

    def _on_byte(self, signal: Any, _: Any) -> None:
        if signal.sigid == core.UART.SignalId.TX_Data:
            self._arrived.append(signal.data.value())
            self.received += 1

    def now_s(self) -> float:
        """Simulated time in s."""
        return self._rig.now_s()

    def send(self, data: bytes) -> None:
        """Put bytes on the line; they arrive one after the other at the line's pace.

        They begin at any phase of the firmware's own bytes, as a host's do: in step with the rig's slices a
        request whose bytes coincide with those being sent would be lost again with every repetition.
        """
        self._rig.run(int(self._phase.integers(self._byte_cycles)))
        for byte in data:
            self._line.push_tx(byte)
        self.sent += len(data)

    def receive(self, wait_s: float) -> bytes:
        """Whatever has arrived; waits for the first byte for so long."""
        end = self._rig.now_s() + wait_s
        while not self._arrived and self._rig.now_s() < end:
            self._rig.run(SLICE)
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def close(self) -> None:
        """The line stays; there is nothing to give back."""
