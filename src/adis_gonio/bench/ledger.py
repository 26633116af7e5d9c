"""What of a plan is done, skipped, faulty: the session's books, of which the archive holds every change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from adis_gonio.bench.events import Problem, Withdrawn
from adis_gonio.record.archive import Archive
from adis_gonio.record.plans import Plan


class Ledger:
    """Begins where the archive ends.

    Parameters
    ----------
    archive : Archive
    now : callable
        The sensor's time in s, of records.

    Attributes
    ----------
    plan : Plan
    recorded_s : float or None
        Length of what was recorded, where that is not what the settings say.
        As it was extended.
    done : dict
        Number of the attempt that counts, by place.
    skipped, faulty : set of int
        Places left out, and places whose dwell has a fault that nobody accepted.
    last_place : int or None
        That of the newest dwell.
    taken : int
        Dwells of this run.
    """

    def __init__(self, archive: Archive, now: Callable[[], float]) -> None:
        self.archive = archive
        self.header = archive.header()
        self.plan = archive.plan()
        self.recorded_s: float | None = None
        self.done = {attempt.place: attempt.number for attempt in archive.dwells()}
        self.skipped = archive.skipped()
        self.faulty = {attempt.place for attempt in archive.faulty()}
        self.last_place = self._newest()
        self.taken = 0
        self._scanning: dict[str, Any] = archive.last("scanning") or {}
        self._now = now

    def note(self, kind: str, value: Any) -> None:
        """Write a record, where there is something to write."""
        if value is not None:
            self.archive.add_record(kind, value, self._now())

    def problem(self, problem: Problem) -> Problem:
        """Write a problem down before it is told."""
        self.note("problem", problem.as_dict())
        return problem

    def scanning(self, now: dict[str, Any]) -> None:
        """Write down how scans are got, where that is new."""
        if now != self._scanning:
            self._scanning = now
            self.note("scanning", now)

    @property
    def open_places(self) -> list[int]:
        """Places that are neither done nor skipped, in order."""
        return [k for k in range(len(self.plan)) if k not in self.done and k not in self.skipped]

    @property
    def next_place(self) -> int | None:
        """The first of them."""
        return next(iter(self.open_places), None)

    def skip(self, place: int) -> None:
        """Leave a place out."""
        self.note("skipped", place)
        self.skipped.add(place)

    def count(self, place: int, number: int) -> None:
        """An attempt is the dwell of its place."""
        self.done[place] = number
        self.taken += 1
        self.skipped.discard(place)
        self.last_place = place

    def withdraw(self, place: int) -> Withdrawn:
        """Take a dwell out of the session: it stays in the archive, marked."""
        number = self.done.pop(place)
        self.note("withdrawn", number)
        self.faulty.discard(place)
        self.last_place = self._newest()
        return Withdrawn(place, self.plan.positions[place], number)

    def keep_faulty(self, places: list[int]) -> None:
        """Keep dwells with a fault in them as they are, and ask no more about them."""
        self.note("kept", [self.done[place] for place in places])
        self.faulty.difference_update(places)

    def extend(self, plan: Plan) -> None:
        """Go on with a longer plan."""
        self.note("plan", plan.as_dict())
        self.plan = plan

    def _newest(self) -> int | None:
        return max(self.done, key=self.done.__getitem__, default=None)


__all__ = ["Ledger"]
