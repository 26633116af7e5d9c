"""A chip on wires: constant or given inputs, and a host that builds its frames by hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adis_gonio.sim import Inputs, SimulatedChip

LEVEL = (0.0, 0.0, -1000.0)


class Quiet:
    """Surroundings without noise; each quantity is a constant or a function of time."""

    def __init__(
        self,
        accel_mg=LEVEL,
        gyro_dps=(0.0, 0.0, 0.0),
        temperature_c=(25.0, 25.0, 25.0),
        supply_v=5.0,
        aux_v=1.0,
    ):
        self.accel_mg = accel_mg
        self.gyro_dps = gyro_dps
        self.temperature_c = temperature_c
        self.supply_v = supply_v
        self.aux_v = aux_v
        self.times: list[float] = []

    def sample(self, time_s):
        self.times += list(time_s)
        return Inputs(
            *(_rows(value, time_s, 3) for value in (self.accel_mg, self.gyro_dps, self.temperature_c)),
            *(_rows(value, time_s, 1)[:, 0] for value in (self.supply_v, self.aux_v)),
        )


def _rows(value, time_s, width):
    if isinstance(value, Callable):
        value = value(time_s)
    value = np.asarray(value, float)
    if width == 1:
        value = value.reshape(-1, 1) if value.ndim else value.reshape(1, 1)
    return np.array(np.broadcast_to(value, (len(time_s), width)))


def rd(address):
    """Read frame."""
    return address << 8


def wr(address, data):
    """Write frame of one byte."""
    return 0x8000 | address << 8 | data


def frames_apart(chip, words, *, start_s, frame_s, clock_hz):
    """Replies to frames that start `frame_s` apart."""
    return chip.frames_at(words, start_s + frame_s * np.arange(len(words), dtype=float), clock_hz=clock_hz)


class Host:
    """Sends frames one by one with a timing that every mode accepts."""

    def __init__(self, surroundings=None, start=True, **options):
        self.world = surroundings or Quiet()
        self.chip = SimulatedChip(self.world, **options)
        self.now = 0.0
        self.clock_hz = 250e3
        if start:
            self.wait(0.2)

    def wait(self, seconds):
        self.now += seconds

    def send(self, word):
        reply = self.chip.frame(word, start_s=self.now, clock_hz=self.clock_hz)
        self.now += 200e-6
        return reply

    def read(self, address):
        self.send(rd(address))
        return self.send(0)

    def write(self, address, word):
        """Both bytes, low first."""
        self.send(wr(address, word & 0xFF))
        self.send(wr(address + 1, word >> 8))

    def write_low(self, address, data):
        self.send(wr(address, data))

    def settle(self, updates=260):
        self.wait(updates * self.chip.update_period_s)

    def save(self):
        self.write_low(0x3E, 0x08)
        self.wait(0.11)

    def reset(self):
        self.write_low(0x3E, 0x80)
        self.wait(0.2)

    @property
    def silent(self):
        """True where the chip answers no more."""
        return [self.send(rd(0x36)) for _ in range(4)] == [0xFFFF] * 4


def signed(word, bits):
    """Number of a word, by hand."""
    data = word & ((1 << bits) - 1)
    return data - (1 << bits) if data >> (bits - 1) else data
