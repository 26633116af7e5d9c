"""Bring-up steps on the sample updates: their rate, the edges of data-ready, the values of SMPL_PRD."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import BusTimeoutError, UsageError
from adis_gonio.base.numbers import signed
from adis_gonio.bench.bringup.bringup_step import (
    BOARD_CLOCK_U,
    HOST_CLOCK_U,
    PART_CLOCK,
    BringupBench,
    Ending,
    NotMeasuredError,
    StepResult,
    Verdict,
    Z,
)
from adis_gonio.device.bus import Capability, Words
from adis_gonio.device.sensor.registers import BY_NAME, ND, read_frames, timing_for, write_frames
from adis_gonio.device.sensor.scanning import MASK, enabling_bits
from adis_gonio.device.sensor.settings import sample_period_s

_MISC = BY_NAME["MSC_CTRL"]
_READ = "XACCL_OUT"
_NO_EDGE = "no edge arrives: wire DIO1 to the bridge's data-ready input if it is to stream"
_READS = 8
"""Number of reads in a scan, which every bridge with streams can do."""
_BENT = 0.02
"""Largest relative error of a bridge's times while the rate of its clock is being estimated."""


_STEADY = 0.004
"""Largest relative error of the ratio of two periods (the clocks of part and host change)."""


def measure_period(bench: BringupBench, expected_s: float, updates: int) -> tuple[float, float]:
    """Measure the period of the sample updates in s by the new-data flags (ND) of one register.

    Returns the period and its standard uncertainty in s. `expected_s` is the nominal period, `updates` the
    number of periods to measure.

    Only the first read after an update has ND set. The time between two such reads is therefore a whole
    number of periods, with a uniform error of one read at either end: u = frame sqrt(1/6) / number of
    periods, with the time of a frame.

    Raises
    ------
    NotMeasuredError
        The bridge is too slow, or no update was seen.
    """
    _, frame_s = bench.repeated(_READ, 4)
    if frame_s > expected_s / 2.5:
        raise NotMeasuredError(
            f"this bridge reads a word in {1e3 * frame_s:.2g} ms, an update takes {1e3 * expected_s:.2g} ms"
        )
    unbroken = bench.bus.unbroken_frames
    if unbroken is not None and unbroken * frame_s < 3 * expected_s:
        raise NotMeasuredError(
            f"this bridge runs {unbroken} frames without a pause, too few for updates every"
            f" {1e3 * expected_s:.2g} ms"
        )
    spans, looked_s, periods, ends = 0.0, 0.0, 0, 0
    batch = math.ceil(min(updates, 256) * expected_s / frame_s)
    for _ in range(64 + 2 * updates):
        words, frame_s = bench.repeated(_READ, batch)
        at = np.flatnonzero(words & ND)
        at = at[at > 0]  # the update that the first word shows may have come long before the batch
        if len(at) > 1:
            spans += float(at[-1] - at[0]) * frame_s
            periods += len(at) - 1
            ends += 1
        looked_s += len(words) * frame_s
        if periods >= updates or (not periods and looked_s > 256 * expected_s):
            break
    if not periods:
        raise NotMeasuredError("no update was seen: bit ND never came")
    value = spans / periods
    clock_u = BOARD_CLOCK_U if bench.bus.unbroken_frames is not None else HOST_CLOCK_U
    return value, math.hypot(frame_s * math.sqrt(ends / 6) / periods, clock_u * value)


def nearest_code(period_s: float) -> int:
    """Return the value of SMPL_PRD with the nominal period nearest to `period_s` on a logarithmic scale."""
    return min(range(1, 256), key=lambda n: abs(math.log(period_s / sample_period_s(n))))


def measure_rate(bench: BringupBench, found: StepResult) -> Ending:
    """Count new-data flags (ND) of one register that is read without a pause.

    The period of the updates is compared with the nominal period of SMPL_PRD.
    """
    expected = bench.sensor.configuration().sample_period_s
    period, u = measure_period(bench, expected, max(8, min(512, round(2.0 / expected))))
    rate = 1 / period
    found.measure("sample rate", rate, "Hz", rate * u / period, 1 / expected)
    found.measure("period", 1e6 * period, "us", 1e6 * u, 1e6 * expected)
    bench.clock, bench.clock_error = period / expected, 0.0
    if abs(period - expected) <= Z * u:
        return Verdict.OK, f"{rate:.2f} updates a second, as SMPL_PRD says"
    code = nearest_code(period)
    if sample_period_s(code) != expected:
        return Verdict.FAULT, (
            f"{rate:.2f} updates a second, SMPL_PRD says {1 / expected:.2f}; that would be"
            f" SMPL_PRD = 0x{code:02X}"
        )
    return Verdict.DIFFERS, (
        f"{rate:.2f} updates a second, {signed(100 * (rate * expected - 1), 2)} % from the nominal rate"
    )


@dataclass(frozen=True)
class _Edges:
    """Scans of one register, each started by the bridge at an edge of data-ready.

    Attributes
    ----------
    position : (n,) int
        Number of the read with the new-data flag (ND) in each scan; −1 if there is none, −2 if there are
        several.
    lost : int
        Number of edges without a scan, as the bridge reports it.
    jitter_us, rate_hz : float
        Rms deviation of the scans' times from even steps, and their rate.
    expected : float
        Number of sample updates in the time of the scans.
    slack : float
        Largest difference between the numbers of edges and of updates that is not a fault.
    """

    position: NDArray[np.int64]
    lost: int
    jitter_us: float
    rate_hz: float
    expected: float
    slack: float

    @property
    def surplus(self) -> float:
        """Number of data-ready edges minus number of sample updates."""
        return len(self.position) + self.lost - self.expected

    @property
    def missed(self) -> int:
        """Number of edges without a scan, reported by the bridge or seen as gaps in the times of scans."""
        gaps = self.expected - len(self.position)
        return max(self.lost, round(gaps) if gaps > self.slack else 0)

    @property
    def usual(self) -> int:
        """Place within a scan, counted in reads, at which the flag ND (new data) is found most often."""
        values, counts = np.unique(self.position, return_counts=True)
        return int(values[np.argmax(counts)])

    @property
    def locked(self) -> float:
        """Share of scans in which the flag ND is found at the usual place, or one read before or after it.

        It is near 1 if the edges follow the updates.
        """
        near = np.abs(self.position - self.usual) <= 1
        return float(np.mean(near & (self.position >= 0)))


_EDGE_SCANS = 256


def check_data_ready(bench: BringupBench, found: StepResult) -> Ending:
    """Enable data-ready, count edges, start scans at both edges of the pulse and find the ND.

    A bridge that cannot start scans at edges only counts them.
    """
    capabilities = bench.bus.capabilities
    streams, counts = (one in capabilities for one in (Capability.STREAM, Capability.EVENT_COUNTER))
    if not (streams or counts):
        raise NotMeasuredError("this bridge has no data-ready input (neither streams nor an event counter)")
    period = bench.sensor.configuration().sample_period_s * bench.clock
    before = bench.sensor.read(_MISC)
    try:
        if counts:
            _enable_data_ready(bench, before, first=True)
            edges, expected, late = _count_edges(bench, period)
            found.measure("edges counted", edges, expected=expected)
            if edges == 0:
                raise NotMeasuredError(_NO_EDGE)
            if abs(edges - expected) > _slack(bench, expected, Z * BOARD_CLOCK_U) + late:
                return Verdict.FAULT, _describe_rate(edges, expected, period)
        if not streams:
            bench.data_ready = True
            return Verdict.OK, (
                f"{edges} edges where {expected:.0f} updates were expected; which edge leads: not"
                " measured, this bridge starts no scans at the edge"
            )
        _enable_data_ready(bench, before, first=True)
        first = _scan_at_edges(bench, period)
        _enable_data_ready(bench, before, first=False)
        second = _scan_at_edges(bench, period)
    except UsageError as error:
        why = f"this bridge takes no list of {_READS} reads at an edge ({error})"
        raise NotMeasuredError(why) from error
    finally:
        _write_misc(bench, before)
        bench.refresh()
    return _judge_edges(bench, period, first, second, found)


def _enable_data_ready(bench: BringupBench, before: int, *, first: bool) -> None:
    """Enable data-ready on DIO1 so that the bridge uses the first or the second edge of the pulse.

    `before` is the word of MSC_CTRL to change.
    """
    _write_misc(bench, before & ~MASK | enabling_bits(bench.bus, first=first))


def _write_misc(bench: BringupBench, word: int) -> None:
    bench.bus.exchange_array(write_frames(_MISC, word & _MISC.write_mask, byte_mask=0x00FF))


def _count_edges(bench: BringupBench, period_s: float) -> tuple[int, float, float]:
    """Count data-ready edges for some time.

    Returns the edges, the expected number of updates, and the largest error of that number, because a busy
    host may read the counter late. `period_s` is the period of the updates.
    """
    bus, wait_s = bench.bus, max(0.5, 20 * period_s)
    asked_s = bus.now_s()
    bus.read_event_counter()
    bus.sleep_s(wait_s)
    edges = bus.read_event_counter()
    least, most = wait_s / period_s, (bus.now_s() - asked_s) / period_s
    return edges, (most + least) / 2, (most - least) / 2


def _slack(bench: BringupBench, expected: float, clock: float) -> float:
    """Return the largest difference between numbers of edges and of updates that is not a fault.

    One edge may lie at each end of the span. `expected` is the number of updates in it, and `clock` the
    largest relative error of the bridge's times; the error of the part's clock is added.
    """
    return 2 + (clock + bench.clock_error) * expected


def _describe_rate(edges: int, expected: float, period_s: float) -> str:
    rate = edges / expected / period_s
    rest = (
        "edges are missed: the line is weak, or the bridge is busy"
        if edges < expected
        else "other edges arrive too: the input is open or picks up noise"
    )
    return f"{rate:.0f} edges a second where {1 / period_s:.1f} updates are configured: {rest}"


def _scan_at_edges(bench: BringupBench, period_s: float) -> _Edges:
    """Record scans of one register, started at data-ready edges, each nearly as long as `period_s`.

    Raises
    ------
    NotMeasuredError
        No edge starts a scan.
    UsageError
        The list of reads is too long for the bridge or for the period.
    """
    timing = timing_for(bench.sensor.read("SMPL_PRD"))
    # One more frame fetches the last reply; 5 % of the period is reserved for the bridge.
    frames = _READS + 1
    fill_us = math.floor(0.95e6 * period_s / frames)
    # 20 ms between two frames: the timers of the bridges reach about 50 ms.
    fitting = min(max(timing.period_us, fill_us), 20_000.0)
    if frames * fitting > 0.97e6 * period_s:
        raise UsageError("the period is too short for a list of reads")
    bench.bus.configure(replace(timing, period_us=fitting))
    frame = int(read_frames([BY_NAME[_READ]])[0])
    with bench.bus.stream([frame] * _READS, block_scans=_EDGE_SCANS // 4) as stream:
        try:
            blocks = [next(stream) for _ in range(4)]
        except BusTimeoutError:
            if Capability.EVENT_COUNTER in bench.bus.capabilities:  # the counter has seen edges
                raise
            raise NotMeasuredError(_NO_EDGE) from None
    words = np.concatenate([block.words for block in blocks])
    times = np.concatenate([block.time_s for block in blocks])
    lost = sum(block.lost for block in blocks[1:])  # edges before the first block do not count
    expected = float(times[-1] - times[0]) / period_s
    slack = _slack(bench, expected, _BENT)
    return _Edges(_positions(words), lost, *_jitter(times, period_s), expected, slack)


def _judge_edges(
    bench: BringupBench, period_s: float, first: _Edges, second: _Edges, found: StepResult
) -> Ending:
    """Judge data-ready by scans that start at the `first` and at the `second` edge of its pulse.

    `period_s` is the expected period of the updates. The figures are added to `found`.
    """
    for name, edges in (("first", first), ("second", second)):
        found.measure(f"{name} edge: rate of scans", edges.rate_hz, "Hz", expected=1 / period_s)
        found.measure(f"{name} edge: scans that follow an update", edges.locked, expected=1.0)
        found.measure(f"{name} edge: read that carries ND", edges.usual, expected=0)
        found.measure(f"{name} edge: jitter (rms, as the bridge stamps it)", edges.jitter_us, "us")
        found.measure(f"{name} edge: missed", edges.missed, expected=0)
    surplus = max(first.surplus - first.slack, second.surplus - second.slack)
    if surplus > 0:
        return Verdict.FAULT, "more edges come than updates: the input picks up noise too"
    if first.locked < 1:
        return Verdict.FAULT, (
            f"{100 * (1 - first.locked):.0f} % of the scans do not follow an update: the input picks up"
            " noise"
        )
    if missed := first.missed + second.missed:
        return Verdict.FAULT, f"{missed} of {2 * _EDGE_SCANS + missed} edges were missed"
    bench.data_ready = True
    if first.usual > 0:
        found.check("data_ready_edge", False, "the update comes after the pulse's first edge")
        return Verdict.DIFFERS, (
            "the wrong edge leads: the update comes after the pulse's first edge, so that words of a"
            " scan that starts there mix two updates"
            + ("; at its second edge they do not" if second.usual == 0 else "")
        )
    found.check("data_ready_edge", True, "a scan that starts at the pulse's first edge sees the update")
    return Verdict.OK, (
        f"every edge follows an update, none is missed; the first edge of the pulse leads; jitter"
        f" {first.jitter_us:.1f} µs rms"
    )


def _positions(words: Words) -> NDArray[np.int64]:
    # One flag in a scan gives its position, several give -2, none gives -1.
    new = (words & ND).astype(bool)
    new[0] = False  # ND of the first scan may come from an earlier update
    count = new.sum(axis=1)
    place = np.where(count == 1, np.argmax(new, axis=1), np.where(count, -2, -1))
    return np.asarray(place[1:], np.int64)


def _jitter(time_s: Floats, period_s: float) -> tuple[float, float]:
    """Return the rms deviation in µs of the times `time_s` (n,) from even steps, and their rate in Hz.

    `period_s` is the expected step.
    """
    # Number the edges by rounded periods, then subtract the straight line of even steps.
    steps = np.diff(time_s)
    number = np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / period_s), 1))])
    rest = time_s - time_s[0] - np.polyval(np.polyfit(number, time_s - time_s[0], 1), number)
    return 1e6 * float(np.std(rest)), (len(time_s) - 1) / float(time_s[-1] - time_s[0])


_CODES = (0x01, 0x04, 0x09, 0x0A, 0x1F, 0x7F, 0x80, 0x83)


def measure_periods(bench: BringupBench, found: StepResult) -> Ending:
    """Write eight values of SMPL_PRD in both time bases and measure the period of each.

    The nominal period is the time base (bit 7 of the value) times (N + 1), with N in bits 0 to 6.
    """
    why, ratios = NotMeasuredError(), []
    for code in _CODES:
        bench.sensor.write("SMPL_PRD", code)
        expected = sample_period_s(code) * bench.clock
        bench.bus.sleep_s(2 * expected)
        try:
            period, u = measure_period(bench, expected, max(12, min(256, round(0.5 / expected))))
        except NotMeasuredError as error:
            why = error
            continue
        found.measure(f"period at 0x{code:02X}", 1e3 * period, "ms", 1e3 * u, 1e3 * expected)
        ratios.append((period / expected, u / expected))
    if not ratios:
        raise why
    # All periods come from one clock, whose error the most precise ratio shows.
    clock, clock_u = min(ratios, key=lambda one: one[1])
    off = clock - 1
    wrong = [f"the periods are {100 * off:.2g} % off"] if abs(off) > PART_CLOCK + Z * clock_u else []
    wrong += [
        f"{figure.name} is {figure.value:.4g} ms instead of {figure.expected:.4g} ms"
        for figure, (ratio, u) in zip(found.figures, ratios, strict=True)
        if abs(ratio / clock - 1) > _STEADY + Z * math.hypot(u, clock_u)
    ]
    text = "; ".join(wrong) or "every period is the time base times (N + 1)"
    found.check("sample_period", not wrong, text, *found.figures)
    return found.by_answers()
