"""A calibration as JSON and as text, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.jsonable import json_object
from adis_gonio.base.output import check_output, replacing, write_utf8
from adis_gonio.base.shapes import (
    Shape,
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
from adis_gonio.calibrate.calibration import Calibration, Coefficient, EffectTerm, NotCorrected, _shown
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.model.effects import effect
from adis_gonio.model.effects.environment import REFERENCE_C, REFERENCE_V
from adis_gonio.model.records import SENSORS
from adis_gonio.record.provenance import Covered, Provenance

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

SCHEMA = "adis-gonio/calibration"
VERSION = 1
SOURCE = ("title", "serial", "operator", "stage", "source", "sha256", "recorded_utc", "software")
"""Entries `source` of a document: attributes of the provenance."""
Read = TypeVar("Read")


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
    return json_object(
        schema=SCHEMA,
        version=VERSION,
        method=calibration.method,
        sensor=where.sensor,
        plane=where.plane,
        unit=calibration.unit,
        counts_per_mg=calibration.counts_per_mg,
        gravity_mps2=where.gravity_mps2,
        parameters={one.name: one for one in calibration.parameters},
        derived={} if ratio is None else {"delta_k": ratio},
        covariance=covariance_entry(calibration),
        effects=[_effect(term) for term in calibration.effects],
        not_corrected=calibration.not_corrected,
        assumed=calibration.assumed,
        reference=reference_entry(where),
        offsets_lsb=where.offsets_lsb,
        source={name: getattr(where, name) for name in SOURCE},
        **{} if calibration.gyro is None else {"gyro": calibration.gyro},
    )


def covariance_entry(calibration: Calibration | GyroCalibration) -> dict[str, Any] | None:
    """Entry `covariance` of a document; None if the covariance is unknown."""
    if calibration.covariance is None:
        return None
    return {"names": [one.name for one in calibration.parameters], "matrix": calibration.covariance}


def reference_entry(where: Provenance | GyroCalibration) -> dict[str, Any]:
    """Entry `reference` of a document: where effects are zero, and the conditions of the session."""
    return {
        "temperature_c": REFERENCE_C,
        "supply_v": REFERENCE_V,
        "session_temperature_c": where.temperature_c,
        "session_supply_v": where.supply_v,
    }


def calibration_from(document: Any, name: str = "calibration") -> Calibration:
    """Calibration of a JSON document.

    Raises
    ------
    DataError
        It is no calibration, of a newer version, or something in it cannot be used; `name` says where.
    """
    hint = "; make one with adis-gonio export SESSION -o NAME.json"
    made = read_document(document, name, "calibration", SCHEMA, DOCUMENT, _read, hint)
    if document.get("gyro") is None:
        return made
    from adis_gonio.calibrate.gyro_document import gyro_calibration_from

    return replace(made, gyro=gyro_calibration_from(document["gyro"], f"{name}: gyro"))


def read_document(
    document: Any,
    name: str,
    kind: str,
    schema: str,
    shape: Shape,
    read: Callable[[Mapping[str, Any]], Read],
    hint: str = "",
) -> Read:
    """Object of a JSON document whose writer is not known.

    Parameters
    ----------
    name : str
        Where the document stands, for messages.
    kind : str
        Name of such an object, for messages.
    hint : str
        End of the message about a document with another schema.

    Raises
    ------
    DataError
        The document has another schema or version, or something in it cannot be used.
    """
    if not isinstance(document, Mapping) or document.get("schema") != schema:
        raise DataError(f"{name}: is no {kind}{hint}")
    if document.get("version") != VERSION:
        raise DataError(
            f"{name}: is a {kind} of version {document.get('version')!r}, this program reads {VERSION}: "
            "update adis-gonio"
        )
    try:
        shape(document)
        return read(document)
    except (KeyError, TypeError, ValueError, AttributeError, FitError, UsageError) as error:
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error).lstrip(" .")
        raise DataError(f"{name}: is a damaged {kind}: {what}") from None


_GAINS, _LEAST_GAIN = ("scale_x", "scale_y", "scale_z"), 1e-6
_VALUE = number(-1e15, 1e15)
_COEFFICIENTS = mapping_of(
    fields(
        {"value": _VALUE, "u": nullable(number(0.0, 1e15)), "unit": text},
        {"dof": nullable(number(0.0, 1e300))},
        others=anything,
    )
)
_TEXTS = list_of(text, 0, 10_000)
_COVARIANCE = nullable(
    fields(
        {"names": _TEXTS, "matrix": list_of(list_of(number(-1e30, 1e30), 0, 10_000), 0, 10_000)},
        others=anything,
    )
)
_REFERENCE = fields(
    {
        "session_temperature_c": nullable(mapping_of(_VALUE)),
        "session_supply_v": nullable(mapping_of(_VALUE)),
    },
    others=anything,
)
COMMON = {
    "method": text,
    "parameters": _COEFFICIENTS,
    "covariance": _COVARIANCE,
    "not_corrected": list_of(fields({"effect": text, "reason": text}), 0, 10_000),
    "assumed": _TEXTS,
    "reference": _REFERENCE,
}
"""Shapes of the entries that calibrations of accelerometers and of gyros have."""
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
        **COMMON,
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


def _read(document: Mapping[str, Any]) -> Calibration:
    counts = document["counts_per_mg"]
    where = Provenance(
        sensor=document["sensor"],
        plane=document["plane"],
        gravity_mps2=float(document["gravity_mps2"]),
        counts=document["unit"] == "counts",
        **conditions_from(document),
        **document["source"],
    )
    made = Calibration(
        provenance=where,
        effects=tuple(
            EffectTerm(effect(one["effect"], one["axes"], **one["choices"]), tuple(one["parameters"]))
            for one in document["effects"]
        ),
        counts_per_mg=None if counts is None else tuple(map(float, counts)),
        **common_from(document),
    )
    return _checked(made)


def common_from(document: Mapping[str, Any]) -> dict[str, Any]:
    """Fields that calibrations of accelerometers and of gyros have, from a document."""
    covariance = document["covariance"]
    parameters = tuple(_parameter(name, entry) for name, entry in document["parameters"].items())
    return {
        "method": document["method"],
        "parameters": parameters,
        "covariance": None if covariance is None else matrix_of(covariance, list(document["parameters"])),
        "not_corrected": tuple(NotCorrected(**one) for one in document["not_corrected"]),
        "assumed": tuple(document["assumed"]),
    }


def conditions_from(document: Mapping[str, Any]) -> dict[str, Any]:
    """Temperature, supply and offsets during the session, from a document."""
    offsets, reference = document["offsets_lsb"], document["reference"]
    covered = {name: reference[f"session_{name}"] for name in ("temperature_c", "supply_v")}
    return {
        "offsets_lsb": None if offsets is None else tuple(offsets),
        **{name: None if entry is None else Covered(**entry) for name, entry in covered.items()},
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
    names = {one.name for one in calibration.parameters}
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
    names = [one.name for one in calibration.parameters]
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
    lines += [f"  {_shown(one)}" for one in (*([ratio] if ratio else []), *calibration.parameters)]
    if where.temperature_c is not None:
        t = where.temperature_c
        lines.append(
            f"  measured at {t.low:.1f} to {t.high:.1f} °C; effects of temperature are zero at 25 °C"
        )
    lines += [f"  {name}: not determined, taken as nominal" for name in calibration.assumed]
    lines += [f"  not corrected: {one.effect}: {one.reason}" for one in calibration.not_corrected]
    lines += [] if calibration.gyro is None else [calibration.gyro.summary()]
    return "\n".join(lines)


def _parameter(name: str, entry: Mapping[str, Any]) -> Coefficient:
    u, dof = entry["u"], entry.get("dof")
    return Coefficient(
        name,
        float(entry["value"]),
        None if u is None else float(u),
        entry["unit"],
        None if dof is None else float(dof),
    )


def _effect(term: EffectTerm) -> dict[str, Any]:
    return {
        "effect": term.effect.name,
        "axes": list(term.effect.axes),
        "choices": {choice: getattr(term.effect, choice) for choice in term.effect.choices()},
        "parameters": list(term.parameters),
    }
