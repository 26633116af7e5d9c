"""Registers are put back and verified, also after an error or an interruption."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.frames import NORMAL, write_frames
from adis_gonio.device.sensor.registers import Register

_TRIES = 4
"""The operator's Ctrl-C or a bus that fails once must not keep a register from going back."""


class Undo:
    """Notes registers; `put_back` restores what differs and reads it back.

    Parameters
    ----------
    sensor : Adis16354
        Open.
    rows : sequence of Register
        Writable registers.
    before : mapping of str to int or None
        Words by name to go back to; None notes those that are there now.

    Attributes
    ----------
    before : dict of str to int
        Words, as far as a write can change them.
    left : tuple of str
        Registers that `put_back` could not restore.
    """

    def __init__(
        self, sensor: Adis16354, rows: Sequence[Register], before: Mapping[str, int] | None = None
    ) -> None:
        self._sensor = sensor
        self.rows = tuple(rows)
        self.before = (
            self._read() if before is None else {r.name: before[r.name] & r.write_mask for r in rows}
        )
        self.left: tuple[str, ...] = ()

    def put_back(self) -> None:
        """Restore every register that is not as it was noted; `left` names those that could not be.

        Raises
        ------
        KeyboardInterrupt
            The operator interrupted it; raised when it is done.
        """
        interrupted = False
        self.left = tuple(row.name for row in self.rows)
        for _ in range(_TRIES):
            try:
                self.left = tuple(row.name for row in self._restore())
                if not self.left:
                    break
            except KeyboardInterrupt:
                interrupted = True
            except AdisGonioError:
                continue
        if interrupted:
            raise KeyboardInterrupt

    def _restore(self) -> list[Register]:
        """One try; rows that still differ."""
        bus = self._sensor.bus
        bus.configure(NORMAL)  # keeps the limits of both modes
        now = self._read()
        for row in self.rows:
            if now[row.name] != self.before[row.name]:
                bus.exchange_array(write_frames(row, self.before[row.name]))
        now = self._read()
        left = [row for row in self.rows if now[row.name] != self.before[row.name]]
        self._sensor._follow()
        return left

    def _read(self) -> dict[str, int]:
        words = self._sensor.read_words(self.rows)
        return {row.name: word & row.write_mask for row, word in zip(self.rows, words, strict=True)}
