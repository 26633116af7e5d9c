"""The chip's data-ready line, lent to a stream for as long as it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.bus import Capability
from adis_gonio.errors import VerifyError
from adis_gonio.sensor.frames import write_frames
from adis_gonio.sensor.registers import BY_NAME

if TYPE_CHECKING:
    from adis_gonio.sensor.driver import Adis16354

USED_BY = frozenset({Capability.STREAM, Capability.EVENT_COUNTER})
"""Capabilities that need data-ready."""

_PERIODS = 2.5
"""Updates that are waited for when the line is tried: two at least fall into it."""

_ROW = BY_NAME["MSC_CTRL"]
_MASK = _ROW.field("data_ready").mask | _ROW.field("polarity").mask | _ROW.field("line").mask


class DataReadyLoan:
    """Enables data-ready on DIO1, where the bridges' wiring has it, and sets back what stood there.

    The polarity is taken so that the edge which the bus waits for is the pulse's first. Only the low byte
    of MSC_CTRL is written, and of that only the three bits of data-ready change.

    Raises
    ------
    VerifyError
        What was read back differs.
    """

    def __init__(self, sensor: Adis16354) -> None:
        self._sensor = sensor
        self._before = sensor.read(_ROW) & _MASK
        self._ours = _ROW.field("data_ready").mask
        if sensor.bus.edge_rises:
            self._ours |= _ROW.field("polarity").mask
        self._set(self._ours)

    def arrives(self, period_s: float) -> bool:
        """True where the bridge sees edges, or cannot tell; takes 2.5 updates of `period_s`."""
        bus = self._sensor.bus
        if Capability.EVENT_COUNTER not in bus.capabilities:
            return True
        bus.read_event_counter()
        bus.sleep_s(_PERIODS * period_s)
        return bus.read_event_counter() > 0

    def give_back(self) -> None:
        """Set the bits back, unless somebody else has changed them meanwhile; may be called twice."""
        if self._sensor.read(_ROW) & _MASK == self._ours:
            self._set(self._before)

    def _set(self, bits: int) -> None:
        sensor = self._sensor
        word = sensor.read(_ROW) & ~_MASK | bits
        sensor.bus.exchange_array(write_frames(_ROW, word & _ROW.write_mask, byte_mask=0x00FF))
        back = sensor.read(_ROW)
        if (back ^ word) & 0x00FF & _ROW.write_mask:
            raise VerifyError(f"MSC_CTRL: wrote 0x{word & 0xFF:02X}, read back 0x{back & 0xFF:02X}")
