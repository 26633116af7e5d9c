"""A gyro calibration as JSON, and back: by itself, or under the key `gyro` of a calibration's document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from adis_gonio.base.errors import DataError, FitError
from adis_gonio.base.shapes import anything, choice, fields, list_of, nullable, text, whole
from adis_gonio.calibrate.calibration import NotCorrected
from adis_gonio.calibrate.document import (
    COEFFICIENTS,
    COVARIANCE,
    NOT_CORRECTED,
    REFERENCE,
    TEXTS,
    _coefficient,
    _covered,
    _parameter,
    matrix_of,
)
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, kind_of
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.model.effects import AXES
from adis_gonio.model.effects.environment import REFERENCE_C, REFERENCE_V

GYRO_SCHEMA = "adis-gonio/gyro-calibration"
VERSION = 1


def gyro_document_of(gyro: GyroCalibration) -> dict[str, Any]:
    """JSON document of a gyro calibration; `derived` follows from the parameters."""
    matrix = gyro.covariance
    names = [one.name for one in gyro.parameters]
    return {
        "schema": GYRO_SCHEMA,
        "version": VERSION,
        "method": gyro.method,
        "unit": "dps",
        "parameters": {one.name: _coefficient(one) for one in gyro.parameters},
        "derived": {
            "bias_dps": gyro.bias_dps.tolist(),
            "sensitivity": gyro.sensitivity.tolist(),
            "g_sensitivity_dps_per_g": gyro.g_sensitivity_dps_per_g.tolist(),
        },
        "covariance": None if matrix is None else {"names": names, "matrix": matrix.tolist()},
        "not_corrected": [asdict(one) for one in gyro.not_corrected],
        "assumed": list(gyro.assumed),
        "reference": {
            "temperature_c": REFERENCE_C,
            "supply_v": REFERENCE_V,
            "session_temperature_c": None if gyro.temperature_c is None else gyro.temperature_c.as_dict(),
            "session_supply_v": None if gyro.supply_v is None else gyro.supply_v.as_dict(),
        },
        "offsets_lsb": None if gyro.offsets_lsb is None else list(gyro.offsets_lsb),
        "source": gyro.source,
    }


def gyro_calibration_from(document: Any, name: str = "gyro calibration") -> GyroCalibration:
    """Gyro calibration of a JSON document.

    Raises
    ------
    DataError
        It is none, of a newer version, or something in it cannot be used; `name` says where.
    """
    if not isinstance(document, Mapping) or document.get("schema") != GYRO_SCHEMA:
        raise DataError(f"{name}: is no gyro calibration")
    if document.get("version") != VERSION:
        raise DataError(
            f"{name}: is a gyro calibration of version {document.get('version')!r}, this program reads "
            f"{VERSION}: update adis-gonio"
        )
    try:
        DOCUMENT(document)
        made = _read(document)
        made.check()
    except (KeyError, TypeError, ValueError, AttributeError, FitError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error).lstrip(" .")
        raise DataError(f"{name}: is a damaged gyro calibration: {what}") from None
    return made


DOCUMENT = fields(
    {
        "method": text,
        "unit": choice("dps"),
        "parameters": COEFFICIENTS,
        "covariance": COVARIANCE,
        "not_corrected": NOT_CORRECTED,
        "assumed": TEXTS,
        "reference": REFERENCE,
        "offsets_lsb": nullable(list_of(whole(*BY_NAME["XGYRO_OFF"].range), 3, 3)),
    },
    {"source": text},
    others=anything,
)
"""Types and ranges of all that is read of a gyro calibration."""


def _read(document: Mapping[str, Any]) -> GyroCalibration:
    reference, covariance, offsets = document["reference"], document["covariance"], document["offsets_lsb"]
    # Effects in temperature and supply are zero there: another reference would move every zero rate.
    if (reference["temperature_c"], reference["supply_v"]) != (REFERENCE_C, REFERENCE_V):
        raise ValueError(f"its reference is not {REFERENCE_C:g} °C and {REFERENCE_V:g} V")
    parameters = tuple(_parameter(str(key), value) for key, value in document["parameters"].items())
    names = [one.name for one in parameters]
    strange = [name for name in names if kind_of(name) is None]
    missing = [f"gyro_bias_{axis}" for axis in AXES if f"gyro_bias_{axis}" not in names]
    if strange:
        raise ValueError(f"{strange[0]} is no parameter of a gyro")
    if missing:
        raise ValueError(f"parameter {missing[0]} is missing")
    return GyroCalibration(
        method=document["method"],
        parameters=parameters,
        covariance=None if covariance is None else matrix_of(covariance, names),
        assumed=tuple(document["assumed"]),
        not_corrected=tuple(NotCorrected(**one) for one in document["not_corrected"]),
        temperature_c=_covered(reference["session_temperature_c"]),
        supply_v=_covered(reference["session_supply_v"]),
        offsets_lsb=None if offsets is None else (offsets[0], offsets[1], offsets[2]),
        source=document.get("source", ""),  # files of before have none
    )
