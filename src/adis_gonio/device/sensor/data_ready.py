"""The chip's data-ready line: enabled for a stream or a session, and checked before use.

An input may show edges even if nothing or something else drives it. The line is therefore used only if the
bridge counts about one edge for each update, and if no update falls into the scans that start at the edge.
Without edges, as without the wire, scans are polled.

ND in the words of one scan does not show an update during the scan: every register has one update between
two reads, at any place in the scan. A trial therefore reads the first register of the scan once more at its
end. At an edge before the update the first read finds new data and the last read none; if the update
comes within the scan it is the opposite.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from adis_gonio.base.errors import AdisGonioError, ChipError, VerifyError
from adis_gonio.device.bus import Capability, SpiBus
from adis_gonio.device.sensor.registers import BY_NAME, ND, Register, read_frames, write_frames

if TYPE_CHECKING:
    from adis_gonio.device.sensor.driver import Adis16354

USED_BY = frozenset({Capability.STREAM, Capability.EVENT_COUNTER})
"""Capabilities that need data-ready."""

UpdateEdge = Literal["first", "last"]

UPDATE_EDGE: UpdateEdge = "first"
"""Edge of the pulse at which the outputs are new. The pulse announces new data (MSC_CTRL[2], A); the choice
of its first edge is inferred, without support in data sheet or code (C). `edge_at_update` checks it, and
`DataReadyLoan` takes the other edge if the declared one is wrong."""

_PERIODS = 2.5
"""Minimum duration of the count in updates, so that two edges fall into it."""
_COUNT_S = 0.1
"""Minimum duration of the count."""
_RATE_TOLERANCE = 0.25
"""Tolerance of the rate of edges relative to the rate of updates. The chip's clock is off by some percent,
and the host times a bridge without its own clock."""
_EDGES_TOLERANCE = 1.5
"""Tolerance in edges for the two ends of the count."""
_TRIAL_SCANS = (4, 32)
"""Smallest and largest number of trial scans."""
_LEADS_SHARE = 0.9
"""Minimum share of trial scans without an update in them for a correct edge, which has all."""
_MOST_BEFORE = 30
"""Most registers of a trial before the repeated one; the list of a bridge has 32."""

_ROW = BY_NAME["MSC_CTRL"]
_POLARITY = _ROW.field("polarity").mask
MASK = _ROW.field("data_ready").mask | _POLARITY | _ROW.field("line").mask
"""Bits of MSC_CTRL that belong to data-ready."""


def edges_arrive(bus: SpiBus, period_s: float) -> bool:
    """True if one data-ready edge comes for each update, or if the bus cannot count; False without edges.

    Takes 0.1 s or 2.5 updates of `period_s`, whichever is longer.

    Raises
    ------
    ChipError
        Edges come, but not at the rate of the chip's updates, so another device makes them.
    """
    if Capability.EVENT_COUNTER not in bus.capabilities:
        return True
    _, begin_s = bus.count_events()
    bus.sleep_s(max(_PERIODS * period_s, _COUNT_S))
    edges, end_s = bus.count_events()
    expected = (end_s - begin_s) / period_s
    if edges and abs(edges - expected) > _EDGES_TOLERANCE + _RATE_TOLERANCE * expected:
        raise ChipError(
            f"{bus.url}: {edges / (end_s - begin_s):.4g} edges a second on the data-ready line, but the"
            f" sensor samples {1 / period_s:.4g} times a second: wire the line to DIO1 and to nothing else,"
            " or hold it high if there is no wire (docs/hardware.md)"
        )
    return edges > 0


def edge_at_update(bus: SpiBus, table: Sequence[Register], period_s: float) -> bool:
    """True if no update of the sensor happens during scans that start at the data-ready edge.

    Takes 0.1 s or 4 updates, whichever is longer.
    """
    least, most = _TRIAL_SCANS
    scans = min(max(least, math.ceil(_COUNT_S / period_s)), most)
    first = next(k for k, row in enumerate(table) if row.flags)
    # A list too long for the bridge is refused here as it would be in the stream.
    rows = table if len(table) > _MOST_BEFORE + 1 else [*table[first:], table[first]]
    frames = [int(frame) for frame in read_frames(rows)]
    with contextlib.closing(bus.stream(frames, block_scans=scans)) as stream:
        new = (next(stream).words[1:, [0, -1]] & ND).astype(bool)  # the first scan has no read before it
    takes_s = len(frames) * bus.timing.frame_s
    within = new[:, 1] if takes_s < period_s else np.zeros(len(new), bool)
    return bool((new[:, 0] & ~within).mean() >= _LEADS_SHARE)


def wrong_edge_error(bus: SpiBus) -> ChipError:
    """Make the error for data-ready edges that do not mark updates: updates fall into their scans."""
    return ChipError(
        f"{bus.url}: the sensor's updates fall into scans that start at the data-ready edges (bit ND of a"
        " register read twice): the edges are not the updates', or MSC_CTRL[1] selects the wrong end of the"
        " pulse; check the line's wire (docs/hardware.md)"
    )


class DataReadyLoan:
    """Enables data-ready on DIO1, the line wired to the bridges, until the old setting is restored.

    The polarity is chosen so that the edge used by the bus comes at the update. Only the low byte
    of MSC_CTRL is written, and only its three bits of data-ready change.

    Parameters
    ----------
    sensor : Adis16354
        Sensor with the line.
    table : sequence of Register
        Registers of the scans.
    edge : {"first", "last"}
        Edge of the pulse expected at the update.

    Attributes
    ----------
    edge : {"first", "last"}
        Edge that is used.
    wired : bool
        False if no edge arrives; MSC_CTRL is then already restored.

    Raises
    ------
    VerifyError
        A value read back differs.
    ChipError
        Edges arrive, but not at the chip's updates. MSC_CTRL is restored.
    """

    def __init__(
        self, sensor: Adis16354, table: Sequence[Register], period_s: float, edge: UpdateEdge = UPDATE_EDGE
    ) -> None:
        self._sensor = sensor
        self.edge = edge
        self._before = sensor.read(_ROW) & MASK
        self._ours = self._before
        try:
            self._enable()
            self.wired = edges_arrive(sensor.bus, period_s)
            if self.wired:
                self._find_edge(table, period_s)
            else:
                self.give_back()
        except BaseException:
            with contextlib.suppress(AdisGonioError):  # the first error counts
                self.give_back()
            raise

    def give_back(self) -> None:
        """Restore the data-ready bits, unless another program has changed them; may be called twice."""
        if self._ours != self._before and self._sensor.read(_ROW) & MASK == self._ours:
            self._set(self._before)
        self._ours = self._before

    def _find_edge(self, table: Sequence[Register], period_s: float) -> None:
        """Select the end of the pulse at which updates happen: the declared one, or else the other.

        Raises `ChipError` if neither end fits.
        """
        if Capability.STREAM not in self._sensor.bus.capabilities:
            return  # nothing starts at an edge
        for _ in range(2):
            if edge_at_update(self._sensor.bus, table, period_s):
                return
            self.edge = "last" if self.edge == "first" else "first"
            self._enable()
        raise wrong_edge_error(self._sensor.bus)

    def _enable(self) -> None:
        ours = _ROW.field("data_ready").mask
        # A pulse that is high begins with a rising edge and ends with a falling one.
        if self._sensor.bus.edge_rises == (self.edge == "first"):
            ours |= _POLARITY
        if ours != self._ours:
            self._set(ours)
            self._ours = ours

    def _set(self, bits: int) -> None:
        sensor = self._sensor
        word = sensor.read(_ROW) & ~MASK | bits
        sensor.bus.exchange_array(write_frames(_ROW, word & _ROW.write_mask, byte_mask=0x00FF))
        back = sensor.read(_ROW)
        if (back ^ word) & 0x00FF & _ROW.write_mask:
            raise VerifyError(f"MSC_CTRL: wrote 0x{word & 0xFF:02X}, read back 0x{back & 0xFF:02X}")
