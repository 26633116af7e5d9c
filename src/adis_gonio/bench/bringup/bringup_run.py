"""The run of a bring-up: its steps in order, harmless steps first; every write is undone in any case."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.bringup.bringup_step import (
    Answer,
    Bringup,
    BringupBench,
    BringupBus,
    BringupStep,
    Outcome,
    SideEffect,
    StepResult,
)
from adis_gonio.bench.bringup.link_steps import BitErrors, Health, Link, Timing, WhichPart
from adis_gonio.bench.bringup.part_steps import (
    FilterSteps,
    FlashCount,
    Noise,
    Offset,
    SelfTests,
    StatusBits,
)
from adis_gonio.bench.bringup.update_steps import DataReady, Rate, SamplePeriods
from adis_gonio.device.bus import SpiBus
from adis_gonio.device.sensor.driver import Adis16354, Undo
from adis_gonio.device.sensor.registers import NORMAL, Variant, registers, variant as find_variant
from adis_gonio.record.source import HOLDING_SETTINGS

STEPS: tuple[BringupStep, ...] = (
    Link(),
    Timing(),
    BitErrors(),
    Health(),
    WhichPart(),
    Rate(),
    DataReady(),
    Noise(),
    Offset(),
    SamplePeriods(),
    FilterSteps(),
    SelfTests(),
    StatusBits(),
    FlashCount(),
)
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
            result = new_result(step).not_measured("stopped by the operator")
            with self._until_stopped():
                if self.bench is not None and not found.stopped:
                    result = self._one(self.bench, step)
                elif failure:
                    result = new_result(step).not_measured("the link does not work")
                    result = result if found.rows else new_result(step).fault(failure)
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
        refusal = bench.blocked or self._refusal(step)
        if refusal:
            return new_result(step).not_measured(refusal)
        if step.effect in (SideEffect.WRITES, SideEffect.FLASH) and not self.permission.ask(step.question):
            return new_result(step).not_measured("the answer to its question was no")
        changes, found = step.effect is not SideEffect.READS, self.found
        try:
            if changes and found.undo is None:
                found.undo = Undo(bench.sensor, registers(HOLDING_SETTINGS))
            bench.bus.calls.clear()
            return step.run(bench, new_result(step))
        except AdisGonioError as error:
            return new_result(step).fault(f"could not be done: {error}")
        finally:
            if changes and found.undo is not None:
                try:
                    found.undo.put_back()
                finally:
                    if found.undo.unrestored:
                        bench.blocked = f"{', '.join(found.undo.unrestored)} could not be put back"

    def _refusal(self, step: BringupStep) -> str:
        if step.effect is SideEffect.WRITES and not self.permission.writes:
            return "it writes registers (and undoes it); --allow-writes permits that"
        if step.effect is SideEffect.FLASH and not (self.permission.writes and self.permission.flash):
            return "it writes the flash once; --allow-writes --flash permits that"
        return ""


def new_result(step: BringupStep) -> StepResult:
    """Return an empty result of a step."""
    return StepResult(step.name, step.does, step.effect)


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
