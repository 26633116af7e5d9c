"""C header: a calibration as C functions that need no library, in fixed point and in `float`."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.calibrate.calibration import Calibration, Coefficient, NotCorrected, json_text
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, GyroCalibration
from adis_gonio.handover import fixed_point
from adis_gonio.model.effects import AXES

DEFAULT_NAME = "adis_gonio"
FIXED_UDEG = 12
"""Bound in µ° of the error of a fixed-point angle at 0.5 g: CORDIC, rounded coefficients and readings."""
CHECKS = 8
RATE_CHECKS = 4
_FIELDS = {"t": "temperature", "v": "supply"}
"""Field of the C struct of a scan for each condition of the polynomials (`t`, `v`)."""
_ASCII = str.maketrans({"²": "2", "³": "3", "°": "deg", "Δ": "d", "φ": "phi", "µ": "u"})
_ASCII |= str.maketrans({"±": "+-", "−": "-", "·": "*", "θ": "theta"})


def c_header(calibration: Calibration, name: str = DEFAULT_NAME) -> str:
    """Return the text of a C header that corrects readings by a calibration.

    Parameters
    ----------
    name : str
        Prefix of every name in the header, so that one program can hold two calibrations.

    Raises
    ------
    UsageError
        The name is no identifier of C.
    FitError
        The calibration has no form for a firmware (see `polynomial_of`).
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise UsageError(f"'{name}' is no name for C: use letters, digits and _, a letter first")
    environment = Environment(
        loader=PackageLoader("adis_gonio.handover", ""),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,
    )
    return environment.get_template("header.h.jinja").render(_content(calibration, name))


def _content(calibration: Calibration, name: str) -> dict[str, Any]:
    """Return the values that the template `header.h.jinja` needs for a calibration.

    `name` is the prefix of all names in the header.
    """
    polynomial = fixed_point.polynomial_of(calibration)
    fixed = fixed_point.FixedPoint.of(polynomial)
    planes = _planes(calibration)
    needs = polynomial.needs
    where = calibration.provenance
    u_udeg = None
    if calibration.covariance is not None:
        u_udeg = int(np.ceil(calibration.error_curves(stage=False)[1].u_deg.max() * 1e6))
    gyro = calibration.gyro
    return {
        "c": _whole,
        "name": name,
        "NAME": name.upper(),
        "sensor": where.sensor,
        "planar": calibration.planar,
        "words": polynomial.words,
        "unit": calibration.unit,
        "gravity": f"{where.gravity_mps2:.6g}",
        "origin": _origin(calibration),
        "coefficients": _coefficient_lines(calibration),
        "remarks": _remarks(calibration),
        "rates": None if gyro is None else _rates_content(calibration, gyro, name),
        "needs": needs,
        "range_g": f"{fixed_point.RANGE_G:g}",
        "fixed_udeg": FIXED_UDEG,
        "cordic_udeg": fixed_point.CORDIC_UDEG,
        "float_deg": f"{fixed_point.FLOAT_DEG:g}",
        "float_udeg": round(fixed_point.FLOAT_DEG * 1e6),
        "angle_u": "The u of an angle by the calibration is not known."
        if u_udeg is None
        else f"The u of an angle by the calibration is at most {u_udeg} udeg.",
        "u_udeg": u_udeg,
        "alpha_udeg": round(calibration["alpha"].value * 1e6) if "alpha" in calibration else None,
        "id": f"0x{zlib.crc32(json_text(calibration.as_dict()).encode()):08X}UL",
        "axes": polynomial.axes,
        "letters": AXES[: polynomial.axes],
        "limit": f"{fixed_point.LIMIT}L",
        "limitf": _single(fixed_point.RANGE_G),
        "passes": fixed.passes,
        "fixed_inputs": _fixed_inputs(fixed, needs),
        "fixed_axes": [_fixed_axis(fixed, k, name) for k in range(polynomial.axes)],
        "table": [f"{step}L" for step in fixed_point.cordic_table()],
        "planes": planes,
        "float_inputs": _float_inputs(polynomial, needs),
        "float_axes": [_float_axis(polynomial, k) for k in range(polynomial.axes)],
        "tan_eighth": _single(fixed_point.TAN_EIGHTH),
        "atan": [_single(value) for value in fixed_point.ATAN],
        "degrees": _single(fixed_point.DEGREES),
        "checks": _checks(polynomial, fixed, planes[0]),
    }


def _rates_content(calibration: Calibration, gyro: GyroCalibration, name: str) -> dict[str, Any]:
    """Return the values that the template `rates.h.jinja` needs for a calibration of gyros.

    It raises `FitError` if the calibration has no form for a firmware. `name` is the prefix of all names
    in the header.
    """
    polynomial = fixed_point.rate_polynomial_of(calibration, gyro)
    fixed = fixed_point.FixedRates(polynomial)
    letters = [factor[1] for factor in polynomial.needs if factor.startswith("f")]
    step, force = fixed.step, fixed.force_step
    fixed_axes, float_axes = [], []
    names = [f"free_{axis}" for axis in AXES]
    for k, letter in enumerate(AXES):
        terms = [term for term in fixed.terms if term.monomial.axis == k]
        fixed_axes.append(
            {
                "letter": letter,
                "bias": _whole(fixed.bias[k]),
                "terms": _fixed_sum(terms, name),
                "warm": _whole(fixed.warm[k]) if fixed.warm[k] else "",
                "row": _fixed_row(fixed.matrix[k], names, name),
            }
        )
        float_axes.append(
            {
                "letter": letter,
                "bias": _single(polynomial.bias[k]),
                "terms": _float_sum([term.monomial for term in terms]),
                "warm": _single(polynomial.warm[k]) if polynomial.warm[k] else "",
                "row": _float_row(polynomial.matrix[k], names),
            }
        )
    return {
        "needs": polynomial.needs,
        "uses_scan": bool(polynomial.needs),
        "lsb": f"{GYRO_OFFSET_DPS:g}",
        "force_mask": sum(1 << AXES.index(letter) for letter in letters),
        "step": _whole(step.number),
        "shift": step.shift - fixed_point.RATE_Q,
        "limit": f"{fixed_point.RATE_LIMIT}L",
        "most": f"{2 * fixed_point.RATE_LIMIT - 1}L",
        "fixed_forces": [
            {
                "name": f"f{x}",
                "letter": x,
                "step": _whole(force.number),
                "shift": force.shift - fixed_point.Q,
            }
            for x in letters
        ],
        "fixed_inputs": _fixed_inputs(fixed.accelerometers, polynomial.needs),
        "fixed_axes": fixed_axes,
        "stepf": _single(fixed_point.STEP_DPS),
        "limitf": _single(fixed_point.LIMIT_DPS),
        "float_forces": [
            {"name": f"f{x}", "letter": x, "step": _single(polynomial.accelerometers.step_g[0])}
            for x in letters
        ],
        "float_inputs": _float_inputs(polynomial.accelerometers, polynomial.needs),
        "float_axes": float_axes,
        "fixed_udps": fixed_point.FIXED_UDPS,
        "float_udps": round(fixed_point.FLOAT_DPS * 1e6),
        "checks": _rate_checks(fixed, polynomial.accelerometers),
    }


# -- literals and comments of C ----------------------------------------------------------------------


def _whole(number: int) -> str:
    """Format an integer as a C literal: long up to 32 bits, else long long; in brackets if negative."""
    text = f"{abs(number)}{'L' if abs(number) < 2**31 else 'LL'}"
    return text if number >= 0 else f"(-{text})"


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(_whole, numbers))


def _single(value: float) -> str:
    """Format a number as a C literal of type float; nine digits reproduce it exactly."""
    text = f"{float(np.float32(value)):.9g}"
    text = f"{text}f" if any(mark in text for mark in ".e") else f"{text}.0f"
    return f"({text})" if text.startswith("-") else text


def _comment(text: str) -> str:
    """Return a text made safe for a C comment: ASCII only and without comment marks, for old compilers."""
    plain = " ".join(text.translate(_ASCII).split(" ")).replace("*/", "* /").replace("/*", "/ *")
    return "".join(c if " " <= c < "\x7f" else "?" for c in plain).replace("??", "? ?").rstrip("\\")


def _factor(factor: str) -> str:
    """Format a factor of the polynomial as a C variable, or as the absolute value of a variable."""
    letter = factor.strip("|")
    return f"({letter} < 0 ? -{letter} : {letter})" if factor.startswith("|") else factor


# -- fixed point -------------------------------------------------------------------------------------


def _fixed_inputs(fixed: fixed_point.FixedPoint, needs: Iterable[str]) -> list[dict[str, Any]]:
    found = []
    for condition in needs:
        if condition in _FIELDS:
            zero, step = getattr(fixed, _FIELDS[condition])
            scaled = {
                "zero": _whole(zero),
                "step": _whole(step.number),
                "shift": step.shift - fixed_point.Q,
            }
            found.append({"name": condition, "field": _FIELDS[condition], **scaled})
    return found


def _fixed_axis(fixed: fixed_point.FixedPoint, k: int, name: str) -> dict[str, Any]:
    own = [term for term in fixed.terms if term.monomial.axis == k]
    return {
        "letter": AXES[k],
        "step": _whole(fixed.step[k].number),
        "shift": fixed.step[k].shift - fixed_point.Q,
        "bias": _whole(fixed.bias[k]),
        "steady": _fixed_sum([term for term in own if not term.monomial.of_reading], name),
        "moving": _fixed_sum([term for term in own if term.monomial.of_reading], name),
        "row": _fixed_row(fixed.matrix[k][: k + 1], AXES, name),
    }


def _fixed_sum(terms: Sequence[fixed_point.FixedTerm], name: str) -> str:
    texts = []
    for term in terms:
        first, *rest = (_factor(factor) for factor in term.monomial.factors)
        product = f"(int64_t){first}"
        for factor in rest:
            product = f"{name}_shifted_({product} * {factor}, {fixed_point.Q})"
        own = term.coefficient
        texts.append(f"{name}_shifted_({product} * {_whole(own.number)}, {own.shift})")
    return " + ".join(texts)


def _fixed_row(entries: Sequence[fixed_point.Scaled], variables: Sequence[str], name: str) -> str:
    return " + ".join(
        f"{name}_shifted_((int64_t){variable} * {_whole(entry.number)}, {entry.shift})"
        for variable, entry in zip(variables, entries, strict=False)
        if entry.number
    )


# -- float -------------------------------------------------------------------------------------------


def _float_inputs(polynomial: fixed_point.Polynomial, needs: Iterable[str]) -> list[dict[str, Any]]:
    found = []
    for condition in needs:
        if condition in _FIELDS:
            own = getattr(polynomial, _FIELDS[condition])
            scaled = {"zero": _single(own.zero), "step": _single(own.step)}
            found.append({"name": condition, "field": _FIELDS[condition], **scaled})
    return found


def _float_axis(polynomial: fixed_point.Polynomial, k: int) -> dict[str, Any]:
    own = [one for one in polynomial.monomials if one.axis == k]
    return {
        "letter": AXES[k],
        "step": _single(polynomial.step_g[k]),
        "bias": _single(polynomial.bias[k]),
        "steady": _float_sum([one for one in own if not one.of_reading]),
        "moving": _float_sum([one for one in own if one.of_reading]),
        "row": _float_row(polynomial.matrix[k, : k + 1], AXES),
    }


def _float_sum(monomials: Sequence[fixed_point.Monomial]) -> str:
    return " + ".join(
        " * ".join([_single(one.coefficient), *map(_factor, one.factors)]) for one in monomials
    )


def _float_row(entries: Floats, variables: Sequence[str]) -> str:
    return " + ".join(
        f"{_single(float(entry))} * {variable}"
        for variable, entry in zip(variables, entries, strict=False)
        if entry != 0.0
    )


# -- comments and the self-check ---------------------------------------------------------------------


def _planes(calibration: Calibration) -> list[dict[str, Any]]:
    if calibration.planar:
        return [{"suffix": "", "said": "", "first": 0, "second": 1}]
    return [
        {
            "suffix": f"_{AXES[i]}{AXES[j]}",
            "said": f" in the plane {AXES[i]}{AXES[j]}",
            "first": i,
            "second": j,
        }
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]


def _origin(calibration: Calibration) -> list[str]:
    where, gyro = calibration.provenance, calibration.gyro
    rows = [
        ("part", where.serial),
        ("title", where.title),
        ("operator", where.operator),
        ("stage", where.stage),
        ("recorded", where.recorded_utc),
        ("file", where.source),
        ("data sha256", where.sha256),
        ("method", " + ".join([calibration.method, *(term.effect.name for term in calibration.effects)])),
        ("gyros", "" if gyro is None else f"method {gyro.method}, file {gyro.source or 'not stated'}"),
        ("made by", where.software),
    ]
    return [f"{label}: {_comment(text)}" for label, text in rows if text]


def _coefficient_lines(calibration: Calibration) -> list[str]:
    ratio, gyro = calibration.delta_k, calibration.gyro
    every: list[Coefficient] = [*([ratio] if ratio else []), *calibration.parameters]
    every += [] if gyro is None else gyro.parameters
    rows = []
    for one in every:
        u = "not known" if one.u is None else f"{one.u:.2g}"
        unit = one.unit.replace("dps", "deg/s")
        rows.append(_comment(f"{one.name:20} {one.value:<18.9g} {unit:13} {u}"))
    return rows


def _remarks(calibration: Calibration) -> list[str]:
    """Return comment lines on missing parameters, uncorrected effects, and required offset registers."""
    gyro = calibration.gyro
    rows = _missing(calibration.assumed, calibration.not_corrected)
    offsets = calibration.provenance.offsets_lsb
    if offsets is not None:
        numbers = ", ".join(map(str, offsets))
        rows.append(f"holds with {numbers} in XACCL_OFF, YACCL_OFF, ZACCL_OFF: others need a new header")
    if gyro is not None:
        rows += _missing(gyro.assumed, gyro.not_corrected)
        if gyro.offsets_lsb is not None:
            numbers = ", ".join(map(str, gyro.offsets_lsb))
            rows.append(
                f"rates hold with {numbers} in XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF: others need a new header"
            )
    return [_comment(row) for row in rows]


def _missing(assumed: Iterable[str], not_corrected: Iterable[NotCorrected]) -> list[str]:
    return [
        *(f"{name}: not determined, taken as nominal" for name in assumed),
        *(f"not corrected: {one.effect}: {one.reason}" for one in not_corrected),
    ]


def _checks(
    polynomial: fixed_point.Polynomial, fixed: fixed_point.FixedPoint, plane: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return test vectors of the header: scans at 1 g around a turn, with the angles to compute.

    The angles avoid the multiples of 45°; `plane` are the two axes. `polynomial` and `fixed` are the
    calibration in floating and fixed point.
    """
    psi = (np.arange(CHECKS) + 0.37) * 2 * np.pi / CHECKS
    g = np.zeros((CHECKS, polynomial.axes))
    g[:, 0], g[:, 1] = np.cos(psi), np.sin(psi)
    scans: fixed_point.Whole = np.rint(g / np.array(polynomial.step_g) + np.array(polynomial.bias)).astype(
        np.int64
    )
    rise = np.arange(CHECKS) - CHECKS // 2
    warm = polynomial.temperature.zero + 11 * fixed_point.PARTS * rise
    volts = polynomial.supply.zero + 9 * fixed_point.PARTS * rise
    angles = fixed.angle_udeg(scans, warm, volts, (plane["first"], plane["second"]))
    rows = []
    for k in range(CHECKS):
        numbers = [*scans[k].tolist(), *[0] * (3 - polynomial.axes), int(warm[k]), int(volts[k])]
        rows.append({"scan": _listed(numbers), "udeg": _whole(int(angles[k]))})
    return rows


def _rate_checks(fixed: fixed_point.FixedRates, of: fixed_point.Polynomial) -> list[dict[str, str]]:
    """Return test vectors of the header: gyro readings with a scan, and the corrected rates to compute.

    The turns are about every axis in both senses, at forces of 1 g and at other than nominal conditions.
    `of` is the polynomial of the accelerometers. `fixed` are the constants of the gyros in fixed point.
    """
    dps = np.array([[250.0, -31.0, 7.0], [-250.0, 90.0, -60.0], [3.0, -4.0, 270.0], [0.0, 0.0, 0.0]])
    g = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.6, -0.8], [0.5, 0.5, 0.7]])
    turns: fixed_point.Whole = np.rint(dps / fixed_point.STEP_DPS).astype(np.int64)
    scans: fixed_point.Whole = np.rint(g / of.step_g[0]).astype(np.int64)
    rise = np.arange(RATE_CHECKS) - RATE_CHECKS // 2
    warm, volts = (
        of.temperature.zero + 23 * fixed_point.PARTS * rise,
        of.supply.zero + 17 * fixed_point.PARTS * rise,
    )
    udps = fixed.rates_udps(turns, scans, warm, volts)
    return [
        {
            "turn": _listed(turns[k].tolist()),
            "scan": _listed([*scans[k].tolist(), int(warm[k]), int(volts[k])]),
            "udps": _listed(udps[k].tolist()),
        }
        for k in range(RATE_CHECKS)
    ]
