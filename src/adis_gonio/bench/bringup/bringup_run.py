"""The run of a bring-up: its steps in order, harmless steps first; every write is undone in any case.

`build_page` makes the HTML page of the results, answers about the register table, and figures.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.numbers import format_fixed, format_number, with_unit
from adis_gonio.base.uncertainty import Value
from adis_gonio.bench.bringup import link_steps, part_steps, update_steps
from adis_gonio.bench.bringup.bringup_step import (
    QUESTIONS,
    Answer,
    Bringup,
    BringupBench,
    BringupBus,
    BringupStep,
    Measured,
    NotMeasuredError,
    Outcome,
    SideEffect,
    StepResult,
    Verdict,
)
from adis_gonio.device.bus import SpiBus
from adis_gonio.device.sensor.driver import Adis16354, Undo
from adis_gonio.device.sensor.registers import NORMAL, Variant, registers, variant as find_variant
from adis_gonio.page.document import Section, Table, render
from adis_gonio.record.source import HOLDING_SETTINGS

# fmt: off
STEPS = (
    BringupStep("link", link_steps.check_link),
    BringupStep("timing", link_steps.check_timing),
    BringupStep("bit errors", link_steps.count_bit_errors),
    BringupStep("supply", link_steps.check_supply),
    BringupStep("variant", link_steps.identify_variant),
    BringupStep("sample rate", update_steps.measure_rate),
    BringupStep("data-ready", update_steps.check_data_ready, SideEffect.LENDS, "", ("data_ready_edge",)),
    BringupStep("noise", part_steps.measure_noise, SideEffect.LENDS, "", ("accel_noise", "gyro_noise")),
    BringupStep("offset", part_steps.measure_offsets, SideEffect.WRITES,
                "Write XACCL_OFF, YACCL_OFF and ZACCL_OFF (+1000 LSB for a second)?",
                ("accel_offset_lsb", "offset_after_filter")),
    BringupStep("sample periods", update_steps.measure_periods, SideEffect.WRITES,
                "Write SMPL_PRD (eight values, about 10 s)?", ("sample_period",)),
    BringupStep("filter steps", part_steps.measure_filter, SideEffect.WRITES,
                "Write SENS_AVG (filter M = 0 … 6, about 20 s)?", ("filter_gain",)),
    BringupStep("self-test", part_steps.run_self_tests, SideEffect.WRITES,
                "Run the self-tests (MSC_CTRL[10:8], about 3 s, volatile)?",
                ("self_test_gyro", "self_test_accel")),
    BringupStep("status", part_steps.check_status, SideEffect.WRITES,
                "Write ALM_MAG1, ALM_CTRL and an accelerometer's offset (a second each)?",
                ("alarm_stays", "over_range_falls")),
    BringupStep("flash count", part_steps.check_flash_count, SideEffect.FLASH,
                "Reset the part and write the flash once (10 000 writes are its life)?", ("flash_count",)),
)
# fmt: on
"""Steps in order: steps that only read, steps that enable data-ready, steps that write, the flash last."""


@dataclass(frozen=True)
class Permission:
    """Changes to the sensor that the operator permits during a bring-up.

    Attributes
    ----------
    writes : bool
        True if registers may be written; each step asks before.
    flash : bool
        True if the flash may be written once.
    ask : callable
        Asks the operator a question before a write; returns True for yes.
    """

    writes: bool = False
    flash: bool = False
    ask: Callable[[str], bool] = lambda question: True


def bring_up(
    bus: SpiBus,
    *,
    variant: str | Variant = "adis16354",
    permission: Permission = Permission(),
    tell: Callable[[StepResult], object] = lambda row: None,
    steps: tuple[BringupStep, ...] = STEPS,
) -> Bringup:
    """Check a new board by the bring-up steps, and return the results.

    A Ctrl-C ends it early: the registers are restored, and the result is marked `stopped`.

    Parameters
    ----------
    bus : SpiBus
        An open bus; it stays open.
    variant : str or Variant
        Expected part.
    permission : Permission
        Permitted changes; by default only steps that read, or enable data-ready for a time, are run.
    tell : callable
        Called with the result of each finished step.
    steps : tuple of BringupStep
        Steps to run, in order.

    Returns
    -------
    Bringup
        Results of all steps. They include faults of sensor and bridge, which are not raised.
    """
    limited = BringupBus(bus, NORMAL.clock_hz)
    begun = limited.witness("utc", lambda: datetime.now(UTC).isoformat(timespec="seconds"))
    found = Bringup(bus.url, find_variant(variant).name, begun, f"adis-gonio {__version__}")
    _Run(limited, found, permission, tell).all(steps)
    return found


@dataclass
class _Run:
    """A bring-up in progress: runs the steps and collects their results in `found`."""

    bus: BringupBus
    found: Bringup
    permission: Permission
    tell: Callable[[StepResult], object]
    bench: BringupBench | None = None

    def all(self, steps: tuple[BringupStep, ...]) -> None:
        found, failure = self.found, ""
        with self._until_stopped():
            try:
                sensor = Adis16354(self.bus, found.variant, check=False)
                self.bench = BringupBench(self.bus, sensor)
            except AdisGonioError as error:
                failure = str(error)
        for step in steps:
            result = step.new_result("stopped by the operator")
            with self._until_stopped():
                if self.bench is not None and not found.stopped:
                    result = self._one(self.bench, step)
                elif failure:
                    result = step.new_result("the link does not work")
                    result = result if found.rows else step.new_result(failure, Verdict.FAULT)
            with self._until_stopped():
                found.rows.append(result)
                default = Answer(Outcome.NOT_MEASURED, result.text)
                found.answers |= {name: result.answers.get(name, default) for name in step.settles}
                self.tell(result)
        if found.undo is not None:
            with self._until_stopped():
                found.undo.put_back()  # again, since an interruption may have come during the first time
        found.bridge = _bridge(self.bus)
        if self.bench is not None:
            found.variant, found.registers = self.bench.sensor.variant.name, self.bench.constants

    @contextmanager
    def _until_stopped(self) -> Iterator[None]:
        """Context that Ctrl-C ends without an exception; the bring-up is then marked as stopped."""
        try:
            yield
        except KeyboardInterrupt:
            self.found.stopped = True

    def _one(self, bench: BringupBench, step: BringupStep) -> StepResult:
        if refusal := bench.blocked or self._refusal(step):
            return step.new_result(refusal)
        if step.effect in (SideEffect.WRITES, SideEffect.FLASH) and not self.permission.ask(step.question):
            return step.new_result("the answer to its question was no")
        changes, found, result = step.effect is not SideEffect.READS, self.found, step.new_result()
        try:
            if changes and found.undo is None:
                found.undo = Undo(bench.sensor, registers(HOLDING_SETTINGS))
            bench.bus.calls.clear()
            result.verdict, result.text = step.run(bench, result)
        except NotMeasuredError as reason:
            result.text = str(reason)
        except AdisGonioError as error:
            return step.new_result(f"could not be done: {error}", Verdict.FAULT)
        finally:
            if changes and found.undo is not None:
                try:
                    found.undo.put_back()
                finally:
                    if found.undo.unrestored:
                        bench.blocked = f"{', '.join(found.undo.unrestored)} could not be put back"
        return result

    def _refusal(self, step: BringupStep) -> str:
        if step.effect is SideEffect.WRITES and not self.permission.writes:
            return "it writes registers (and undoes it); --allow-writes permits that"
        if step.effect is SideEffect.FLASH and not (self.permission.writes and self.permission.flash):
            return "it writes the flash once; --allow-writes --flash permits that"
        return ""


def _bridge(bus: BringupBus) -> dict[str, Any]:
    """Return facts about the bridge for the JSON document: bus, capabilities, limits, firmware."""
    inner = bus.inner
    facts: dict[str, Any] = {"bus": inner.kind, "capabilities": sorted(inner.capabilities)}
    facts["unbroken_frames"] = inner.unbroken_frames
    facts["clock_hz_used_at_most"] = bus.ceiling_hz
    firmware = getattr(inner, "firmware", None)
    if dataclasses.is_dataclass(firmware) and not isinstance(firmware, type):
        facts["firmware"] = dataclasses.asdict(firmware)
    return facts


def build_page(found: Bringup) -> str:
    """Return the result of a bring-up as one HTML page without external resources."""
    details = [_detail(row) for row in found.rows if row.verdict is not Verdict.NOT_MEASURED]
    return render(
        "Bring-up",
        found.url,
        shape=f"{found.variant.upper()}, {found.bridge['bus']}",
        simulated=found.simulated,
        begun=found.begun_utc,
        software=found.software,
        sections=(_summary(found), _answers(found), Section("The steps", parts=details), _limits(found)),
        closing="The JSON file next to this page has these figures for programs.",
    )


def _summary(found: Bringup) -> Section:
    rows = [(row.name, row.verdict, row.text) for row in found.rows]
    strong = [k for k, row in enumerate(found.rows) if row.verdict in (Verdict.FAULT, Verdict.DIFFERS)]
    return Section(
        "Results",
        words=(found.headline, f"Writes: {found.undone}."),
        tables=(Table(("step", "verdict", "result"), rows, strong=tuple(strong)),),
    )


def _answers(found: Bringup) -> Section:
    rows, strong = [], []
    for k, question in enumerate(QUESTIONS):
        answer = found.answers[question.name]
        rows.append(
            (
                question.text,
                question.table,
                f"{question.source}, {question.confidence}",
                answer.outcome,
                "\n".join([answer.text, *(f"{f.name}: {_value(f)}" for f in answer.figures)]),
            )
        )
        if answer.outcome is Outcome.CONTRADICTS:
            strong.append(k)
    return Section(
        "Answers about the register table",
        words=(
            "Rows that a real part can settle, with the table's value, its source and its confidence (A the"
            " sibling's data sheet and code agree, B the sibling's sheet only, C derived, D an estimate).",
        ),
        tables=(Table(("question", "table", "source", "outcome", "measured"), rows, strong=tuple(strong)),),
    )


def _detail(row: StepResult) -> Section:
    rows = [
        (figure.name, _value(figure), "" if figure.expected is None else _number(figure.expected, figure))
        for figure in row.figures
    ]
    table = Table(("figure", "value", "expected"), rows, numeric=(1, 2))
    return Section(row.name, words=(f"{row.does} ({row.effect}).",), tables=(table,))


def _limits(found: Bringup) -> Section:
    held = ", ".join(f"{name} 0x{word:04X}" for name, word in found.registers.items())
    bridge = ", ".join(f"{name} {value}" for name, value in found.bridge.items())
    return Section(
        "Limits and surroundings",
        words=(
            "A good board is accused with a probability below 1 in 10 000. Each limit is a quantile of the"
            " figure's distribution on a good board: normal for means, chi-square for variances,"
            " exponential for the bins of a spectrum. Faults that are not random have no limit.",
            "± is U (95 %).",
        ),
        notes=(f"Bridge: {bridge}.", f"Original registers: {held or 'not read'}."),
    )


def _value(figure: Measured) -> str:
    if figure.u is None:
        return _number(figure.value, figure)
    return str(Value(figure.value, figure.u, figure.unit))


def _number(value: float, figure: Measured) -> str:
    whole = float(value).is_integer() and abs(value) < 1e7
    return with_unit(format_fixed(value, 0) if whole else format_number(value, 6), figure.unit)
