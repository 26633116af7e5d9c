"""The C header: a calibration as functions without a library, in fixed point and in `float`."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.coefficients import json_text
from adis_gonio.handover.c_rates import of_gyros, rate_remarks, rate_rows, rates_content
from adis_gonio.handover.fixed import (
    CORDIC_UDEG,
    LIMIT,
    FixedPoint,
    FixedTerm,
    Q,
    Whole,
    cordic_table,
)
from adis_gonio.handover.literals import comment, factor_text, shift_text, single, whole
from adis_gonio.handover.polynomial import PARTS, RANGE_G, Monomial, Polynomial, polynomial_of
from adis_gonio.handover.single import ATAN, DEGREES, FLOAT_DEG, TAN_EIGHTH
from adis_gonio.model.effects import AXES

DEFAULT_NAME = "adis_gonio"
FIXED_UDEG = 12
"""Bound of the fixed point's error in an angle: CORDIC, and coefficients and readings rounded at 0.5 g."""
CHECKS = 8


def c_header(calibration: Calibration, name: str = DEFAULT_NAME) -> str:
    """Text of the header.

    Parameters
    ----------
    name : str
        What every name in it begins with, so that two calibrations can stand in one program.

    Raises
    ------
    UsageError
        The name is no identifier of C.
    FitError
        As `polynomial_of`.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise UsageError(f"'{name}' is no name for C: use letters, digits and _, a letter first")
    loader = PackageLoader("adis_gonio.handover", "")
    environment = Environment(
        loader=loader,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,
    )
    return environment.get_template("header.h.jinja").render(_content(calibration, name))


def _content(calibration: Calibration, name: str) -> dict[str, Any]:
    polynomial = polynomial_of(calibration)
    fixed = FixedPoint.of(polynomial)
    planes = _planes(calibration)
    letters = AXES[: polynomial.axes]
    needs = polynomial.needs
    where = calibration.provenance
    alpha = round(calibration["alpha"].value * 1e6) if "alpha" in calibration else None
    u_udeg = _largest_u(calibration)
    inputs = [("t", "temperature"), ("v", "supply")]
    gyro = calibration.gyro
    return {
        "c": whole,
        "name": name,
        "NAME": name.upper(),
        "sensor": where.sensor,
        "planar": calibration.planar,
        "words": polynomial.words,
        "unit": calibration.unit,
        "gravity": f"{where.gravity_mps2:.6g}",
        "origin": _origin(calibration),
        "coefficients": [*_table(calibration), *([] if gyro is None else rate_rows(gyro))],
        "remarks": [*_remarks(calibration), *([] if gyro is None else rate_remarks(gyro))],
        "rates": None if gyro is None else rates_content(calibration, gyro, name),
        "needs": needs,
        "range_g": f"{RANGE_G:g}",
        "fixed_udeg": FIXED_UDEG,
        "cordic_udeg": CORDIC_UDEG,
        "float_deg": f"{FLOAT_DEG:g}",
        "float_udeg": round(FLOAT_DEG * 1e6),
        "angle_u": "What the calibration lends to an angle is not known."
        if u_udeg is None
        else f"The calibration lends it {u_udeg} udeg (u) at most.",
        "u_udeg": u_udeg,
        "alpha_udeg": alpha,
        "id": f"0x{zlib.crc32(json_text(calibration.as_dict()).encode()):08X}UL",
        "axes": polynomial.axes,
        "letters": letters,
        "limit": f"{LIMIT}L",
        "limitf": single(RANGE_G),
        "passes": fixed.passes,
        "fixed_inputs": [_fixed_input(fixed, c, field) for c, field in inputs if c in needs],
        "fixed_axes": [_fixed_axis(fixed, k, name) for k in range(polynomial.axes)],
        "table": [f"{step}L" for step in cordic_table()],
        "planes": planes,
        "float_inputs": [_float_input(polynomial, c, field) for c, field in inputs if c in needs],
        "float_axes": [_float_axis(polynomial, k) for k in range(polynomial.axes)],
        "tan_eighth": single(TAN_EIGHTH),
        "atan": [single(value) for value in ATAN],
        "degrees": single(DEGREES),
        "checks": _checks(polynomial, fixed, planes[0]),
    }


# -- fixed point -------------------------------------------------------------------------------------


def _fixed_input(fixed: FixedPoint, condition: str, field: str) -> dict[str, Any]:
    zero, step = fixed.temperature if condition == "t" else fixed.supply
    return {
        "name": condition,
        "field": field,
        "zero": whole(zero),
        "step": whole(step.number),
        "shift": step.shift - Q,
    }


def _fixed_axis(fixed: FixedPoint, k: int, name: str) -> dict[str, Any]:
    own = [term for term in fixed.terms if term.monomial.axis == k]
    row = [
        shift_text(f"(int64_t){AXES[j]} * {whole(entry.number)}", entry.shift, name)
        for j, entry in enumerate(fixed.matrix[k][: k + 1])
        if entry.number
    ]
    return {
        "letter": AXES[k],
        "step": whole(fixed.step[k].number),
        "shift": fixed.step[k].shift - Q,
        "bias": whole(fixed.bias[k]),
        "steady": _fixed_sum([term for term in own if not term.monomial.of_reading], name),
        "moving": _fixed_sum([term for term in own if term.monomial.of_reading], name),
        "row": " + ".join(row),
    }


def _fixed_sum(terms: Sequence[FixedTerm], name: str) -> str:
    texts = []
    for term in terms:
        first, *rest = (factor_text(factor) for factor in term.monomial.factors)
        product = f"(int64_t){first}"
        for factor in rest:
            product = f"{name}_shifted_({product} * {factor}, {Q})"
        texts.append(
            shift_text(f"{product} * {whole(term.coefficient.number)}", term.coefficient.shift, name)
        )
    return " + ".join(texts)


# -- float -------------------------------------------------------------------------------------------


def _float_input(polynomial: Polynomial, condition: str, field: str) -> dict[str, Any]:
    own = polynomial.temperature if condition == "t" else polynomial.supply
    return {"name": condition, "field": field, "zero": single(own.zero), "step": single(own.step)}


def _float_axis(polynomial: Polynomial, k: int) -> dict[str, Any]:
    own = [one for one in polynomial.monomials if one.axis == k]
    entries = [(AXES[j], float(polynomial.matrix[k, j])) for j in range(k + 1)]
    return {
        "letter": AXES[k],
        "step": single(polynomial.step_g[k]),
        "bias": single(polynomial.bias[k]),
        "steady": _float_sum([one for one in own if not one.of_reading]),
        "moving": _float_sum([one for one in own if one.of_reading]),
        "row": " + ".join(f"{single(entry)} * {letter}" for letter, entry in entries if entry != 0.0),
    }


def _float_sum(monomials: Sequence[Monomial]) -> str:
    return " + ".join(
        " * ".join([single(one.coefficient), *(factor_text(factor) for factor in one.factors)])
        for one in monomials
    )


# -- comments and the self-check ---------------------------------------------------------------------


def _planes(calibration: Calibration) -> list[dict[str, Any]]:
    if calibration.planar:
        return [{"suffix": "", "said": "", "first": 0, "second": 1}]
    pairs = ((0, 1), (0, 2), (1, 2))
    return [
        {
            "suffix": f"_{AXES[i]}{AXES[j]}",
            "said": f" in the plane {AXES[i]}{AXES[j]}",
            "first": i,
            "second": j,
        }
        for i, j in pairs
    ]


def _origin(calibration: Calibration) -> list[str]:
    where = calibration.provenance
    told = [
        ("part", where.serial),
        ("title", where.title),
        ("operator", where.operator),
        ("stage", where.stage),
        ("recorded", where.recorded_utc),
        ("file", where.source),
        ("data sha256", where.sha256),
        ("method", " + ".join([calibration.method, *(term.effect.name for term in calibration.effects)])),
        ("gyros", "" if calibration.gyro is None else of_gyros(calibration.gyro)),
        ("made by", where.software),
    ]
    return [f"{label}: {comment(text)}" for label, text in told if text]


def _table(calibration: Calibration) -> list[str]:
    ratio = calibration.delta_k
    rows = []
    for one in (*([ratio] if ratio else []), *calibration.parameters):
        u = "not known" if one.u is None else f"{one.u:.2g}"
        rows.append(comment(f"{one.name:20} {one.value:<18.9g} {one.unit:13} {u}"))
    return rows


def _remarks(calibration: Calibration) -> list[str]:
    rows = [f"{name}: not determined, taken as nominal" for name in calibration.assumed]
    rows += [f"not corrected: {one.effect}: {one.reason}" for one in calibration.not_corrected]
    offsets = calibration.provenance.offsets_lsb
    if offsets is not None:
        held = ", ".join(map(str, offsets))
        rows.append(
            f"holds with {held} in XACCL_OFF, YACCL_OFF, ZACCL_OFF: a part with others needs a new header"
        )
    return [comment(row) for row in rows]


def _sweep(polynomial: Polynomial, n: int) -> Whole:
    """Scans (n, axes) round a turn at 1 g, beside the multiples of 45°."""
    psi = (np.arange(n) + 0.37) * 2 * np.pi / n
    g = np.zeros((n, polynomial.axes))
    g[:, 0], g[:, 1] = np.cos(psi), np.sin(psi)
    scans: Whole = np.rint(g / np.array(polynomial.step_g) + np.array(polynomial.bias)).astype(np.int64)
    return scans


def _checks(polynomial: Polynomial, fixed: FixedPoint, plane: dict[str, Any]) -> list[dict[str, Any]]:
    scans = _sweep(polynomial, CHECKS)
    rise = np.arange(CHECKS) - CHECKS // 2
    warm = polynomial.temperature.zero + 11 * PARTS * rise
    volts = polynomial.supply.zero + 9 * PARTS * rise
    angles = fixed.angle_udeg(scans, warm, volts, (plane["first"], plane["second"]))
    rows = []
    for k in range(CHECKS):
        numbers = [*scans[k].tolist(), *[0] * (3 - polynomial.axes), int(warm[k]), int(volts[k])]
        rows.append({"scan": ", ".join(map(whole, numbers)), "udeg": whole(int(angles[k]))})
    return rows


def _largest_u(calibration: Calibration) -> int | None:
    """Largest u of an angle round the turn, in µ°; None where it is not known."""
    psi = np.radians(np.arange(0.0, 360.0, 5.0))
    gravity = np.zeros((len(psi), calibration.axes))
    gravity[:, 0], gravity[:, 1] = np.cos(psi), np.sin(psi)
    u = calibration.angle(calibration.readings_of(gravity), plane="xy").u_deg
    return None if not np.isfinite(u).all() else int(np.ceil(u.max() * 1e6))
