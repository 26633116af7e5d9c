"""What the guards stop at in a dwell: put to the operator, or told where nobody is there to ask."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator, Iterator

from adis_gonio.base.arrays import Floats
from adis_gonio.bench.answers import Reply
from adis_gonio.bench.events import Event, GuardRaised, Problem
from adis_gonio.bench.guards import Guard, insistent, judge_dwell, judge_shift
from adis_gonio.bench.knowledge import Knowledge
from adis_gonio.bench.ledger import Ledger
from adis_gonio.bench.questions import Questions
from adis_gonio.bench.recording import Recording
from adis_gonio.record.blocks import Block


class Guarding:
    """Remembers of each dwell what was asked about it and kept."""

    def __init__(self, ledger: Ledger, knowledge: Knowledge, questions: Questions) -> None:
        self._ledger = ledger
        self._knowledge = knowledge
        self._questions = questions
        self._kept_kinds: set[str] = set()
        self._doubts: list[Guard] = []
        self._stops: Counter[int] = Counter()

    def begin(self) -> None:
        """Forget the dwell before."""
        self._kept_kinds, self._doubts = set(), []

    def kept(self, kind: str) -> bool:
        """True where what a guard of this kind stops at has been kept in this dwell."""
        return kind in self._kept_kinds

    def complete(self, number: int) -> bool:
        """The dwell is complete: write down what was doubted of it; True where there was something."""
        for guard in self._doubts:
            self._ledger.note("doubt", {"attempt": number, "kind": guard.kind, "message": guard.message})
        self._stops.clear()
        return bool(self._doubts)

    def ask(self, guard: Guard, place: int) -> Generator[Event, None, bool]:
        """Put what a guard stopped at to the operator; True where the dwell is to go on or to stay."""
        ledger = self._ledger
        self._stops[place] += 1
        shown = insistent(guard, self._stops[place] if ledger.done else 1)
        raised = GuardRaised(
            guard.kind,
            shown.message,
            place,
            ledger.plan.positions[place],
            shown.values,
            guard.answers,
            guard.default,
        )
        allowed = {Reply(name) for name in guard.answers}
        answer = yield from self._questions.ask(raised, allowed, Reply(guard.default), place)
        ledger.note(
            "guard", {"place": place, "kind": guard.kind, "message": guard.message, "answer": answer}
        )
        if answer is Reply.KEEP:
            self._keep(guard)
        elif answer is Reply.REVERSE:
            self._knowledge.reverse()
        elif answer is Reply.SKIP:
            ledger.skip(place)
            if guard.contradicts and ledger.done:
                taken = sorted(ledger.done.values())
                doubt = {"place": place, "dwells": taken, "kind": guard.kind, "message": guard.message}
                ledger.note("contradiction", doubt)
        return answer in (Reply.KEEP, Reply.REVERSE)

    def settled(
        self, recording: Recording, mean_mg: Floats, rested_mg: Floats | None
    ) -> Generator[Event, None, Guard | None]:
        """What cannot be right where the part has come to rest; with nobody to ask it is told."""
        judge, limits, place = self._knowledge.judge, self._knowledge.limits, recording.place
        recording.rested_mg = mean_mg
        if judge is None or limits is None:
            return None
        turned = judge.turned(place, recording.position, mean_mg)
        if turned is not None:
            yield turned
        guard = judge.settled(recording.position, mean_mg)
        if guard is None and rested_mg is not None and not self._questions.auto:
            guard = judge_shift(mean_mg, rested_mg, limits.upper)
        if guard is None or self.kept(guard.kind):
            return None
        if not self._questions.auto:
            return guard
        self._keep(guard)
        yield self._told(guard, recording)
        return None

    def within(self, recording: Recording, scans: Block, found: list[Problem]) -> Iterator[Event]:
        """Ask about what happened within a dwell; with nobody to ask a problem is told."""
        ledger, place = self._ledger, recording.place
        told = {problem.kind for problem in found}
        for guard in judge_dwell(scans, found):
            if self._questions.auto:
                if guard.kind not in told and not (guard.kind == "over_range" and "alarm" in told):
                    yield self._told(guard, recording)
                continue
            stays = yield from self.ask(guard, place)
            if self._questions.stopped:
                return
            if not stays:
                skipped = place in ledger.skipped
                yield self._knowledge.withdraw(place)
                if skipped:
                    ledger.skipped.add(place)
                return
            if place in ledger.faulty:
                ledger.keep_faulty([place])

    def _keep(self, guard: Guard) -> None:
        self._kept_kinds.add(guard.kind)
        if guard.spoils:
            self._doubts.append(guard)

    def _told(self, guard: Guard, recording: Recording) -> Problem:
        problem = Problem(guard.kind, f"{recording.position}: {guard.message}", recording.place)
        return self._ledger.problem(problem)


__all__ = ["Guarding"]
