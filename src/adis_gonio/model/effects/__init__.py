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
    Tone,
)
from adis_gonio.model.effects.environment import (
    BiasDrift,
    BiasTemperature,
    Gravity,
    MisalignmentTemperature,
    ScaleDrift,
    ScaleTemperature,
    SupplyBias,
    SupplyScale,
    ThermalLag,
    WarmUp,
)
from adis_gonio.model.effects.registry import BUILT_IN, ENTRY_POINT_GROUP, catalogue, effect, parse_effect
from adis_gonio.model.effects.sensor_terms import (
    Asymmetry,
    Bias,
    CrossAxis,
    CrossQuadratic,
    Cubic,
    Misalignment,
    Quadratic,
    Scale,
    VibrationRectification,
)
from adis_gonio.model.effects.stage import (
    AxisTilt,
    Backlash,
    Creep,
    Hysteresis,
    PositionSlip,
    StageEccentricity,
    StageEllipticity,
    StagePeriodic,
)

__all__ = [
    "AXES",
    "BUILT_IN",
    "COVARIATES",
    "ENTRY_POINT_GROUP",
    "Asymmetry",
    "AxisTilt",
    "Backlash",
    "Bias",
    "BiasDrift",
    "BiasTemperature",
    "Conditions",
    "Creep",
    "CrossAxis",
    "CrossQuadratic",
    "Cubic",
    "Effect",
    "Enters",
    "Gravity",
    "Hysteresis",
    "Misalignment",
    "MisalignmentTemperature",
    "NoiseChange",
    "OutlierDwell",
    "Parameter",
    "PositionSlip",
    "Quadratic",
    "Quantization",
    "Saturation",
    "Scale",
    "ScaleDrift",
    "ScaleTemperature",
    "Settling",
    "StageEccentricity",
    "StageEllipticity",
    "StagePeriodic",
    "SupplyBias",
    "SupplyScale",
    "ThermalLag",
    "Tone",
    "VibrationRectification",
    "WarmUp",
    "catalogue",
    "effect",
    "parse_effect",
]
