"""Which place comes next, and what is offered when none is left: repetition, extension, advice."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import replace

from adis_gonio.bench.closing import Advisor
from adis_gonio.bench.dialogue import Questions, Reply
from adis_gonio.bench.events import (
    Advised,
    Advising,
    Event,
    ExtensionOffered,
    PositionAsked,
    RepetitionOffered,
)
from adis_gonio.bench.recorder import Recorder
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.archive import read_session
from adis_gonio.record.plans import Position, blindness, extended, extension
from adis_gonio.record.settings import expected_each_s


class Visiting:
    """Visits the places of a plan.

    Parameters
    ----------
    recorder : Recorder
        Records each place.
    extend : bool
        The extension of a two-position session is wanted.
    advisor : Advisor or None
        Asked for further positions when the plan is done, until it has none.
    """

    def __init__(
        self, questions: Questions, recorder: Recorder, *, extend: bool, advisor: Advisor | None
    ) -> None:
        self._questions, self._recorder = questions, recorder
        self._bench, self._ledger, self._knowledge = questions.bench, questions.ledger, questions.knowledge
        self._extend = extend
        self._advisor = advisor
        self._first_asked_s: float | None = None

    def run(self) -> Iterator[Event]:
        """Visit until nothing is left to do, or the operator stops."""
        while not self._questions.stopped:
            place = self._ledger.next_place
            yield from self._questions.heed(place)
            if place is None and self._ledger.faulty:
                answer = yield from self._offer_repetition()
            elif place is None:
                answer = yield from self._offer_extension()
            else:
                answer = yield from self._ask_position(place)
            if not (yield from self._carry_out(answer, place)):
                return

    def _carry_out(self, answer: Reply, place: int | None) -> Generator[Event, None, bool]:
        """Do what was answered; False where that ends the session."""
        last = self._ledger.last_place
        if answer is Reply.REPEAT and last is not None:
            yield from self._recorder.take(last)
        elif answer is Reply.UNDO and last is not None:
            yield self._knowledge.withdraw(last)
        elif answer is Reply.CONFIRM and place is not None:
            yield from self._recorder.take(place)
        elif answer is Reply.SKIP and place is not None:
            self._ledger.skip(place)
        else:
            return answer is Reply.ACCEPT
        return True

    def _ask_position(self, place: int) -> Generator[Event, None, Reply]:
        ledger = self._ledger
        position = ledger.plan.positions[place]
        asked = PositionAsked(
            place,
            position,
            min(len(ledger.done) + len(ledger.skipped) + 1, len(ledger.plan)),
            len(ledger.plan),
            ledger.last_place is not None,
            self._time_left_s(),
            ledger.last_place is not None,
        )
        self._knowledge.view.target = position
        return (yield from self._questions.ask(asked, {Reply.CONFIRM, Reply.SKIP}, Reply.CONFIRM, place))

    def _time_left_s(self) -> float:
        """How long the positions that are left take, by how long those of this run took."""
        bench, ledger = self._bench, self._ledger
        left = len(ledger.plan) - len(ledger.done) - len(ledger.skipped)
        if self._first_asked_s is None:
            self._first_asked_s = bench.now_s
        each = expected_each_s(bench.settle_s, bench.settings.dwell_s)
        if ledger.taken:
            each = (bench.now_s - self._first_asked_s) / ledger.taken
        return left * each + sum(ledger.plan.positions[k].wait_s for k in ledger.open_places)

    def _offer_repetition(self) -> Generator[Event, None, Reply]:
        """Ask about dwells with a fault: repeat them, or keep them as they are, which is recorded."""
        places = sorted(self._ledger.faulty)
        where = tuple(self._ledger.plan.positions[place] for place in places)
        offer = RepetitionOffered(tuple(places), where)
        answer = yield from self._questions.ask(offer, {Reply.ACCEPT, Reply.DECLINE}, Reply.DECLINE)
        if answer is Reply.DECLINE:
            self._ledger.keep_faulty(places)
            return Reply.ACCEPT
        if answer is Reply.ACCEPT:
            for place in places:
                other = yield from self._take_again(place)
                if other is not None:
                    return other
        return answer

    def _take_again(self, place: int) -> Generator[Event, None, Reply | None]:
        """Ask for a position that has a dwell until there is a new one; what else was answered, if so.

        Skipped, the dwell that it has is kept as it is.
        """
        done, skipped = self._ledger.done, self._ledger.skipped
        before = done.get(place)
        while done.get(place) == before and not self._questions.stopped:
            answer = yield from self._ask_position(place)
            if answer is Reply.CONFIRM:
                yield from self._recorder.take(place)
            if answer is Reply.SKIP or (place in skipped and done.get(place) == before):
                skipped.discard(place)
                self._ledger.keep_faulty([place])
                return None
            if answer not in (Reply.CONFIRM, Reply.SKIP):
                return answer
        return None

    def _offer_extension(self) -> Generator[Event, None, Reply]:
        ledger = self._ledger
        longer = extension(ledger.plan, len(ledger.done))
        typical_mg = self._bench.source.part.initial_bias_mg
        gravity_mg = 1000.0 * ledger.header.gravity_mps2 / STANDARD_GRAVITY_MPS2
        blind = blindness(ledger.plan, typical_mg, gravity_mg)
        if longer is None or blind is None:
            return (yield from self._ask_advisor())
        wanted = self._extend or self._advisor is not None
        return (yield from self._offer(ExtensionOffered(longer, blind), wanted))

    def _offer(self, offer: ExtensionOffered, wanted: bool) -> Generator[Event, None, Reply]:
        """Offer a longer plan; it is in the archive before its first position is asked for."""
        default = Reply.ACCEPT if wanted else Reply.DECLINE
        answer = yield from self._questions.ask(offer, {Reply.ACCEPT, Reply.DECLINE}, default)
        if answer is Reply.ACCEPT:
            self._ledger.extend(offer.plan)
        return answer

    def _ask_advisor(self) -> Generator[Event, None, Reply]:
        """Let the advisor see the archive, and offer what it asks for."""
        ledger = self._ledger
        if self._advisor is None or not ledger.done:
            return Reply.STOP
        yield Advising(len(ledger.done))
        rounds = [record.value for record in ledger.archive.records("advised")]
        visited = len(ledger.plan) - rounds[0]["planned"] if rounds else 0
        advice = self._advisor.advise(read_session(ledger.archive.path), visited, self._reachable)
        count, number = len(advice.positions), len(rounds) + 1
        ledger.note(
            "advised",
            {
                "round": number,
                "planned": len(ledger.plan),
                "positions": count,
                "reasons": list(advice.reasons),
                "ended": advice.ended,
                "summary": advice.summary,
            },
        )
        yield Advised(number, count, advice.ended, advice.summary)
        if not advice.positions:
            return Reply.STOP
        longer = extended(ledger.plan, advice.positions)
        return (yield from self._offer(ExtensionOffered(longer, None, advice.reasons), True))

    def _reachable(self, position: Position) -> bool:
        """True where somebody, or the program alone with `auto`, can and will bring the part there."""
        ledger = self._ledger
        refused = {replace(ledger.plan.positions[place], wait_s=0.0) for place in ledger.skipped}
        if replace(position, wait_s=0.0) in refused:
            return False
        return not self._questions.auto or self._bench.can_reach(position)


__all__ = ["Visiting"]
