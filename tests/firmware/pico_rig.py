"""The Pico's UF2 in an emulated RP2040, with a chip on its pins and a USB host: tests/rig_rp2040/, a Node
program that answers requests on its standard input.

Everything happens in simulated time, and time runs only within a request. `PicoRig.port` is what a host's
program sees of the serial port. `PtyCable` hangs the rig on a pseudo-terminal, for programs that want a
device file.

What rp2040js 1.4.1 does otherwise than the part is said in docs/testing.md.
"""

from __future__ import annotations

import atexit
import bisect
import contextlib
import json
import os
import subprocess
import threading
import time
import tty
from pathlib import Path
from typing import Any, ClassVar

from adis_gonio.device.sensor.registers import BY_NAME
from firmware.pico_build import RIG

ANSWER_S = 300.0
"""Longest wall time for one request; the watchdog ends the emulator then."""


class Emulator:
    """A process of the Node program. A warm one is far faster, so it is kept for the next rig."""

    _free: ClassVar[list[Emulator]] = []

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            ["node", str(RIG / "rig.js")], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self._lock = threading.Lock()
        atexit.register(self.end)

    @classmethod
    def take(cls) -> Emulator:
        """One that nobody uses."""
        return cls._free.pop() if cls._free else cls()

    def give_back(self) -> None:
        """For the next rig, if it still runs."""
        if self._process.poll() is None:
            self._free.append(self)

    def ask(self, **request: Any) -> dict[str, Any]:
        """Answer to a request (see rig.js).

        Raises
        ------
        RuntimeError
            The request failed in there, or the process ended.
        """
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        with self._lock:
            watchdog = threading.Timer(ANSWER_S, process.kill)
            watchdog.start()
            try:
                process.stdin.write(json.dumps(request).encode() + b"\n")
                process.stdin.flush()
                line = process.stdout.readline()
            finally:
                watchdog.cancel()
        if not line:
            raise RuntimeError("the emulator ended")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer

    def end(self) -> None:
        """End the process."""
        process = self._process
        process.kill()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
        process.wait(10)


class PicoRig:
    """Firmware, chip and USB host.

    Parameters
    ----------
    image : Path
        The UF2 file.
    chip : dict
        Options of the chip: part, seed, accelMg, supplyV.
    stock_host : bool
        The USB host of rp2040js in place of ours.
    """

    def __init__(self, image: Path, *, stock_host: bool = False, **chip: Any) -> None:
        self._emulator = Emulator.take()
        self._ask = self._emulator.ask
        self._ns = 0.0
        try:
            self._ask(op="new", image=str(image), chip=chip, stock_host=stock_host)
        except BaseException:
            self.close()
            raise
        self.port = PicoPort(self)
        self.log = PicoLog(self)

    # -- time ------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Simulated time in s."""
        return self._ns * 1e-9

    def sleep_s(self, seconds: float) -> None:
        """Let the firmware run for a time; what arrives is kept."""
        self.port.arrived += self.run(seconds)

    def run(self, seconds: float, send: bytes = b"", *, for_data: bool = False) -> bytes:
        """Let the firmware run for a time, or until bytes arrive."""
        answer = self._ask(op="run", until_ns=self._ns + seconds * 1e9, send=send.hex(), for_data=for_data)
        self._ns = answer["ns"]
        return bytes.fromhex(answer["data"])

    # -- what the pins saw -----------------------------------------------------------------------

    @property
    def state(self) -> dict[str, Any]:
        """Figures of the pins, the chip and the USB host; see rig.js."""
        return self._ask(op="state")

    def keep_frames(self) -> None:
        """Remember every frame from now on."""
        self._ask(op="keep")

    def capture(self, path: Path) -> None:
        """Write the SPI pins from now on to a VCD file."""
        self._ask(op="vcd", path=str(path))

    def frames(self, first: int = 0) -> list[tuple[int, float, float, float, int]]:
        """Word, fall and rise of chip select in ns, clock in Hz and reply of the frames kept."""
        return [tuple(frame) for frame in self._ask(op="frames", **{"from": first})["frames"]]

    @property
    def replies(self) -> list[int]:
        """What the chip shifted out in the frames kept."""
        return [frame[4] for frame in self.frames()]

    def twin_frame(self, word: int, fall_ns: float, rise_ns: float) -> int:
        """What a second chip, alike in all, answers to a frame."""
        return int(self._ask(op="twin", word=word, fall_ns=fall_ns, rise_ns=rise_ns)["reply"])

    def register(self, name: str) -> int:
        """What the chip holds in a register."""
        return int(self.state["memory"][BY_NAME[name].address])

    @property
    def resets(self) -> list[tuple[float, float]]:
        """Begin and end of RST's low times in s."""
        return [(low * 1e-9, high * 1e-9) for low, high in self.state["resets_ns"]]

    @property
    def edges_ns(self) -> list[float]:
        """Leading edges of data-ready."""
        return list(self._ask(op="edges")["ns"])

    def edges_before(self, time_us: float) -> int:
        """Data-ready edges until a time of the simulation."""
        return bisect.bisect(self.edges_ns, time_us * 1e3)

    def forget(self) -> None:
        """Start the tightest values anew."""
        self._ask(op="forget")

    def noise_on_ready(self, mean_us: float) -> None:
        """Edges of data-ready at random times from now on, whatever the chip does."""
        self._ask(op="noise", mean_ns=mean_us * 1000)

    # -- the cable, the host, the memory ---------------------------------------------------------

    def unplug(self) -> None:
        """Pull the cable: the board loses its power."""
        self._ask(op="unplug")

    def host(self, **options: int) -> None:
        """Change what the USB host does: in_every, baud, clear_halt (see rig.js)."""
        self._ask(op="host", **options)

    def paint_stack(self, first_free: int) -> None:
        """Fill the RAM above the variables, below the present stack."""
        self._ask(op="paint", **{"from": first_free})

    def deepest_stack(self, first_free: int) -> int:
        """Bytes of stack that were ever used since `paint_stack`."""
        return int(self._ask(op="stack", **{"from": first_free})["bytes"])

    def check(self) -> None:
        """Every frame so far kept the chip's limits, and nothing was done that an RP2040 does not bear."""
        violations = self.log.violations
        assert not violations, violations[:5]

    def close(self) -> None:
        """The emulator is free for another rig."""
        self._emulator.give_back()


class PicoLog:
    """What the emulator's judge saw, with the names of `firmware.pins.PinLog`."""

    def __init__(self, rig: PicoRig) -> None:
        self._rig = rig
        self._keeps = False

    @property
    def frames(self) -> int:
        """Frames so far."""
        return int(self._rig.state["frames"])

    @property
    def fast_frames(self) -> int:
        """Those while the chip was in fast mode."""
        return int(self._rig.state["fast_frames"])

    @property
    def writes(self) -> int:
        """Those with the write bit."""
        return int(self._rig.state["writes"])

    @property
    def keep_words(self) -> bool:
        """Whether words and replies are kept."""
        return self._keeps

    @keep_words.setter
    def keep_words(self, keep: bool) -> None:
        assert keep, "what is kept stays"
        self._keeps = True
        self._rig.keep_frames()

    @property
    def words(self) -> list[int]:
        """Words of the frames kept."""
        return [frame[0] for frame in self._rig.frames()]

    @property
    def violations(self) -> list[str]:
        """Limits that a frame broke, and what an RP2040 does not bear; the first twenty of each."""
        state = self._rig.state
        return [*state["violations"], *state["faults"]]

    def forget(self) -> None:
        """Start the tightest values anew."""
        self._rig.forget()

    def tightest_us(self) -> dict[str, float]:
        """Tightest values of each mode, in µs."""
        return {name: value / 1000 for name, value in self._rig.state["least_ns"].items()}

    def least_us(self, what: str, mode: str) -> float:
        """Tightest stall, period or clock period seen in a mode, in µs."""
        return self.tightest_us()[f"{mode} {what}"]


class PicoPort:
    """The host's program at the serial port; its time-outs are simulated time."""

    def __init__(self, rig: PicoRig) -> None:
        self._rig = rig
        self._sending = b""
        self.arrived = b""
        self.received = 0

    def now_s(self) -> float:
        """Simulated time in s."""
        return self._rig.now_s()

    def send(self, data: bytes) -> None:
        """Hand bytes to the USB host, which sends them with the next run."""
        self._sending += data

    def receive(self, wait_s: float) -> bytes:
        """Whatever has arrived; waits for the first byte for so long."""
        sending, self._sending = self._sending, b""
        data, self.arrived = self.arrived, b""
        data += self._rig.run(0.0 if data else wait_s, sending, for_data=True)
        self.received += len(data)
        return data

    def close(self) -> None:
        """The rig stays; there is nothing to give back."""


class PtyCable:
    """The rig on a pseudo-terminal: its `path` is a serial port like any other.

    Simulated time runs as fast as it can while the cable is in. `now_s` and `sleep_s` make it a bus's
    clock: no limit depends on how fast that is.
    """

    SLICE_S = 1e-3

    def __init__(self, rig: PicoRig) -> None:
        self._rig = rig
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.path = os.ttyname(self._theirs)
        self._running = True
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def now_s(self) -> float:
        """Simulated time in s."""
        return self._rig.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait until the simulation is so much further."""
        end_s = self.now_s() + seconds
        while self.now_s() < end_s and self._running:
            time.sleep(0.001)

    def _pump(self) -> None:
        waiting = b""
        while self._running:
            data = b""
            with contextlib.suppress(BlockingIOError):
                data = os.read(self._ours, 4096)
            waiting += self._rig.run(self.SLICE_S, data)
            if waiting:
                with contextlib.suppress(BlockingIOError):
                    waiting = waiting[os.write(self._ours, waiting) :]

    def pull(self) -> None:
        """Pull the cable; the device file is gone."""
        if self._running:
            self._running = False
            self._thread.join(ANSWER_S)
            self._rig.unplug()
            os.close(self._ours)
            os.close(self._theirs)
