"""Plans before they are measured: the prediction for a plan, and the search for the best one.

>>> from adis_gonio.plan import Bench, best_plan
>>> found = best_plan(Bench(fixture_deg=0.02), positions=12)
>>> len(found.plan)
12

Names are imported when first used, so that reading a plan file does not import the search.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily
from adis_gonio.record.plans import find_plan, read_plan, write_plan

if TYPE_CHECKING:
    from adis_gonio.plan.optimal_plan import BestPlan, best_plan, fewest_positions, positions_in
    from adis_gonio.plan.prediction import Bench, Prediction, predict

__all__ = [
    "Bench", "BestPlan", "Prediction", "best_plan", "fewest_positions", "find_plan", "positions_in",
    "predict", "read_plan", "write_plan",
]  # fmt: skip

_MODULES = {
    "optimal_plan": ("BestPlan", "best_plan", "fewest_positions", "positions_in"),
    "prediction": ("Bench", "Prediction", "predict"),
}
__getattr__ = lazily(__name__, {name: module for module, names in _MODULES.items() for name in names})
