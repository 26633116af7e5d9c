"""Noise of a part at rest: random walks, bias instability, quantization, with u, beside the Allan plot.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "AllanCurve": "deviation",
    "AllanResult": "result",
    "AxisNoise": "result",
    "NoiseParameter": "result",
    "fit_allan": "fitting",
    "overlapping": "deviation",
}

__all__ = ["AllanCurve", "AllanResult", "AxisNoise", "NoiseParameter", "fit_allan", "overlapping"]

if TYPE_CHECKING:
    from adis_gonio.fitting.allan.deviation import AllanCurve as AllanCurve
    from adis_gonio.fitting.allan.deviation import overlapping as overlapping
    from adis_gonio.fitting.allan.fitting import fit_allan as fit_allan
    from adis_gonio.fitting.allan.result import AllanResult as AllanResult
    from adis_gonio.fitting.allan.result import AxisNoise as AxisNoise
    from adis_gonio.fitting.allan.result import NoiseParameter as NoiseParameter

__getattr__ = lazily(__name__, _HOMES)
