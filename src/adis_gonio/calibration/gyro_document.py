"""A gyro calibration as JSON, and back: by itself, or under the key `gyro` of a calibration's document."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from adis_gonio.calibration.calibration import NotCorrected
from adis_gonio.calibration.document import _coefficient, _covered, _parameter
from adis_gonio.calibration.gyros import GyroCalibration, kind_of
from adis_gonio.errors import DataError, FitError
from adis_gonio.model.effects import AXES
from adis_gonio.model.effects.environment import REFERENCE_C, REFERENCE_V
from adis_gonio.sensor.registers import BY_NAME

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
        made = _read(document)
        made.check()
    except (KeyError, TypeError, ValueError, AttributeError, FitError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(f"{name}: is a damaged gyro calibration: {what}") from None
    return made


def _read(document: Mapping[str, Any]) -> GyroCalibration:
    reference, covariance = document["reference"], document["covariance"]
    if document["unit"] != "dps":
        raise ValueError("its unit is not dps")
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
        method=str(document["method"]),
        parameters=parameters,
        covariance=None if covariance is None else _matrix(covariance, names),
        assumed=tuple(str(one) for one in document["assumed"]),
        not_corrected=tuple(NotCorrected(**one) for one in document["not_corrected"]),
        temperature_c=_covered(reference["session_temperature_c"]),
        supply_v=_covered(reference["session_supply_v"]),
        offsets_lsb=_offsets(document["offsets_lsb"]),
        source=str(document.get("source", "")),  # files of before have none
    )


def _matrix(covariance: Mapping[str, Any], names: list[str]) -> Any:
    if covariance["names"] != names:
        raise ValueError("the covariance's names are not those of the parameters")
    matrix, p = np.array(covariance["matrix"], dtype=float), len(names)
    if matrix.shape != (p, p) or not np.isfinite(matrix).all():
        raise ValueError(f"the covariance of {p} parameters is no matrix of {p} × {p} finite numbers")
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if (np.diag(matrix) < 0).any() or (np.abs(matrix - matrix.T) > 1e-9 * np.outer(sizes, sizes)).any():
        raise ValueError("the covariance is not symmetric, or a variance is negative")
    return matrix


def _offsets(given: Any) -> tuple[int, int, int] | None:
    if given is None:
        return None
    if not isinstance(given, list) or len(given) != 3 or any(type(one) is not int for one in given):
        raise ValueError("offsets_lsb is not three whole numbers")
    low, high = BY_NAME["XGYRO_OFF"].range
    if not all(low <= one <= high for one in given):
        raise ValueError(f"offsets_lsb holds a number beyond {low} to {high}")
    return given[0], given[1], given[2]
