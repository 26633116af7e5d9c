"""Attributes by request: reading them without disturbing the stream, writing them where that is allowed."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TypeVar

from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import Register
from adis_gonio.faces.serve.device import (
    DEBUG_ATTRIBUTES,
    DEVICE_ATTRIBUTES,
    OFFSET_OF,
    WRITABLE,
    Channel,
    ServedDevice,
    filter_for,
)
from adis_gonio.faces.serve.protocol import Errno, Refused, Target
from adis_gonio.faces.serve.sampler import Sampler

T = TypeVar("T")


@dataclass(frozen=True)
class AttributePort:
    """Attributes of the served device.

    Attributes
    ----------
    allow_writes : bool
        False refuses every write with EPERM.
    debug : callable
        Values of the debug attributes.
    """

    device: ServedDevice
    sampler: Sampler
    allow_writes: bool
    debug: Callable[[], Mapping[str, int]]

    def names(self, target: Target) -> tuple[str, ...]:
        """Names of a target's attributes; `Refused` where there is no such target."""
        if not self.device.knows(target.device):
            raise Refused(Errno.ENODEV, f"no device {target.device}")
        match target.kind:
            case "device":
                return DEVICE_ATTRIBUTES
            case "debug":
                return DEBUG_ATTRIBUTES
            case "buffer":
                return ()
            case "input":
                return self.device.channel(target.channel).attributes
            case "output":
                raise Refused(Errno.ENXIO, "a sensor has no outputs")

    async def read(self, target: Target, name: str) -> str:
        """Text of an attribute; `Refused` where there is none, or the sensor fails."""
        if name not in self.names(target):
            raise Refused(Errno.ENOENT, f"no attribute {name}")
        if target.kind == "debug":
            return str(self.debug()[name])
        if target.kind == "device":
            return self.device.device_value(name, self.sampler.state)
        channel = self.device.channel(target.channel)
        if name == "raw" and channel.register is not None:
            return str(await self._raw(channel.register))
        return self.device.channel_value(channel, name, self.sampler.state)

    async def write(self, target: Target, name: str, value: bytes) -> None:
        """Write an attribute; `Refused` where that is not allowed, or the value is not possible."""
        if name not in self.names(target):
            raise Refused(Errno.ENOENT, f"no attribute {name}")
        if name not in WRITABLE:
            raise Refused(Errno.EACCES, f"{name} cannot be written")
        if not self.allow_writes:
            raise Refused(Errno.EPERM, f"{name}: this server is read-only")
        number = _number(value)
        match name:
            case "calibbias":
                await self._write_bias(self.device.channel(target.channel), number)
            case "sampling_frequency":
                await self._change(lambda s: s.configure(sample_rate_hz=number))
            case _:
                taps = filter_for(number, self.sampler.state)
                await self._change(lambda s: s.configure(filter_m=taps))

    async def _write_bias(self, channel: Channel, number: float) -> None:
        if channel.register is None or not number.is_integer():
            raise Refused(Errno.EINVAL, f"calibbias is a whole number, not {number:g}")
        name = OFFSET_OF[channel.register.name]
        await self._change(lambda s: s.write(name, int(number)))

    async def _raw(self, row: Register) -> int:
        newest = self.sampler.newest
        if newest is not None:
            return newest[row.name]
        return await self._do(self.sampler.submit(lambda s: s.read(row)))

    async def _change(self, job: Callable[[Adis16354], object]) -> None:
        await self._do(self.sampler.submit(job, changes=True))

    async def _do(self, future: Future[T]) -> T:
        try:
            return await asyncio.wrap_future(future)
        except UsageError as error:
            raise Refused(Errno.EINVAL, str(error)) from error
        except AdisGonioError as error:
            raise Refused(Errno.EIO, str(error)) from error


def _number(value: bytes) -> float:
    """Number of an attribute's text; libiio sends the terminating zero along."""
    text = value.split(b"\0", 1)[0].strip()
    try:
        number = math.nan if b"_" in text else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise Refused(Errno.EINVAL, "the value is no number")
    return number
