"""Bring-up of a new board: what to check once, in order, and what it says about the register table."""

from adis_gonio.bench.bringup.bringup_run import STEPS, Permission, bring_up
from adis_gonio.bench.bringup.bringup_step import (
    Answer,
    Bringup,
    Measured,
    Outcome,
    Row,
    StepResult,
    Verdict,
)

__all__ = [
    "STEPS",
    "Answer",
    "Bringup",
    "Measured",
    "Outcome",
    "Permission",
    "Row",
    "StepResult",
    "Verdict",
    "bring_up",
]
