"""Bring-up of a new board: what to check once, in order, and what it says about the register table."""

from adis_gonio.bringup.result import Answer, Bringup, Measured, Outcome, StepResult, Verdict
from adis_gonio.bringup.run import STEPS, Permission, bring_up

__all__ = [
    "STEPS",
    "Answer",
    "Bringup",
    "Measured",
    "Outcome",
    "Permission",
    "StepResult",
    "Verdict",
    "bring_up",
]
