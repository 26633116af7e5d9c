"""Digital calibration certificate by the schema of PTB (https://ptb.de/dcc, version 3.2.1) and D-SI 2.1.0.

Values are in SI units (D-SI's notation), with expanded uncertainties at 95 %. The schema requires a
laboratory, a customer and a country; if they are not stated, the certificate says `not stated`. It is not
signed.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.conformity import Tolerance, Verdict, state_conformity
from adis_gonio.base.errors import DataError, FitError, one_line
from adis_gonio.base.uncertainty import coverage_factor
from adis_gonio.calibrate.calibration import CURVE_PLACES, Calibration, Coefficient
from adis_gonio.calibrate.gyro_calibration import KIND_OF
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, StageCurve

VERSION = "3.2.1"
DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
NOT_STATED = "not stated"
NO_COUNTRY = "ZZ"
"""Country code that ISO 3166-1 leaves to its users; here it means that no country is stated."""
PROBABILITY = 0.95

_G = STANDARD_GRAVITY_MPS2
_PER_S2 = r"\metre\second\tothe{-2}"
_DPS = r"\degree\second\tothe{-1}"
# Unit of a result → unit of D-SI, and the conversion factor.
SI_UNITS: dict[str, tuple[str, float]] = {
    "1": (r"\one", 1.0),
    "deg": (r"\degree", 1.0),
    "mg": (_PER_S2, _G / 1000),
    "counts": (r"\one", 1.0),
    "counts/(m/s²)": (r"\metre\tothe{-1}\second\tothe{2}", 1.0),
    "mg/g": (r"\one", 1e-3),
    "mg/g²": (r"\metre\tothe{-1}\second\tothe{2}", 1e-3 / _G),
    "mg/g³": (r"\metre\tothe{-2}\second\tothe{4}", 1e-3 / _G**2),
    "mg/°C": (_PER_S2 + r"\kelvin\tothe{-1}", _G / 1000),
    "mg/°C²": (_PER_S2 + r"\kelvin\tothe{-2}", _G / 1000),
    "mg/°C³": (_PER_S2 + r"\kelvin\tothe{-3}", _G / 1000),
    "ppm/°C": (r"\kelvin\tothe{-1}", 1e-6),
    "deg/°C": (r"\degree\kelvin\tothe{-1}", 1.0),
    "mg/V": (_PER_S2 + r"\volt\tothe{-1}", _G / 1000),
    "ppm/V": (r"\volt\tothe{-1}", 1e-6),
    "dps": (_DPS, 1.0),
    "dps/g": (_DPS + r"\metre\tothe{-1}\second\tothe{2}", 1 / _G),
    "dps/g²": (_DPS + r"\metre\tothe{-2}\second\tothe{4}", 1 / _G**2),
    "dps/°C": (_DPS + r"\kelvin\tothe{-1}", 1.0),
    "dps/°C²": (_DPS + r"\kelvin\tothe{-2}", 1.0),
    "dps/°C³": (_DPS + r"\kelvin\tothe{-3}", 1.0),
    "dps/V": (_DPS + r"\volt\tothe{-1}", 1.0),
}
_NAMES = {
    "delta_k": "Gain mismatch of the axes X and Y",
    "delta_phi": "Misalignment of the axes X and Y",
    "alpha": "Start angle of the stage",
    "scale": "Relative sensitivity of axis",
    "bias": "Bias of axis",
    "skew": "Skew of the axes",
    "gyro_bias": "Zero rate of gyro",
    "gyro_scale": "Relative sensitivity of gyro",
    "gyro_misalignment": "Misalignment of gyro and axis",
    "g_sensitivity": "Sensitivity to acceleration of gyro and axis",
}
_CONFORMITY: dict[Verdict, str] = {"pass": "pass", "fail": "fail", "undecided": "noPass"}
_TURN_DEG = tuple(range(0, 360, 30))


def certificate_text(
    calibration: Calibration, issued: date | None = None, tolerance: Tolerance | None = None
) -> str:
    """Return a calibration as a digital calibration certificate in XML.

    Parameters
    ----------
    issued : date, optional
        Date of the calibration if the session does not state it; by default today.
    tolerance : Tolerance, optional
        Tolerance of the angle for a statement of conformity; without it, none is made.

    Raises
    ------
    FitError
        A parameter has a unit without a known D-SI notation, or conformity cannot be stated.
    """
    for prefix, space in (("dcc", DCC), ("si", SI), ("xsi", XSI)):
        ET.register_namespace(prefix, space)
    root = ET.Element(f"{{{DCC}}}digitalCalibrationCertificate", schemaVersion=VERSION)
    root.set(f"{{{XSI}}}schemaLocation", f"{DCC} {DCC}/v{VERSION}/dcc.xsd")
    administrative = _add(root, "administrativeData")
    _administrative(administrative, calibration, issued)
    if tolerance is not None:
        zero = [name for name in calibration.assumed if name.startswith("bias")]
        if zero:
            raise FitError(f"conformity cannot be stated: {', '.join(zero)} not determined, taken as zero")
        stated = state_conformity(tolerance, calibration.error_curves())
        for name, one in stated.states.items():
            text = f"{name.capitalize()}, the error of the angle within {tolerance}: {one.reason}."
            statement = _named(administrative[-1], "statement", text, "declaration")
            _add(statement, "conformity", _CONFORMITY[one.verdict])
    _results(_add(root, "measurementResults/measurementResult"), calibration)
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


_ANGLE_UNITS = {
    r"\degree": 1.0,
    r"\arcminute": 1 / 60,
    r"\arcsecond": 1 / 3600,
    r"\radian": math.degrees(1),
    r"\milli\radian": math.degrees(1e-3),
    r"\micro\radian": math.degrees(1e-6),
}


def read_stage_curve(path: Path) -> StageCurve:
    """Read the errors of a stage as a function of its angle from its digital calibration certificate.

    A result has to contain two lists of angles of equal length: indicated (or nominal) angles, and errors
    (refType `basic_measurementError`, or "error" in the name) with their uncertainties. Without a
    covariance matrix (`ellipsoidalRegionXMLList`) the errors of different angles count as independent.

    Raises
    ------
    DataError
        The file cannot be read, is no such certificate, or contains no such result.
    """
    try:
        root = ET.fromstring(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ET.ParseError as error:
        raise DataError(f"{path}: is no XML: {error}") from None
    for result in root.iter(f"{{{DCC}}}result"):
        lists = [(q, q.find(f"{{{SI}}}realListXMLList")) for q in result.iter(f"{{{DCC}}}quantity")]
        known = [(_is_error(quantity), each) for quantity, each in lists if each is not None]
        if sorted(error for error, _ in known) == [False, True]:
            return _stage_curve(path, angles=dict(known)[False], errors=dict(known)[True])
    raise DataError(
        f"{path}: contains no error curve of a stage: a result with a list of angles and a list of errors"
    )


def _is_error(quantity: ET.Element) -> bool:
    names = " ".join(content.text or "" for content in quantity.iter(f"{{{DCC}}}content"))
    return "error" in f"{quantity.get('refType', '')} {names}".lower()


def _stage_curve(path: Path, angles: ET.Element, errors: ET.Element) -> StageCurve:
    angle_deg, error_deg = _degrees(path, angles), _degrees(path, errors)
    m = len(angle_deg)
    columns = [
        _floats(path, "covariance", [value.text or "nan" for value in column.iter(f"{{{SI}}}value")])
        for column in errors.iter(f"{{{SI}}}column")
    ]
    factor = _unit_factor(path, errors)
    matrix: Floats = np.zeros(0)
    if columns:
        if {len(c) for c in columns} == {m}:
            matrix = factor**2 * np.array(columns)
    else:
        u = _numbers(path, errors, "uncertaintyXMLList", "valueExpandedMUXMLList", "valueStandardMUXMLList")
        k = _numbers(path, errors, "coverageFactorXMLList") or [1.0]
        if len(u) == m and len(k) in (1, m) and all(k):
            matrix = np.diag((factor * np.array(u) / np.array(k)) ** 2)
    if matrix.shape != (m, m) or not np.isfinite(matrix).all() or len(error_deg) != m or m < 2:
        raise DataError(
            f"{path}: the error curve needs two or more angles, each with an error and its uncertainty"
        )
    angle_deg, order = np.unique(angle_deg % 360, return_index=True)
    error_deg, matrix = error_deg[order], matrix[np.ix_(order, order)]
    if not np.allclose(matrix, matrix.T) or np.linalg.eigvalsh(matrix).min() < -1e-9 * np.trace(matrix):
        raise DataError(
            f"{path}: the covariance matrix of the errors is not symmetric, or gives a negative variance"
        )
    return StageCurve(path.name, angle_deg, error_deg, (matrix + matrix.T) / 2)


def _numbers(path: Path, parent: ET.Element, *names: str) -> list[float]:
    found = next((one.text or "" for name in names for one in parent.iter(f"{{{SI}}}{name}")), "")
    return _floats(path, names[0], found.split())


def _floats(path: Path, name: str, words: Sequence[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        raise DataError(f"{path}: {name} has to be numbers, not '{' '.join(words)[:40]}'") from None


def _unit_factor(path: Path, listed: ET.Element) -> float:
    units = {word for unit in listed.iter(f"{{{SI}}}unitXMLList") for word in (unit.text or "").split()}
    if len(units) != 1 or not units <= set(_ANGLE_UNITS):
        known = ", ".join(_ANGLE_UNITS)
        raise DataError(
            f"{path}: unit of an angle is {', '.join(sorted(units)) or 'missing'}; known: {known}"
        )
    return _ANGLE_UNITS[units.pop()]


def _degrees(path: Path, listed: ET.Element) -> Floats:
    values = np.array(_numbers(path, listed, "valueXMLList"))
    if not np.isfinite(values).all():
        raise DataError(f"{path}: an angle or an error is not finite")
    return np.asarray(_unit_factor(path, listed) * values)


def _add(parent: ET.Element, path: str, text: str | None = None, space: str = DCC) -> ET.Element:
    """Add an element to `parent`, inside new elements if `path` has several tags; return the last one."""
    for name in path.split("/"):
        parent = ET.SubElement(parent, f"{{{space}}}{name}")
    # XML forbids control characters.
    clean = "" if text is None else one_line(text.encode("utf-8", "replace").decode("utf-8")) or NOT_STATED
    parent.text = clean or None
    return parent


def _named(parent: ET.Element, name: str, text: str, element: str = "name") -> ET.Element:
    """Add a child element to `parent` that begins with an element with an English text; return the child.

    `name` is the tag of the child, `element` the tag of the element with the text.
    """
    child = _add(parent, name)
    _add(child, f"{element}/content", text)
    return child


def _software(parent: ET.Element, calibration: Calibration) -> None:
    name, _, release = calibration.provenance.software.partition(" ")
    software = _named(parent, "software", name or "adis-gonio")
    _add(software, "release", release or NOT_STATED)
    _add(software, "type", "application")


def _administrative(parent: ET.Element, calibration: Calibration, issued: date | None) -> None:
    where = calibration.provenance
    _software(_add(parent, "dccSoftware"), calibration)
    core = _add(parent, "coreData")
    day = where.recorded_utc[:10] or (issued or date.today()).isoformat()
    for name, text in (
        ("countryCodeISO3166_1", NO_COUNTRY),
        ("usedLangCodeISO639_1", "en"),
        ("mandatoryLangCodeISO639_1", "en"),
        ("uniqueIdentifier", f"adis-gonio-{where.sha256[:32]}-{calibration.method}"),
        ("beginPerformanceDate", day),
        ("endPerformanceDate", where.ended_utc[:10] or day),
        ("performanceLocation", "other"),
    ):
        _add(core, name, text)
    sensors = "Accelerometers" if calibration.gyro is None else "Accelerometers and gyros"
    item = _named(_add(parent, "items"), "item", f"{sensors} of sensor {where.sensor} in a goniometer")
    if where.sensor in VARIANTS:
        _named(item, "manufacturer", "Analog Devices")
    _add(item, "model", where.sensor)
    identifications = _add(item, "identifications")
    for label, value in (("serial number", where.serial), ("SHA-256 of the samples", where.sha256)):
        one = _add(identifications, "identification")
        _add(one, "issuer", "other")
        _add(one, "value", value or NOT_STATED)
        _add(one, "name/content", label)
    _contact(_add(parent, "calibrationLaboratory/contact"), where.laboratory)
    _named(_add(parent, "respPersons/respPerson"), "person", where.operator or NOT_STATED)
    _contact(_add(parent, "customer"), where.customer)
    statements = _add(parent, "statements")
    for text in _statements(calibration):
        _named(statements, "statement", text, "declaration")


def _contact(parent: ET.Element, name: str) -> None:
    _add(parent, "name/content", name or NOT_STATED)
    _add(parent, "location/further/content", NOT_STATED)


def _statements(calibration: Calibration) -> list[str]:
    where = calibration.provenance
    unknown = [name for name in ("laboratory", "customer") if not getattr(where, name)]
    texts = [
        f"Made by a program and not signed; not stated: {', '.join([*unknown, 'country (code ZZ)'])}; "
        "no traceability is claimed beyond the declared angles of the stage.",
        "Readings are U = diag(K) D g + b: sensitivities relative to the nominal one, skews as 90° less "
        f"the angle between two axes, biases as readings without acceleration, at {calibration.holds_at}.",
    ]
    if not where.recorded_utc:
        texts.append("The date of recording is not stated; the dates are the date of issue.")
    texts += [f"{name} was not determined and is taken as nominal." for name in calibration.assumed]
    texts += [f"Not corrected: {one.effect}: {one.reason}." for one in calibration.not_corrected]
    gyro = calibration.gyro
    if gyro is not None:
        texts.append(
            "Gyros read K D ω + b + G f: zero rates b without acceleration, sensitivities relative to the "
            f"nominal one, f the readings of the accelerometers, at {gyro.holds_at}."
        )
        if gyro.assumed:
            texts.append(f"Not determined and taken as nominal: {', '.join(gyro.assumed)}.")
        texts += [f"Not corrected: {one.effect}: {one.reason}." for one in gyro.not_corrected]
        if gyro.source != where.source:
            texts.append(f"The gyros were calibrated in {gyro.source or 'a session not stated'}.")
    if calibration.covariance is None:
        texts.append("The noise of the readings is not known, so that no uncertainty is stated.")
    return texts


def _results(parent: ET.Element, calibration: Calibration) -> None:
    where = calibration.provenance
    _add(parent, "name/content", where.title or "Calibration by gravity")
    method = _named(_add(parent, "usedMethods"), "usedMethod", f"adis-gonio, method {calibration.method}")
    model = (
        "gains, misalignment and biases in the plane" if calibration.planar else "gains, skews and biases"
    )
    effects = ", ".join(term.effect.name for term in calibration.effects)
    _add(method, "description/content", f"{model}{f'; effects: {effects}' if effects else ''}")
    _software(_add(parent, "usedSoftware"), calibration)
    equipment = _add(parent, "measuringEquipments")
    _named(equipment, "measuringEquipment", where.stage or f"stage, {NOT_STATED}")
    conditions = _add(parent, "influenceConditions")
    _condition(conditions, "Local gravity", where.gravity_mps2, _PER_S2)
    if where.temperature_c is not None:
        _condition(conditions, "Temperature of the die, mean", where.temperature_c.mean, r"\degreecelsius")
    if where.supply_v is not None:
        _condition(conditions, "Supply voltage, mean", where.supply_v.mean, r"\volt")
    results = _add(parent, "results")
    _parameters(results, "Parameters", calibration.listed)
    _turn(results, calibration)
    if calibration.gyro is not None:
        _parameters(results, "Parameters of the gyros", calibration.gyro.parameters)


def _condition(parent: ET.Element, name: str, value: float, unit: str) -> None:
    data = _add(_named(parent, "influenceCondition", name), "data")
    real = _add(_named(data, "quantity", name), "real", space=SI)
    _add(real, "value", repr(float(value)), SI)
    _add(real, "unit", unit, SI)


def _label(name: str) -> str:
    """Return the description of a parameter in the certificate, with the parameter's name in brackets."""
    stem, _, axes = name.rpartition("_") if name in KIND_OF else name.partition("_")
    words = _NAMES.get(name) or (f"{_NAMES[stem]} {axes.upper()}" if stem in _NAMES else "Coefficient")
    return f"{words} ({name})"


def _parameters(parent: ET.Element, title: str, parameters: Sequence[Coefficient]) -> None:
    """Add a result with this title to `parent`: the parameters in SI units."""
    data = _add(_named(parent, "result", title), "data")
    for one in parameters:
        if one.unit not in SI_UNITS:
            raise FitError(f"{one.name} is in {one.unit}: no SI unit for the certificate is known")
        unit, factor = SI_UNITS[one.unit]
        real = _add(_named(data, "quantity", _label(one.name)), "real", space=SI)
        _add(real, "value", repr(one.value * factor), SI)
        _add(real, "unit", unit, SI)
        if one.u is not None:
            dof = math.inf if one.dof is None else one.dof
            _expanded(real, [coverage_factor(dof) * one.u * abs(factor)], dof)


def _expanded(parent: ET.Element, sizes: Sequence[float], dof: float, kind: str = "") -> None:
    """Add expanded uncertainties to `parent`. `kind` ends the names of all elements."""
    expanded = _add(parent, f"expandedUnc{kind}", space=SI)
    _add(expanded, f"uncertainty{kind}", _spaced(sizes), SI)
    _add(expanded, f"coverageFactor{kind}", f"{coverage_factor(dof):.4f}", SI)
    _add(expanded, f"coverageProbability{kind}", f"{PROBABILITY}", SI)
    _add(expanded, f"distribution{kind}", "normal" if math.isinf(dof) else "t", SI)


def _turn(parent: ET.Element, calibration: Calibration) -> None:
    """Add a result to `parent`: the expanded uncertainty of the calibrated angle, around the turn.

    The angle is the angle of gravity in the plane of x and y. Nothing is added if the calibration has no
    covariance.
    """
    if calibration.covariance is None:
        return
    curve = calibration.error_curves(stage=False)[1]
    data = _add(
        _named(parent, "result", "Angle of gravity in the plane of X and Y by the calibrated sensor"),
        "data",
    )
    listed = _add(_named(data, "quantity", "Angle"), "realListXMLList", space=SI)
    _add(listed, "valueXMLList", _spaced(_TURN_DEG), SI)
    _add(listed, "unitXMLList", r"\degree", SI)
    _expanded(listed, curve.U_deg[:: CURVE_PLACES // len(_TURN_DEG)].tolist(), curve.dof, "XMLList")


def _spaced(values: Sequence[float]) -> str:
    return " ".join(repr(value) for value in values)
