"""A screen without a terminal: a runner that plays events, keys, and the screen as lines of text."""

from __future__ import annotations

import asyncio
import io
import math
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console

from adis_gonio.base.errors import UsageError
from adis_gonio.bench import events
from adis_gonio.faces.free_hands import Hands
from adis_gonio.faces.tui.bench_screen import BenchApp

RESUME = "adis-gonio calibrate 'serial:' --resume -o today.session"


class PlayedRunner:
    """Tells events, then waits to be stopped; keeps what it was told.

    Parameters
    ----------
    script : sequence of Event, or of Event and exception
        An exception is raised where it stands.
    ends : bool
        True where the run ends with the script.
    """

    reversed = False

    def __init__(self, script: Sequence[events.Event | BaseException], *, ends: bool = False) -> None:
        self._script = script
        self._ends = ends
        self.told: list[str] = []
        self.played = threading.Event()
        self._stopped = threading.Event()
        self.deaf = False
        self.heeds_stop = True

    def run(self) -> Iterator[events.Event]:
        for step in self._script:
            if isinstance(step, BaseException):
                self.played.set()
                raise step
            yield step
        self.played.set()
        if not self._ends:
            self._stopped.wait(600)

    def answer(self, answer: str) -> None:
        if self.deaf:
            raise UsageError(f"'{answer}' answers no question that stands")
        self.told.append(answer)

    def stop(self) -> None:
        self.told.append("stop")
        if self.heeds_stop:
            self.release()

    def release(self) -> None:
        """Let the run end."""
        self._stopped.set()

    def pause(self) -> None:
        self.told.append("pause")

    def unpause(self) -> None:
        self.told.append("unpause")

    def note(self, text: str) -> None:
        self.told.append(f"note {text}")


def text_of(app: BenchApp) -> str:
    """The screen as text, dialogs included."""
    width, height = app.size
    console = Console(
        width=width,
        height=height,
        file=io.StringIO(),
        force_terminal=True,
        record=True,
        legacy_windows=False,
    )
    console.print(app.screen._compositor.render_update(full=True, screen_stack=app._background_screens))
    return "".join(f"{line.rstrip()}\n" for line in console.export_text().splitlines())


def shown(
    script: Sequence[events.Event | BaseException],
    *,
    size: tuple[int, int] = (80, 24),
    keys: Sequence[str] = (),
    runner: PlayedRunner | None = None,
    picture: Path | None = None,
    before: object = None,
    hands: Hands | None = None,
) -> tuple[str, BenchApp, PlayedRunner]:
    """Play a script, press keys, and return the screen, its app and what the runner was told."""
    played = runner or PlayedRunner(script)
    played.heeds_stop = False  # the screen stays to be looked at

    async def play() -> tuple[str, BenchApp]:
        app = BenchApp(played, RESUME, hands=hands)
        # Only the ticks below: on a slow machine a tick in the middle of the script opens its dialogs.
        app.set_interval = lambda *_, **__: None
        async with app.run_test(size=size) as pilot:
            await asyncio.to_thread(played.played.wait)
            app.tick()
            await pilot.pause()
            for key in keys:
                await pilot.press(key)
                await pilot.pause()
            app._news_s = math.inf  # however slow the machine is, nothing is told to be late
            if callable(before):
                before(app)
            app.show()
            await pilot.pause()
            if picture is not None:
                picture.write_text(app.export_screenshot(), "utf-8")
            text = text_of(app)
            played.release()
        return text, app

    text, app = asyncio.run(play())
    return text, app, played
