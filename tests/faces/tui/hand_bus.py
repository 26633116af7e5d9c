"""A bus `hand:` whose stage a person turns: the simulated chip, moved by what is written into a file.

To the program it is a sensor like any other, without a stage of its own and without a truth. The option
`control` names the file; each new line in it is an angle in degrees to turn the part to, or `unplug`.
"""

from __future__ import annotations

import threading
import time
from pathlib import Path

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.sim import SimBus, World
from adis_gonio.sim.settings import WorldSettings


class HandBus(SimBus):
    """Follows the wall clock and the control file."""

    def __init__(self, url: BusUrl, control: Path, seed: int, settings: WorldSettings) -> None:
        world = World(settings, part="adis16354", seed=seed)
        super().__init__(world=world, realtime=True, url=url.text)
        self._hands = world.stage
        self._control = control
        self._read = 0
        self.stage = self.world = None
        threading.Thread(target=self._follow, daemon=True).start()

    def _follow(self) -> None:
        while not self.closed:
            lines = self._control.read_text().splitlines() if self._control.exists() else []
            for line in lines[self._read :]:
                self._obey(line.strip())
            self._read = len(lines)
            time.sleep(0.02)

    def _obey(self, line: str) -> None:
        if line == "unplug":
            self.chip.frames_at = self._gone
            return
        with self._lock:
            now_s = max(self.now_s(), self.chip.time_s, self._hands.still_at_s)
            self._hands.move_to(now_s, float(line))

    def _gone(self, *args: object, **options: object) -> None:
        raise BusTimeoutError(f"{self.url}: no answer; the cable?")


def open_from_url(url: BusUrl) -> HandBus:
    """Open `hand:?seed=1&control=FILE`, with the names of `WorldSettings`."""
    options = url.options
    settings = WorldSettings.from_options(options, others=("seed", "control"))
    return HandBus(url, Path(options["control"]), int(options.get("seed", "0")), settings)
