"""The noise of the part at rest, which a session measures first."""

from __future__ import annotations

from collections.abc import Generator

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError
from adis_gonio.bench.bench import SessionBench
from adis_gonio.bench.events import Event, Problem
from adis_gonio.bench.knowledge import Knowledge
from adis_gonio.bench.ledger import Ledger
from adis_gonio.bench.questions import Questions
from adis_gonio.record.watch import NoiseMeter


def measure_noise(
    bench: SessionBench, ledger: Ledger, knowledge: Knowledge, questions: Questions
) -> Generator[Event, None, list[float] | None]:
    """Measure until the part has lain still long enough.

    Returns
    -------
    list of float or None
        Standard deviation of a sample on each axis in mg, which the archive has; None where the operator
        stopped.

    Raises
    ------
    SessionError
        The part does not come to rest, and nobody is there to be told.
    """
    noise: Floats | None = None
    while noise is None and not questions.stopped:
        yield from questions.heed(None)
        noise = yield from _meter(bench, ledger, knowledge, questions)
    bench.close_stream()
    ledger.scanning(bench.scanning)
    if noise is None:
        return None
    measured = [float(value) for value in noise]
    bench.checkpoint()
    ledger.note("noise", measured)
    return measured


def _meter(
    bench: SessionBench, ledger: Ledger, knowledge: Knowledge, questions: Questions
) -> Generator[Event, None, Floats | None]:
    """The noise at rest; None where the operator stops or pauses, or has to be told what is wrong."""
    expected = bench.source.expected_noise_mg(bench.configuration)
    meter = NoiseMeter(bench.window, expected)
    deadline = bench.now_s + bench.settings.still_timeout_s + meter.least_samples * bench.period_s
    for block in bench.scans():
        noise = meter.feed(block.accel_mg)
        knowledge.see(block)
        yield knowledge.view.watching(
            "measuring", meter.mean_mg, meter.spread_mg, None, "the part to lie still"
        )
        if noise is not None or questions.interrupted:
            return noise
        if bench.now_s > deadline:
            message = (
                f"the sensor does not come to rest: a sample varies by {max(meter.spread_mg):.3g} mg,"
                f" its noise should be about {expected:.2g} mg; put it on a quiet support"
            )
            if questions.auto:
                raise SessionError(f"{message} and resume")
            yield ledger.problem(Problem("stillness", message, ledger.next_place or 0))
            return None
    return None


__all__ = ["measure_noise"]
