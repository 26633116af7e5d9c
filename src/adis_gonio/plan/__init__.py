"""Plans before they are measured: the prediction for a plan, and the search for the best one.

>>> from adis_gonio.plan import Bench, best_plan
>>> found = best_plan(Bench(fixture_deg=0.02), positions=12)
>>> len(found.plan)
12

Names are imported when first used, so that reading a plan file does not import the search.
"""

from adis_gonio.base import lazily
from adis_gonio.record.plans import find_plan, read_plan, write_plan

__all__ = ["find_plan", "read_plan", "write_plan"]
_HOMES = {
    "optimal_plan": "BestPlan best_plan fewest_positions positions_in",
    "prediction": "Bench Prediction predict",
}
__getattr__ = lazily(__name__, _HOMES)
