"""The catalogue of effects: named physical terms that the seed paper's model lacks.

>>> from adis_gonio.model.effects import parse_effect
>>> effect, values = parse_effect("quadratic:k2_x=2.5")
>>> effect.name, [p.name for p in effect.parameters], values.tolist()
('quadratic', ['k2_x', 'k2_y'], [2.5, 0.0])
"""

from adis_gonio.model.effects.base import AXES, COVARIATES, Conditions, Effect, Enters, Parameter
from adis_gonio.model.effects.dwell_terms import (
    NoiseChange,
    OutlierDwell,
    Quantization,
    Saturation,
    Settling,
)
from adis_gonio.model.effects.registry import BUILT_IN, ENTRY_POINT_GROUP, catalogue, effect, parse_effect

__all__ = [
    "AXES",
    "BUILT_IN",
    "COVARIATES",
    "ENTRY_POINT_GROUP",
    "Conditions",
    "Effect",
    "Enters",
    "NoiseChange",
    "OutlierDwell",
    "Parameter",
    "Quantization",
    "Saturation",
    "Settling",
    "catalogue",
    "effect",
    "parse_effect",
]
