"""A clumsy person before the screen: keys go in, and the remaining turn is read from its line of text."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import Iterator
from pathlib import Path

from adis_gonio.base.errors import BusError
from adis_gonio.bench.events import DwellProgress, Event, Finished
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.tui import screen_text
from adis_gonio.faces.tui.bench_screen import BenchApp, HelpDialog, LineDialog
from fakes.clumsy import Manner, Person
from fakes.clumsy_sessions import EventHand, Outcome, Task, by_events, lost, runner_of
from fakes.hand_part import HandPart

PATIENCE_S, SESSION_S = 60.0, 1200.0
KEYS = {
    "confirm": ["enter"], "repeat": ["r"], "retake": ["r"], "skip": ["s"], "undo": ["u"], "keep": ["k"],
    "reverse": ["v"], "accept": ["y"], "decline": ["n"], "pause": ["p"], "unpause": ["p"], "quit": ["q"],
    "nonsense": ["x", "7", "z"], "note": ["n"],
}  # fmt: skip
REMAINING = re.compile(r"turn ([+−]\d+\.\d)°")


class ScreenHand(EventHand):
    """Turns the part as `EventHand` does, and presses keys; runs in the session's thread."""

    app: BenchApp
    pilot: object
    loop: asyncio.AbstractEventLoop

    def _say(self, key: str) -> None:
        self._mark = len(self._bus.delivered)
        asyncio.run_coroutine_threadsafe(self._press(key), self.loop).result(PATIENCE_S)

    def _follow_arrow(self) -> None:
        asyncio.run_coroutine_threadsafe(self._look(), self.loop).result(PATIENCE_S)
        shown = REMAINING.search(screen_text.target(self.app.state))
        if shown is not None:
            more, tolerance = float(shown[1].replace("−", "-")), self.app.state.tolerance_deg or 0.0
            off = tolerance * self._wobble.uniform(-0.9, 0.9)
            self._bus.obey(f"turn {self._bus.part.angle_deg + more + off:.5f}")

    async def _look(self) -> None:
        """Wait until the screen shows what the session has told so far."""
        app = self.app
        while not app._events.empty() or (
            len(app.screen_stack) == 1 and app.state.question is not app._asked
        ):
            await asyncio.sleep(0.01)
        while isinstance(app.screen, HelpDialog):
            await self.pilot.press("escape")

    async def _press(self, key: str) -> None:
        await self._look()
        app, asked = self.app, self.app.state.question
        dialog = len(app.screen_stack) > 1
        await self.pilot.press(*KEYS[key])
        if key == "note" and isinstance(app.screen, LineDialog):
            await self.pilot.press(*"what", "enter")
        elif key == "quit" and not dialog:
            await self.pilot.press("y")
        elif key == "nonsense" and app.state.question is not asked:
            self._outcome.trouble.append("nonsense was taken for an answer")


class WatchedRunner:
    """A runner whose events the person sees after the screen has them."""

    def __init__(self, runner: SessionRunner, hand: ScreenHand, person: Person) -> None:
        self._runner, self._hand, self._person = runner, hand, person
        self.dwelling = False

    def __getattr__(self, name: str) -> object:
        return getattr(self._runner, name)

    def run(self) -> Iterator[Event]:
        for event in self._runner.run():
            yield event
            self.dwelling = isinstance(event, DwellProgress)
            self._hand.see(event)
            if self._person.exhausted:
                self._runner.stop()


def one_run(part: HandPart, person: Person, path: Path, chosen: object, outcome: Outcome) -> None:
    """Run a session on the screen until it ends, in a terminal of 80 columns."""
    with part.switch_on() as bus, Adis16354(bus) as sensor:
        runner = runner_of(sensor, path, chosen)
        hand = ScreenHand(person, runner, bus, outcome)
        watched = WatchedRunner(runner, hand, person)

        async def play() -> BenchApp:
            app = hand.app = BenchApp(watched, "adis-gonio calibrate --resume")
            hand.loop = asyncio.get_running_loop()
            started = threading.Event()
            app._worker = threading.Thread(
                target=lambda: (started.wait(PATIENCE_S), app._work()), daemon=True
            )
            async with app.run_test(size=(80, 24)) as pilot:
                hand.pilot = pilot
                started.set()
                await asyncio.to_thread(app._ended.wait, SESSION_S)
                app.tick()  # takes the last events
            return app

        app = asyncio.run(play())
        if app.crash is not None:
            raise app.crash
        finished = app.state.latest(Finished)
        if finished is not None:
            outcome.complete = finished.complete
        if app.error is not None:
            if isinstance(app.error, BusError) and watched.dwelling:
                outcome.trouble += lost(path, None, bus.delivered[hand._mark :])
            raise app.error


def by_screen(task: Task, folder: Path, manner: Manner | None = None) -> Outcome:
    """Let a person go through a session on the screen to its end."""
    return by_events(task, folder, manner, one_run)


__all__ = ["by_screen"]
