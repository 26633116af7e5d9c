"""A simulated part that only the operator's keys move, to practise mistakes: `sim:?hands=free`.

The part is on a simulated board (`adis_gonio.testing.open_board`), which runs in real time behind a serial
port like a real board. The session sees a sensor without a stage.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from adis_gonio.device.bus.opening import BusUrl

if TYPE_CHECKING:
    from adis_gonio.sim.testing.doubles import BoardStage

FREE_RATE_HZ = 100.0
"""Default sample rate in Hz.

The board runs in this process, so that a slow machine has to keep up with it.
"""


class Hands:
    """Moves the part of a simulated board; each move runs in its own thread while the session watches."""

    def __init__(self, stage: BoardStage) -> None:
        self._stage = stage
        self._busy = threading.Lock()

    def move(self, text: str) -> str:
        """Turn the part by an angle in degrees, given as text; return a line for the operator."""
        try:
            by_deg = float(text.replace("−", "-").removesuffix("°"))
        except ValueError:
            return f"'{text}' is no angle: give degrees, such as -30"
        if not abs(by_deg) <= 3600:
            return "turn by at most 3600° at a time"
        return self._start([by_deg])

    def bump(self) -> str:
        """Turn the part a little, forth and back, as by a bump; return a line for the operator."""
        return self._start([2.0, -2.0])

    def _start(self, turns_deg: list[float]) -> str:
        if not self._busy.acquire(blocking=False):
            return "the part is still turning"

        def turn() -> None:
            try:
                for by_deg in turns_deg:
                    self._stage.move_to(self._stage.angle_deg + by_deg)
            finally:
                self._busy.release()

        threading.Thread(target=turn, name="hands", daemon=True).start()
        return "turned" if len(turns_deg) == 1 else "bumped"


@contextmanager
def free_hands(url: str) -> Iterator[tuple[str, Hands | None]]:
    """Context with a simulated board if `url` has `hands=free`: the URL of its port, and the hands.

    The hands move the part on the board. Any other URL is yielded unchanged, with None instead of hands.

    Raises
    ------
    UsageError, CannotOpenError
        The board cannot be opened, see `adis_gonio.testing.open_board`.
    """
    parsed = BusUrl.parse(url)
    if parsed.scheme != "sim" or parsed.options.get("hands") != "free":
        yield url, None
        return
    from adis_gonio.sim.testing.doubles import open_board

    options = urlencode([pair for pair in parsed.options.items() if pair[0] != "hands"], safe=":=,;.")
    with open_board(f"sim:?{options}" if options else "sim:") as board:
        yield board.url, Hands(board.stage)
