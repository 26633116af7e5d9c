"""Sessions of a simulated world, read through the chip's filter, with what lies between the dwells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.registers import GYRO_LSB_DPS
from adis_gonio.model.records import Dwell, Session, Turn
from adis_gonio.sim import World, WorldSettings
from adis_gonio.sim.sampling import bartlett_sums

PERIOD_S = 1 / 819.2


@dataclass
class Recorder:
    """Follows a world in time: rests become dwells, moves become turns."""

    world: World
    filter_m: int = 2
    now_s: float = 0.0
    dwells: list[Dwell] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    _history: Floats | None = None

    def _samples(self, seconds: float) -> tuple[Floats, Floats, Floats]:
        count = round(seconds / PERIOD_S)
        time = self.now_s + PERIOD_S * np.arange(count)
        self.now_s += count * PERIOD_S
        felt = self.world.sample(time)
        raw = np.column_stack([felt.accel_mg, felt.gyro_dps])
        lsb = np.array([self.world.variant.accel_mg_per_lsb] * 3 + [GYRO_LSB_DPS[300]] * 3)
        fine = np.rint(raw * 1024 / lsb).astype(np.int64)
        if self._history is None:
            self._history = np.repeat(fine[:1], 2 * 2**self.filter_m - 2, axis=0)
        whole = np.concatenate([self._history, fine])
        self._history = whole[len(whole) - len(self._history) :]
        words = np.rint(bartlett_sums(whole, self.filter_m) / (1024 * 4**self.filter_m)) * lsb
        return time, words[:, :3], words[:, 3:]

    def dwell(self, seconds: float, angle_deg: float | None = None, **others: object) -> None:
        """Rest, and record it."""
        time, accel, gyro = self._samples(seconds)
        self.dwells.append(Dwell(len(self.dwells), time, accel, angle_deg, gyro=gyro, **others))

    def turn(
        self,
        begin: Callable[[float], float],
        before_s: float = 0.5,
        after_s: float = 1.0,
        turned_deg: float | None = None,
    ) -> None:
        """Let the stage move, and record it from a rest to a rest."""
        number = len(self.dwells)
        end_s = begin(self.now_s + before_s)
        time, accel, gyro = self._samples(end_s + after_s - self.now_s)
        self.turns.append(Turn(number - 1, number, time, accel, gyro, turned_deg=turned_deg))

    def session(self, **others: object) -> Session:
        """What was recorded."""
        turns = tuple(self.turns)
        facts = {"configuration": {"filter_m": self.filter_m, "gyro_range_dps": 300}}
        return Session(tuple(self.dwells), accel_unit="mg", facts=facts, turns_from=lambda: turns, **others)


def planar(seed: int, angles_deg: Sequence[float], *, dwell_s: float = 4.0, **settings: float) -> Recorder:
    """A session on the stage: dwells at these angles, one after another."""
    world = World(WorldSettings(**settings), seed=seed)
    recorder = Recorder(world)
    for k, angle in enumerate(angles_deg):
        if k:
            recorder.turn(lambda at, to=angle: world.stage.move_to(at, to))
        recorder.dwell(dwell_s, angle)
    return recorder
