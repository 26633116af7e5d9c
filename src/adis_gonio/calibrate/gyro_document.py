"""A gyro calibration as JSON, and back: by itself, or under the key `gyro` of a calibration's document."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from adis_gonio.base.jsonable import json_object
from adis_gonio.base.shapes import anything, choice, fields, list_of, nullable, text, whole
from adis_gonio.calibrate.document import (
    COMMON,
    VERSION,
    common_from,
    conditions_from,
    covariance_entry,
    read_document,
    reference_entry,
)
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, kind_of
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.model.effects import AXES
from adis_gonio.model.effects.environment import REFERENCE_C, REFERENCE_V

GYRO_SCHEMA = "adis-gonio/gyro-calibration"


def gyro_document_of(gyro: GyroCalibration) -> dict[str, Any]:
    """JSON document of a gyro calibration; `derived` follows from the parameters."""
    return json_object(
        schema=GYRO_SCHEMA,
        version=VERSION,
        method=gyro.method,
        unit="dps",
        parameters={one.name: one for one in gyro.parameters},
        derived={
            "bias_dps": gyro.bias_dps,
            "sensitivity": gyro.sensitivity,
            "g_sensitivity_dps_per_g": gyro.g_sensitivity_dps_per_g,
        },
        covariance=covariance_entry(gyro),
        not_corrected=gyro.not_corrected,
        assumed=gyro.assumed,
        reference=reference_entry(gyro),
        offsets_lsb=gyro.offsets_lsb,
        source=gyro.source,
    )


def gyro_calibration_from(document: Any, name: str = "gyro calibration") -> GyroCalibration:
    """Gyro calibration of a JSON document; errors as `adis_gonio.calibrate.document.read_document`."""
    return read_document(document, name, "gyro calibration", GYRO_SCHEMA, DOCUMENT, _read)


DOCUMENT = fields(
    {
        **COMMON,
        "unit": choice("dps"),
        "offsets_lsb": nullable(list_of(whole(*BY_NAME["XGYRO_OFF"].range), 3, 3)),
    },
    {"source": text},
    others=anything,
)
"""Types and ranges of all that is read of a gyro calibration."""


def _read(document: Mapping[str, Any]) -> GyroCalibration:
    reference, names = document["reference"], document["parameters"]
    # Effects in temperature and supply are zero there: another reference would move every zero rate.
    if (reference["temperature_c"], reference["supply_v"]) != (REFERENCE_C, REFERENCE_V):
        raise ValueError(f"its reference is not {REFERENCE_C:g} °C and {REFERENCE_V:g} V")
    strange = [name for name in names if kind_of(name) is None]
    missing = [f"gyro_bias_{axis}" for axis in AXES if f"gyro_bias_{axis}" not in names]
    if strange:
        raise ValueError(f"{strange[0]} is no parameter of a gyro")
    if missing:
        raise ValueError(f"parameter {missing[0]} is missing")
    made = GyroCalibration(
        source=document.get("source", ""),  # files of before have none
        **common_from(document),
        **conditions_from(document),
    )
    made.check()
    return made
