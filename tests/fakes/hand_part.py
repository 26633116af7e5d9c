"""A part on a stage that a person moves: the simulated chip behind a bus that has neither stage nor truth.

What a hand does comes as lines of text, from a test or, for a program of its own, from a file:

    turn ANGLE [AFTER]          turn the stage to an angle in degrees, AFTER seconds from now
    orient X Y Z                hold the part so that an ideal sensor reads along a vector
    shake AFTER SIZE LENGTH     a broadband shaking, SIZE mg rms for LENGTH seconds
    knock AFTER ANGLE           the part slips in its clamp, for good
    nudge AFTER ANGLE           the stage is moved; the next turn sets it right
    unplug AFTER                the bus is gone until the next one is opened
    sleep SECONDS               time passes

Unlike the stage of `sim:`, nothing here draws an error of its own: the hand says where the part really is.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.device.bus import FrameBlock, FrameStream
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.model.effects.base import AXES
from adis_gonio.sim import SimBus, World
from adis_gonio.sim.sampling import Inputs
from adis_gonio.sim.settings import WorldSettings

PULSE_HZ = (7.0, 23.0, 61.0)
"""A hand's tremor, a table's swing, a knock's ring."""


class ShakenWorld(World):
    """A world that is shaken at times: `shakes` holds begin in s, rms in mg and length in s."""

    shakes: tuple[tuple[float, float, float], ...] = ()

    def sample(self, time_s: Floats) -> Inputs:
        inputs = super().sample(time_s)
        accel = np.array(inputs.accel_mg)
        for begin_s, size_mg, length_s in self.shakes:
            now = (time_s >= begin_s) & (time_s < begin_s + length_s)
            since = time_s[now] - begin_s
            for k in range(3):
                accel[now, k] += size_mg * np.sin(2 * np.pi * PULSE_HZ[k] * since + k)
        return replace(inputs, accel_mg=accel)


class HandPart:
    """One part with its hidden truth, over several times that it is switched on.

    Parameters
    ----------
    seed : int
        Draws the truth, and with the number of the power-on the noise.
    """

    def __init__(self, seed: int, powered: int = 0) -> None:
        self.seed, self.powered = seed, powered
        self.angle_deg = 0.0
        self.slipped_deg = 0.0
        self.direction: tuple[float, ...] | None = None
        self.lived_s = 0.0
        drawn = self._drawn = World(seed=seed).truth()
        gyro = np.random.default_rng([seed, 1]).standard_normal(3)
        self.settings = WorldSettings(
            alpha_deg=drawn["alpha"],
            delta_k=drawn["delta_k"],
            delta_phi_deg=drawn["delta_phi"],
            scale_y=drawn["scale_y"],
            scale_z=drawn["scale_z"],
            skew_xz_deg=drawn["skew_xz"],
            skew_yz_deg=drawn["skew_yz"],
            fixture_sigma_deg=0.0,
            temperature_offset_sigma_c=0.0,
            **{f"bias_{axis}_mg": drawn[f"bias_{axis}"] for axis in AXES},
            **{f"bias_tempco_{axis}_mg_per_c": drawn[f"bias_temperature_{axis}"] for axis in AXES},
            **{f"scale_tempco_{axis}_ppm_per_c": 1e6 * drawn[f"scale_temperature_{axis}"] for axis in AXES},
            **{f"gyro_bias_{axis}_dps": float(gyro[k]) for k, axis in enumerate(AXES)},
        )

    def switch_on(
        self, kind: type[HandBus] | None = None, *, virtual_time: bool = False, url: str = ""
    ) -> HandBus:
        """A bus of this part as it lies now; the one before has to be closed."""
        self.powered += 1
        world = ShakenWorld(self.settings, seed=1000 * self.seed + self.powered)
        url = url or f"hand:?seed={self.seed}"
        return (kind or HandBus)(self, world, virtual_time=virtual_time, url=url)

    def truth(self) -> dict[str, float]:
        """What a perfect calibration would find: the part is at 25 °C, where its figures hold."""
        return dict(self._drawn)


class HandBus(SimBus):
    """The bus of a `HandPart`; time is virtual, whatever `virtual_time` says to the session.

    Attributes
    ----------
    delivered : list of (n, k) uint16
        Words of each block that a stream has given.
    """

    def __init__(self, part: HandPart, world: ShakenWorld, *, virtual_time: bool, url: str) -> None:
        super().__init__(world=world, url=url)
        self.part, self.hands, self.shaken = part, world.stage, world
        self.stage = self.world = None
        self._virtual = virtual_time
        self._unplug_s = math.inf
        self.delivered: list[np.ndarray] = []
        self.chip.frames_at = self._while_plugged(self.chip.frames_at)
        if part.direction is not None:
            self.hands.orient(0.0, np.array(part.direction))
        elif part.angle_deg + part.slipped_deg:
            self.hands.move_to(0.0, part.angle_deg + part.slipped_deg)
        self.sleep_s(max(self.hands.still_at_s, 0.0) + 2.0)

    @property
    def virtual_time(self) -> bool:
        return self._virtual

    def _while_plugged(self, exchange):
        def checked(*arguments, **options):
            if self.now_s() >= self._unplug_s:
                raise BusTimeoutError(f"{self.url}: no answer; is the cable plugged in?")
            return exchange(*arguments, **options)

        return checked

    def stream(self, frames, *, block_scans: int = 256) -> FrameStream:
        return LoggedStream(super().stream(frames, block_scans=block_scans), self.delivered)

    def _close(self) -> None:
        self.part.lived_s += self.now_s()
        super()._close()

    # -- what a hand does --------------------------------------------------------------------------

    def obey(self, line: str) -> None:
        """Do what a line says."""
        name, *numbers = line.split()
        getattr(self, f"_{name}")(*(float(number) for number in numbers))

    def _begin(self, after_s: float) -> float:
        return max(self.now_s() + after_s, self.chip.time_s, self.hands.still_at_s)

    def _turn(self, angle_deg: float, after_s: float = 0.0) -> None:
        self.part.angle_deg, self.part.direction = angle_deg, None
        self.hands.move_to(self._begin(after_s), angle_deg + self.part.slipped_deg)

    def _orient(self, *vector: float) -> None:
        self.part.direction = vector
        self.hands.orient(self._begin(0.0), np.array(vector))

    def _knock(self, after_s: float, angle_deg: float) -> None:
        self.part.slipped_deg += angle_deg
        if self.part.direction is None:
            self._nudge(after_s, 0.0)

    def _nudge(self, after_s: float, angle_deg: float) -> None:
        self.part.angle_deg += angle_deg
        self.hands.move_to(self._begin(after_s), self.part.angle_deg + self.part.slipped_deg)

    def _shake(self, after_s: float, size_mg: float, length_s: float) -> None:
        self.shaken.shakes += ((self._begin(after_s), size_mg, length_s),)

    def _unplug(self, after_s: float) -> None:
        self._unplug_s = self.now_s() + after_s

    def _sleep(self, seconds: float) -> None:
        self.sleep_s(seconds)


class LoggedStream(FrameStream):
    """A stream that keeps what it has given."""

    def __init__(self, inner: FrameStream, delivered: list[np.ndarray]) -> None:
        self._inner, self._delivered = inner, delivered

    def __next__(self) -> FrameBlock:
        block = next(self._inner)
        self._delivered.append(block.words)
        return block

    def close(self) -> None:
        self._inner.close()


class FileHandBus(HandBus):
    """Does what is written into a file, before each exchange and each block of a stream."""

    control: Path | None = None
    _read = 0

    def _while_plugged(self, exchange):
        checked = super()._while_plugged(exchange)

        def followed(*arguments, **options):
            lines = self.control.read_text().splitlines() if self.control else []
            while self._read < len(lines):
                self._read += 1
                self.obey(lines[self._read - 1])
            return checked(*arguments, **options)

        return followed


def open_from_url(url: BusUrl) -> FileHandBus:
    """Open `hand:?seed=1&powered=0&control=FILE&angle=0&slipped=0&virtual=1`."""
    options = url.options
    part = HandPart(int(options["seed"]), int(options["powered"]))
    part.angle_deg, part.slipped_deg = float(options["angle"]), float(options["slipped"])
    bus = part.switch_on(FileHandBus, virtual_time=options["virtual"] == "1", url=url.text)
    bus.control = Path(options["control"])
    return bus


__all__ = ["FileHandBus", "HandBus", "HandPart", "ShakenWorld", "open_from_url"]
