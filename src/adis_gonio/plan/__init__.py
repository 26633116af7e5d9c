"""Plans before they are measured: what one will reach and see, and which one is best.

>>> from adis_gonio.plan import Bench, best_plan
>>> found = best_plan(Bench(fixture_deg=0.02), positions=12)
>>> len(found.plan)
12

Names are imported when first used: whoever reads a plan file needs none of the search.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "Bench": "imagined",
    "BestPlan": "best",
    "Prediction": "prediction",
    "best_plan": "best",
    "fewest": "best",
    "plan_by": "document",
    "predict": "prediction",
    "read_plan": "document",
    "within": "best",
    "write_plan": "document",
}

__all__ = [
    "Bench",
    "BestPlan",
    "Prediction",
    "best_plan",
    "fewest",
    "plan_by",
    "predict",
    "read_plan",
    "within",
    "write_plan",
]

if TYPE_CHECKING:
    from adis_gonio.plan.best import BestPlan as BestPlan
    from adis_gonio.plan.best import best_plan as best_plan
    from adis_gonio.plan.best import fewest as fewest
    from adis_gonio.plan.best import within as within
    from adis_gonio.plan.document import plan_by as plan_by
    from adis_gonio.plan.document import read_plan as read_plan
    from adis_gonio.plan.document import write_plan as write_plan
    from adis_gonio.plan.imagined import Bench as Bench
    from adis_gonio.plan.prediction import Prediction as Prediction
    from adis_gonio.plan.prediction import predict as predict


__getattr__ = lazily(__name__, _HOMES)
