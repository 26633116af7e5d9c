"""Read and write calibrations as JSON; gyros have their own document or the key `gyro`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, FitError, UsageError, one_line
from adis_gonio.base.jsonable import json_value
from adis_gonio.base.shapes import (
    anything,
    choice,
    fields,
    list_of,
    mapping_of,
    nullable,
    number,
    text,
    whole,
)
from adis_gonio.calibrate.calibration import VERSION, Calibration, Coefficient, EffectTerm, NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.model.effects import effect
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.model.records import SENSORS
from adis_gonio.record.provenance import Covered, Provenance

Made = TypeVar("Made", Calibration, GyroCalibration)


def calibration_from(document: Any, name: str = "calibration") -> Calibration:
    """Read a calibration from a JSON document.

    Raises
    ------
    DataError
        The document is not a calibration, is of a newer version or has unusable entries. The message begins
        with `name`.
    """
    made = _read_from(document, name, Calibration.schema, "calibration", _read)
    if document.get("gyro") is None:
        return made
    return replace(made, gyro=gyro_calibration_from(document["gyro"], f"{name}: gyro"))


def gyro_calibration_from(document: Any, name: str = "gyro calibration") -> GyroCalibration:
    """Read a gyro calibration from a JSON document; `name` begins the message of an error.

    Raises
    ------
    DataError
        The document is not a gyro calibration, is of a newer version or has unusable entries.
    """
    return _read_from(document, name, GyroCalibration.schema, "gyro calibration", _read_gyro)


def _read_from(
    document: Any, name: str, schema: str, kind: str, read: Callable[[Mapping[str, Any]], Made]
) -> Made:
    if not isinstance(document, Mapping) or document.get("schema") != schema:
        raise DataError(f"{name}: is no {kind}; give a session, or the .json of export")
    if document.get("version") != VERSION:
        raise DataError(
            f"{name}: is a {kind} of version {document.get('version')!r}, this program reads "
            f"{VERSION}: update adis-gonio"
        )
    try:
        return read(document)
    except (KeyError, TypeError, ValueError, AttributeError, UsageError, FitError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error).lstrip(" .")
        raise DataError(f"{name}: is a damaged {kind}: {reason}") from None


_GAINS, _LEAST_GAIN = ("scale_x", "scale_y", "scale_z"), 1e-6
_BIASES = ("bias_x", "bias_y", "bias_z")
_LARGEST_SKEW_DEG = 45.0
_VALUE = number(-1e15, 1e15)
_TEXTS = list_of(text, 0, 10_000)
_DOF = nullable(number(0.1, 1e300))
_COEFFICIENTS = mapping_of(
    fields(
        {"value": _VALUE, "u": nullable(number(0.0, 1e15)), "unit": text},
        {"dof": _DOF},
        others=anything,
    )
)
_BODY = {
    "method": text,
    "parameters": _COEFFICIENTS,
    "covariance": nullable(
        fields(
            {"names": _TEXTS, "matrix": list_of(list_of(number(-1e30, 1e30), 0, 10_000), 0, 10_000)},
            others=anything,
        )
    ),
    "not_corrected": list_of(fields({"effect": text, "reason": text}), 0, 10_000),
    "assumed": _TEXTS,
    "reference": fields(
        {
            "session_temperature_c": nullable(fields(dict.fromkeys(("mean", "low", "high"), _VALUE))),
            "session_supply_v": nullable(fields(dict.fromkeys(("mean", "low", "high"), _VALUE))),
        },
        others=anything,
    ),
}
_EFFECT = fields(
    {
        "effect": text,
        "axes": list_of(choice("x", "y", "z"), 0, 3),
        "choices": mapping_of(whole(-1000, 1000)),
        "parameters": _TEXTS,
    },
    others=anything,
)
DOCUMENT = fields(
    {
        **_BODY,
        "sensor": choice(*SENSORS),
        "plane": choice("xy", "none"),
        "unit": choice("mg", "counts"),
        "counts_per_mg": nullable(list_of(_VALUE, 2, 3)),
        "gravity_mps2": number(1e-6, 1e6),
        "effects": list_of(_EFFECT, 0, 10_000),
        "offsets_lsb": nullable(list_of(whole(*BY_NAME["XACCL_OFF"].range), 3, 3)),
        "source": mapping_of(text),
    },
    {"derived": _COEFFICIENTS, "angle_dof": _DOF},
    others=anything,
)
"""Types and ranges of the entries of a calibration file."""
GYRO_DOCUMENT = fields(
    {
        **_BODY,
        "unit": choice("dps"),
        "offsets_lsb": nullable(list_of(whole(*BY_NAME["XGYRO_OFF"].range), 3, 3)),
    },
    {"source": text},
    others=anything,
)
"""Types and ranges of the entries of a gyro calibration in a file."""


def _read(document: Mapping[str, Any]) -> Calibration:
    DOCUMENT(document)
    shared, counts = _read_body(document), document["counts_per_mg"]
    where = Provenance(
        sensor=document["sensor"],
        plane=document["plane"],
        gravity_mps2=float(document["gravity_mps2"]),
        counts=document["unit"] == "counts",
        **{name: shared.pop(name) for name in ("temperature_c", "supply_v", "offsets_lsb")},
        **document["source"],
    )
    effects = tuple(
        EffectTerm(effect(one["effect"], one["axes"], **one["choices"]), tuple(one["parameters"]))
        for one in document["effects"]
    )
    counts_per_mg = None if counts is None else tuple(map(float, counts))
    shared["ratio_dof"] = document.get("derived", {}).get("delta_k", {}).get("dof")
    shared["angle_dof"] = document.get("angle_dof")
    return _checked(Calibration(provenance=where, effects=effects, counts_per_mg=counts_per_mg, **shared))


def _read_gyro(document: Mapping[str, Any]) -> GyroCalibration:
    GYRO_DOCUMENT(document)
    # Files of older versions lack the source.
    made = GyroCalibration(source=document.get("source", ""), **_read_body(document))
    made.check()
    return made


def _read_body(document: Mapping[str, Any]) -> dict[str, Any]:
    """Read the attributes that calibrations of accelerometers and of gyros have in common, by name."""
    covariance, offsets, reference = document["covariance"], document["offsets_lsb"], document["reference"]
    # Effects of temperature and supply are zero at the reference: another reference would move the biases.
    if (reference["temperature_c"], reference["supply_v"]) != (REFERENCE_C, REFERENCE_V):
        raise ValueError(f"its reference is not {REFERENCE_C:g} °C and {REFERENCE_V:g} V")
    parameters = []
    for name, one in document["parameters"].items():
        u, dof = (None if one.get(key) is None else float(one[key]) for key in ("u", "dof"))
        parameters.append(Coefficient(name, float(one["value"]), u, one["unit"], dof))
    covered = {name: reference[f"session_{name}"] for name in ("temperature_c", "supply_v")}
    return {
        "method": document["method"],
        "parameters": tuple(parameters),
        "covariance": None if covariance is None else matrix_of(covariance, list(document["parameters"])),
        "not_corrected": tuple(NotCorrected(**one) for one in document["not_corrected"]),
        "assumed": tuple(document["assumed"]),
        **{name: None if range_ is None else Covered(**range_) for name, range_ in covered.items()},
        "offsets_lsb": None if offsets is None else tuple(offsets),
    }


def matrix_of(covariance: Mapping[str, Any], names: list[str]) -> Floats:
    """Read the covariance (p, p) of the named parameters from a document.

    Raises
    ------
    ValueError
        The names in `covariance` differ from `names`, the size is wrong, the matrix is not symmetric, or a
        variance is negative.
    """
    if covariance["names"] != names:
        apart = sorted(set(covariance["names"]) ^ set(names))
        raise ValueError(f"parameters and covariance differ in names: {', '.join(apart) or 'the order'}")
    rows, p = covariance["matrix"], len(names)
    if len(rows) != p or any(len(row) != p for row in rows):
        raise ValueError(f"the covariance of {p} parameters is no matrix of {p} × {p} finite numbers")
    matrix = np.array(rows, dtype=float).reshape(p, p)
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if (np.diag(matrix) < 0).any() or (np.abs(matrix - matrix.T) > 1e-9 * np.outer(sizes, sizes)).any():
        raise ValueError("the covariance is not symmetric, or a variance is negative")
    return matrix


def _checked(calibration: Calibration) -> Calibration:
    """Return the calibration unchanged; raise `ValueError` if its entries contradict each other."""
    names = set(calibration.names)
    for term in calibration.effects:
        wanted = len(term.effect.parameters)
        if len(term.parameters) != wanted or not set(term.parameters) <= names:
            raise ValueError(f"effect {term.effect.name} needs {wanted} of the parameters")
    if calibration.provenance.counts != (calibration.counts_per_mg is not None):
        raise ValueError("counts_per_mg is needed with unit counts, and allowed with no other unit")
    if calibration.counts_per_mg is not None and len(calibration.counts_per_mg) != calibration.axes:
        raise ValueError(f"counts_per_mg needs {calibration.axes} numbers")
    for one in calibration.parameters:
        if one.name in _GAINS and not _LEAST_GAIN <= abs(one.value) <= 1 / _LEAST_GAIN:
            raise ValueError(f"{one.name} is {one.value:g}: no gain of a sensor")
        if one.name.startswith(("delta_phi", "skew_")) and abs(one.value) > _LARGEST_SKEW_DEG:
            raise ValueError(f"{one.name} is {one.value:g}: no angle between two axes of a sensor")
    for name in calibration.measurement.names:
        if name not in names and name not in calibration.assumed:
            raise ValueError(f"parameter {name} is missing")
    # Effects with unknown conditions, or on an axis that the calibration lacks, raise `UsageError`.
    calibration.readings_of(np.eye(calibration.axes))
    _check_units(calibration)
    return calibration


def _check_units(calibration: Calibration) -> None:
    """Raise `ValueError` if a parameter has another unit than the calibration uses for it."""
    units = {one.name: one.unit for one in calibration.measurement.parameters}
    if calibration.provenance.counts:
        units |= dict.fromkeys(_GAINS, "counts/(m/s²)")
    units |= dict.fromkeys(_BIASES, calibration.unit)
    for term in calibration.effects:
        units |= zip(term.parameters, (one.unit for one in term.effect.parameters), strict=True)
    for one in calibration.parameters:
        if one.unit != (unit := units.get(one.name, one.unit)):
            raise ValueError(f"{one.name} is in {one.unit}, has to be in {unit}")


LARGEST_BYTES = 10_000_000
"""Largest size of a calibration file; usual files have some ten thousand bytes."""


def calibration_in(path: str | Path) -> Calibration | None:
    """Read a calibration from a JSON file; None if the file does not begin like JSON.

    Raises
    ------
    DataError
        The file is JSON but not a calibration, or it is damaged.
    """
    document = json_document(Path(path))
    return None if document is None else calibration_from(document, str(path))


def any_calibration_in(path: str | Path) -> Calibration | GyroCalibration | None:
    """Read a calibration of accelerometers or of gyros alone, as `calibration_in` does."""
    document = json_document(Path(path))
    if isinstance(document, dict) and document.get("schema") == GyroCalibration.schema:
        return gyro_calibration_from(document, str(path))
    return None if document is None else calibration_from(document, str(path))


def json_document(path: Path) -> Any:
    """Read the JSON document of a file; None if the file does not begin like JSON or cannot be read.

    Each text becomes one printable line, because texts appear in messages, comments and pages.
    """
    try:
        with path.open("rb") as file:
            content = file.read(64)
            if content.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] not in (b"{", b"["):
                return None
            content += file.read(LARGEST_BYTES)
    except OSError:
        return None
    if len(content) > LARGEST_BYTES:
        raise DataError(f"{path}: is no calibration: it has more than {LARGEST_BYTES // 1_000_000} MB")
    try:
        return _printable(json_value(content.decode("utf-8-sig"), parse_constant=float))
    except ValueError as error:
        raise DataError(f"{path}: is no JSON: {error}") from None


def _printable(value: Any) -> Any:
    """Copy a JSON value with each of its texts converted to one printable line."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, list):
        return [_printable(entry) for entry in value]
    if isinstance(value, dict):
        return {one_line(key): _printable(entry) for key, entry in value.items()}
    return value
