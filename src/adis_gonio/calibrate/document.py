"""Calibrations as JSON and as text, and back; gyros by themselves or under the key `gyro`."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.output import check_output, replacing, write_utf8
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
from adis_gonio.calibrate.calibration import Calibration, EffectTerm
from adis_gonio.calibrate.coefficients import Coefficient, Coefficients, NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, kind_of
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.model.effects import AXES, effect
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.model.records import SENSORS
from adis_gonio.record.provenance import Covered, Provenance

SCHEMA = "adis-gonio/calibration"
GYRO_SCHEMA = "adis-gonio/gyro-calibration"
VERSION = 1
Made = TypeVar("Made", Calibration, GyroCalibration)
_SOURCE = ("title", "serial", "operator", "stage", "source", "sha256", "recorded_utc", "software")


def json_text(document: Mapping[str, Any]) -> str:
    """One JSON document as text; numbers with the fewest digits that give the same float again."""
    return json.dumps(document, ensure_ascii=False, indent=2, allow_nan=False) + "\n"


def save_document(document: Mapping[str, Any], path: str | Path, *, force: bool) -> None:
    """Write a document to a file, whole or not at all; errors as `adis_gonio.base.output.check_output`."""
    with replacing(check_output(path, force=force)) as beside:
        write_utf8(beside, json_text(document))


def document_of(calibration: Calibration) -> dict[str, Any]:
    """JSON document of a calibration, as `schema/calibration-1.json` describes it."""
    where = calibration.provenance
    ratio = derived_delta_k(calibration)
    gyro = {} if calibration.gyro is None else {"gyro": calibration.gyro.as_dict()}
    return {
        **_head(SCHEMA, calibration),
        "sensor": where.sensor,
        "plane": where.plane,
        "unit": calibration.unit,
        "counts_per_mg": _listed(calibration.counts_per_mg),
        "gravity_mps2": where.gravity_mps2,
        "derived": {} if ratio is None else {"delta_k": _coefficient(ratio)},
        "effects": [_effect(term) for term in calibration.effects],
        **_body(calibration, where),
        "source": {name: getattr(where, name) for name in _SOURCE},
        **gyro,
    }


def gyro_document_of(gyro: GyroCalibration) -> dict[str, Any]:
    """JSON document of a gyro calibration; `derived` follows from the parameters."""
    return {
        **_head(GYRO_SCHEMA, gyro),
        "unit": "dps",
        "derived": {
            "bias_dps": gyro.bias_dps.tolist(),
            "sensitivity": gyro.sensitivity.tolist(),
            "g_sensitivity_dps_per_g": gyro.g_sensitivity_dps_per_g.tolist(),
        },
        **_body(gyro, gyro),
        "source": gyro.source,
    }


def _head(schema: str, calibration: Coefficients) -> dict[str, Any]:
    return {"schema": schema, "version": VERSION, "method": calibration.method}


def _body(
    calibration: Calibration | GyroCalibration, where: Provenance | GyroCalibration
) -> dict[str, Any]:
    """Entries that both kinds of calibrations have."""
    covariance = calibration.covariance
    return {
        "parameters": {one.name: _coefficient(one) for one in calibration.parameters},
        "covariance": None
        if covariance is None
        else {"names": calibration.names, "matrix": covariance.tolist()},
        "not_corrected": [asdict(one) for one in calibration.not_corrected],
        "assumed": list(calibration.assumed),
        "reference": {
            "temperature_c": REFERENCE_C,
            "supply_v": REFERENCE_V,
            "session_temperature_c": None if where.temperature_c is None else where.temperature_c.as_dict(),
            "session_supply_v": None if where.supply_v is None else where.supply_v.as_dict(),
        },
        "offsets_lsb": _listed(where.offsets_lsb),
    }


def calibration_from(document: Any, name: str = "calibration") -> Calibration:
    """Calibration of a JSON document.

    Raises
    ------
    DataError
        It is no calibration, of a newer version, or something in it cannot be used; `name` says where.
    """
    hint = "; make one with adis-gonio export SESSION -o NAME.json"
    made = _read_from(document, name, SCHEMA, "calibration", _read, hint)
    if document.get("gyro") is None:
        return made
    return replace(made, gyro=gyro_calibration_from(document["gyro"], f"{name}: gyro"))


def gyro_calibration_from(document: Any, name: str = "gyro calibration") -> GyroCalibration:
    """Gyro calibration of a JSON document; errors as `calibration_from`."""
    return _read_from(document, name, GYRO_SCHEMA, "gyro calibration", _read_gyro)


def _read_from(
    document: Any,
    name: str,
    schema: str,
    kind: str,
    read: Callable[[Mapping[str, Any]], Made],
    hint: str = "",
) -> Made:
    if not isinstance(document, Mapping) or document.get("schema") != schema:
        raise DataError(f"{name}: is no {kind}{hint}")
    if document.get("version") != VERSION:
        raise DataError(
            f"{name}: is a {kind} of version {document.get('version')!r}, this program reads "
            f"{VERSION}: update adis-gonio"
        )
    try:
        return read(document)
    except (KeyError, TypeError, ValueError, AttributeError, UsageError, FitError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error).lstrip(" .")
        raise DataError(f"{name}: is a damaged {kind}: {what}") from None


_GAINS, _LEAST_GAIN = ("scale_x", "scale_y", "scale_z"), 1e-6
_VALUE = number(-1e15, 1e15)
_TEXTS = list_of(text, 0, 10_000)
_BODY = {
    "method": text,
    "parameters": mapping_of(
        fields(
            {"value": _VALUE, "u": nullable(number(0.0, 1e15)), "unit": text},
            {"dof": nullable(number(0.0, 1e300))},
            others=anything,
        )
    ),
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
            "session_temperature_c": nullable(mapping_of(_VALUE)),
            "session_supply_v": nullable(mapping_of(_VALUE)),
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
    others=anything,
)
"""Types and ranges of all that is read of a calibration file."""
GYRO_DOCUMENT = fields(
    {
        **_BODY,
        "unit": choice("dps"),
        "offsets_lsb": nullable(list_of(whole(*BY_NAME["XGYRO_OFF"].range), 3, 3)),
    },
    {"source": text},
    others=anything,
)
"""Types and ranges of all that is read of a gyro calibration."""


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
    return _checked(Calibration(provenance=where, effects=effects, counts_per_mg=counts_per_mg, **shared))


def _read_gyro(document: Mapping[str, Any]) -> GyroCalibration:
    GYRO_DOCUMENT(document)
    reference = document["reference"]
    # Effects in temperature and supply are zero there: another reference would move every zero rate.
    if (reference["temperature_c"], reference["supply_v"]) != (REFERENCE_C, REFERENCE_V):
        raise ValueError(f"its reference is not {REFERENCE_C:g} °C and {REFERENCE_V:g} V")
    names = list(document["parameters"])
    strange = [name for name in names if kind_of(name) is None]
    missing = [f"gyro_bias_{axis}" for axis in AXES if f"gyro_bias_{axis}" not in names]
    if strange:
        raise ValueError(f"{strange[0]} is no parameter of a gyro")
    if missing:
        raise ValueError(f"parameter {missing[0]} is missing")
    # Files of older versions have no source.
    made = GyroCalibration(source=document.get("source", ""), **_read_body(document))
    made.check()
    return made


def _read_body(document: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes that both kinds of calibrations have."""
    covariance, offsets, reference = document["covariance"], document["offsets_lsb"], document["reference"]
    return {
        "method": document["method"],
        "parameters": tuple(_parameter(key, value) for key, value in document["parameters"].items()),
        "covariance": None if covariance is None else matrix_of(covariance, list(document["parameters"])),
        "not_corrected": tuple(NotCorrected(**one) for one in document["not_corrected"]),
        "assumed": tuple(document["assumed"]),
        "temperature_c": _covered(reference["session_temperature_c"]),
        "supply_v": _covered(reference["session_supply_v"]),
        "offsets_lsb": None if offsets is None else tuple(offsets),
    }


def matrix_of(covariance: Mapping[str, Any], names: list[str]) -> Floats:
    """Covariance (p, p) of p parameters.

    Raises
    ------
    ValueError
        Other names, another size, not symmetric, or a negative variance.
    """
    if covariance["names"] != names:
        raise ValueError("the covariance's names are not those of the parameters")
    rows, p = covariance["matrix"], len(names)
    if len(rows) != p or any(len(row) != p for row in rows):
        raise ValueError(f"the covariance of {p} parameters is no matrix of {p} × {p} finite numbers")
    matrix = np.array(rows, dtype=float).reshape(p, p)
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if (np.diag(matrix) < 0).any() or (np.abs(matrix - matrix.T) > 1e-9 * np.outer(sizes, sizes)).any():
        raise ValueError("the covariance is not symmetric, or a variance is negative")
    return matrix


def _checked(calibration: Calibration) -> Calibration:
    """The same, or `ValueError` where parts of it do not fit together."""
    names = set(calibration.names)
    for term in calibration.effects:
        wanted = len(term.effect.parameters)
        if len(term.parameters) != wanted or not set(term.parameters) <= names:
            raise ValueError(f"effect {term.effect.name} needs {wanted} of the parameters")
    if calibration.provenance.counts != (calibration.counts_per_mg is not None):
        raise ValueError("counts_per_mg goes with unit counts")
    if calibration.counts_per_mg is not None and len(calibration.counts_per_mg) != calibration.axes:
        raise ValueError(f"counts_per_mg has to hold {calibration.axes} numbers")
    for one in calibration.parameters:
        if one.name in _GAINS and not _LEAST_GAIN <= abs(one.value) <= 1 / _LEAST_GAIN:
            raise ValueError(f"{one.name} is {one.value:g}: no gain of a sensor")
    for name in calibration.measurement.names:
        if name not in names and name not in calibration.assumed:
            raise ValueError(f"parameter {name} is missing")
    return calibration


def derived_delta_k(calibration: Calibration) -> Coefficient | None:
    """ΔK = K_x/K_y − 1 with u; None in space."""
    names = calibration.names
    if not calibration.planar or "scale_x" not in names:
        return None
    x = names.index("scale_x")
    k_x = calibration.parameters[x].value
    if "scale_y" not in names:
        return Coefficient("delta_k", k_x - 1, calibration.parameters[x].u, "1")
    y = names.index("scale_y")
    k_y = calibration.parameters[y].value
    if calibration.covariance is None:
        return Coefficient("delta_k", k_x / k_y - 1, None, "1")
    slope = np.zeros(len(names))
    slope[x], slope[y] = 1 / k_y, -k_x / k_y**2
    variance = float(slope @ calibration.covariance @ slope)
    return Coefficient("delta_k", k_x / k_y - 1, math.sqrt(max(variance, 0.0)), "1")


def summary_of(calibration: Calibration) -> str:
    """Lines of text about a calibration."""
    where = calibration.provenance
    lines = [repr(calibration).removeprefix("Calibration(").removesuffix(")")]
    told = [("part", where.serial), ("operator", where.operator), ("stage", where.stage)]
    told += [("title", where.title), ("file", where.source), ("recorded", where.recorded_utc)]
    lines += [f"  {label}: {text}" for label, text in told if text]
    ratio = derived_delta_k(calibration)
    lines += [f"  {one}" for one in (*([ratio] if ratio else []), *calibration.parameters)]
    if where.temperature_c is not None:
        t = where.temperature_c
        lines.append(
            f"  measured at {t.low:.1f} to {t.high:.1f} °C; effects of temperature are zero at 25 °C"
        )
    lines += [f"  {name}: not determined, taken as nominal" for name in calibration.assumed]
    lines += [f"  not corrected: {one.effect}: {one.reason}" for one in calibration.not_corrected]
    lines += [] if calibration.gyro is None else [calibration.gyro.summary()]
    return "\n".join(lines)


def _coefficient(one: Coefficient) -> dict[str, Any]:
    document: dict[str, Any] = {"value": one.value, "u": one.u, "unit": one.unit}
    return document if one.dof is None or math.isinf(one.dof) else document | {"dof": one.dof}


def _parameter(name: str, entry: Mapping[str, Any]) -> Coefficient:
    u, dof = entry["u"], entry.get("dof")
    known_u, known_dof = (None if one is None else float(one) for one in (u, dof))
    return Coefficient(name, float(entry["value"]), known_u, entry["unit"], known_dof)


def _effect(term: EffectTerm) -> dict[str, Any]:
    return {
        "effect": term.effect.name,
        "axes": list(term.effect.axes),
        "choices": {choice: getattr(term.effect, choice) for choice in term.effect.choices()},
        "parameters": list(term.parameters),
    }


def _listed(values: tuple[float, ...] | tuple[int, ...] | None) -> list[float] | None:
    return None if values is None else list(values)


def _covered(entry: Mapping[str, Any] | None) -> Covered | None:
    return None if entry is None else Covered(**entry)
