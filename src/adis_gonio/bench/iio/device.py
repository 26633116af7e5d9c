"""The contract of an IIO device, local or by network."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from adis_gonio.bench.iio.channels import IioChannel

TIMESTAMP = "timestamp"


@dataclass(frozen=True)
class DeviceFacts:
    """What a device says of itself when it is opened.

    Attributes
    ----------
    id, name : str
        Such as `iio:device0`, `adxl345`.
    channels : tuple of IioChannel
        Inputs, the timestamp among them where there is one.
    rate_hz : float or None
        None where the device does not say.
    """

    id: str
    name: str
    channels: tuple[IioChannel, ...]
    rate_hz: float | None


class IioDevice(Protocol):
    """A device that can be read; every method raises `BusError` where it fails.

    Attributes
    ----------
    where : str
        Its name in messages.
    """

    where: str

    def facts(self) -> DeviceFacts:
        """Read what the device says of itself."""

    def read_raw(self, channel: str) -> float:
        """Present raw number of a channel."""

    def open_buffer(self, channels: tuple[IioChannel, ...], samples: int) -> None:
        """Begin to buffer scans of these channels."""

    def read_buffer(self, size: int, timeout_s: float) -> bytes:
        """At least one scan where `size` is a scan's, at most so many bytes of whole scans."""

    def close_buffer(self) -> None:
        """End buffering and set back what was changed for it; may be called twice."""

    def close(self) -> None:
        """Forget the device; may be called twice."""
