"""A bench that is turned by hand: the simulated sensor without a stage that the program could move."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from adis_gonio.bench.events import Event, ExtensionOffered, GuardRaised, PositionAsked, Watching
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.bus import SpiBus, open_bus
from adis_gonio.device.sensor import Adis16354
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings

QUICK = Settings(dwell_s=0.5, settle_s=0.1)


class HandBus(SpiBus):
    """The simulated bus without what tells that it is simulated: no world, no stage, a clock of its own."""

    def __init__(self, url: str, *, starts_at_s: float = 0.0, virtual_time: bool = True) -> None:
        self.inner = open_bus(url)
        super().__init__(self.inner.timing)
        self.url = "real:1"
        self.virtual_time = virtual_time
        self.starts_at_s = starts_at_s

    def now_s(self) -> float:
        return self.inner.now_s() + self.starts_at_s

    def sleep_s(self, seconds: float) -> None:
        self.inner.sleep_s(seconds)

    def _exchange(self, frames):
        return self.inner.exchange_array(frames)

    def _configure(self, timing):
        return self.inner.configure(timing)

    def _close(self) -> None:
        self.inner.close()


class Hand:
    """An operator who turns the part, watches it come to rest and answers.

    Parameters
    ----------
    angle : callable
        From the question and how often this place was asked before: where the part is turned.
    answer : callable
        From a guard and how many there were before: the name of an answer.
    """

    def __init__(
        self,
        sensor: Adis16354,
        angle: Callable[[PositionAsked, int], float | None] = lambda event, times: event.position.angle_deg,
        answer: Callable[[GuardRaised, int], str] = lambda event, times: event.default,
    ) -> None:
        self.bus = sensor.bus
        self._angle, self._answer = angle, answer
        self._asked: dict[int, int] = {}
        self._waits = False
        self.guards: list[GuardRaised] = []

    @property
    def stage(self):
        """The stage of the world behind the bus, moved without the clock."""
        return self.bus.inner.world.stage

    def turn(self, angle_deg: float) -> None:
        """Begin to turn; the part is on its way while the sensor is watched."""
        self.stage.move_to(max(self.bus.now_s(), self.stage.still_at_s), angle_deg)

    def see(self, runner: SessionRunner, event: Event) -> None:
        """Do what an event asks for."""
        if isinstance(event, PositionAsked):
            times = self._asked.get(event.place, 0)
            self._asked[event.place] = times + 1
            target = self._angle(event, times)
            if target is not None and target != self.stage.angle_deg:
                self.turn(target)
            self._waits = True
        elif isinstance(event, Watching) and event.state == "idle" and self._waits:
            if self.bus.now_s() > self.stage.still_at_s + 0.3:
                self._waits = False
                runner.answer("confirm")
        elif isinstance(event, GuardRaised):
            self._waits = False
            runner.answer(self._answer(event, len(self.guards)))
            self.guards.append(event)
        elif isinstance(event, ExtensionOffered):
            runner.answer("decline")


@contextmanager
def hand_sensor(url: str = "sim:?seed=3") -> Iterator[Adis16354]:
    """Sensor on a bench that is turned by hand."""
    with Adis16354(HandBus(url)) as sensor:
        yield sensor


def by_hand(
    sensor: Adis16354,
    path: Path,
    plan_name: str = "four-position",
    positions: int | None = None,
    settings: Settings = QUICK,
    so_far: bool = False,
    **hand: object,
) -> tuple[list[Event], Hand]:
    """Run a session by hand to its end; with `so_far` its dwells are fitted after each."""
    runner = SessionRunner.begin(sensor, path, plan(plan_name, positions), settings, fixture_sigma_deg=0.02)
    operator = Hand(sensor, **hand)
    events = []
    for event in runner.run(so_far=so_far):
        events.append(event)
        operator.see(runner, event)
    return events, operator


__all__ = ["QUICK", "Hand", "HandBus", "by_hand", "hand_sensor"]
