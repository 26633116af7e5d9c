"""Every write is undone and verified, also after an error or an interruption."""

from __future__ import annotations

from adis_gonio.bringup.bench import Bench, writable
from adis_gonio.errors import AdisGonioError
from adis_gonio.sensor.frames import NORMAL, write_frames
from adis_gonio.sensor.registers import Register

_TRIES = 4
"""The operator's Ctrl-C or a bus that fails once must not keep a register from going back."""


class Undo:
    """Notes the writable registers; `put_back` restores what differs and reads it back."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self.rows = writable()
        self.before = self._read()
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
        bus = self._bench.bus
        bus.configure(NORMAL)  # keeps the limits of both modes
        now = self._read()
        for row in self.rows:
            if now[row.name] != self.before[row.name]:
                bus.exchange_array(write_frames(row, self.before[row.name]))
        now = self._read()
        left = [row for row in self.rows if now[row.name] != self.before[row.name]]
        self._bench.refresh()
        return left

    def _read(self) -> dict[str, int]:
        words = self._bench.sensor.read_words(self.rows)
        return {row.name: word & row.write_mask for row, word in zip(self.rows, words, strict=True)}
