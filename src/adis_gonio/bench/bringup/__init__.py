"""Bring-up of a new board: checks in order, and their answers to open questions of the register table."""

from adis_gonio.bench.bringup.bringup_run import STEPS, Permission, bring_up
from adis_gonio.bench.bringup.bringup_step import Bringup, Outcome, StepResult, Verdict

__all__ = ["STEPS", "Bringup", "Outcome", "Permission", "StepResult", "Verdict", "bring_up"]
