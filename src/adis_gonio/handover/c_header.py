"""C header: a calibration as C functions that need no library, in fixed point and in `float`."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import json_text
from adis_gonio.calibrate.calibration import Calibration
from adis_gonio.calibrate.gyro_calibration import GYRO_OFFSET_DPS, GyroCalibration
from adis_gonio.handover import fixed_point
from adis_gonio.handover.fixed_point import ONE, Monomial, Polynomial, Q, Scaled
from adis_gonio.model.effects import AXES
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.model.records import MG_PER_G

DEFAULT_NAME = "adis_gonio"
CHECKS = 8
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
    planes: list[dict[str, Any]] = [{"suffix": "", "clause": "", "first": 0, "second": 1}]
    if not calibration.planar:
        planes = [
            {"suffix": f"_{pair}", "clause": f" in the plane {pair}", "first": i, "second": j}
            for pair, i, j in (("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
        ]
    where, gyro = calibration.provenance, calibration.gyro
    degrees = where.temperature_c
    at = "" if degrees is None else f" at the session's mean temperature, {degrees.mean:.1f} degC"
    u_udeg = None
    if calibration.covariance is not None:
        u_udeg = int(np.ceil(calibration.error_curves(stage=False)[1].u_deg.max() * 1e6))
    return {
        "c": _whole,
        "comment": _comment,
        "single": _single,
        "numbers": fixed_point,
        "name": name,
        "NAME": name.upper(),
        "calibration": calibration,
        "polynomial": polynomial,
        "gravity": f"{where.gravity_mps2:.6g}",
        "origin": _origin(calibration),
        "coefficients": _coefficient_lines(calibration),
        "remarks": _remarks(calibration),
        "rates": None if gyro is None else _rates_content(polynomial, calibration, gyro, name),
        "angle_u": "The u of an angle by the calibration is not known."
        if u_udeg is None
        else f"The u of an angle by the calibration is at most {u_udeg} udeg{at}.",
        "u_udeg": u_udeg,
        "alpha_udeg": round(calibration["alpha"].value * 1e6) if "alpha" in calibration else None,
        "id": f"0x{zlib.crc32(json_text(calibration.as_dict()).encode()):08X}UL",
        "fixed": _Fixed(name, polynomial).body("scan"),
        "float": _Float(name, polynomial).body("scan"),
        "planes": planes,
        "checks": _checks(calibration, polynomial, planes[0]),
    }


def _rates_content(
    accelerometers: Polynomial, calibration: Calibration, gyro: GyroCalibration, name: str
) -> dict[str, Any]:
    """Return the values that the template `rates.h.jinja` needs for a calibration of gyros.

    It raises `FitError` if the calibration has no form for a firmware. `name` is the prefix of all names
    in the header.
    """
    polynomial = fixed_point.rate_polynomial_of(calibration, gyro)
    forces = [AXES.index(need[1]) for need in polynomial.needs if need.startswith("f")]
    return {
        "needs": polynomial.needs,
        "lsb": f"{GYRO_OFFSET_DPS:g}",
        "force_mask": sum(1 << k for k in forces),
        "fixed": _Fixed(name, polynomial).body("turn"),
        "float": _Float(name, polynomial).body("turn"),
        "checks": _rate_checks(gyro, accelerometers),
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


# -- expressions of C --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fixed:
    """Writes C expressions that compute a polynomial in fixed point; `name` is the prefix of all names."""

    name: str
    polynomial: Polynomial
    type: ClassVar[str] = "int32_t"

    def body(self, source: str) -> dict[str, Any]:
        """Return the values that the template's macro `corrected` needs to write the body of a C function.

        `source` is the C variable, a pointer to a structure, that has the readings.
        """
        own = self.polynomial
        axes = []
        for k, letter in enumerate(AXES[: own.axes]):
            steady, moving = (
                " + ".join(
                    self.term(term)
                    for term in own.monomials
                    if term.axis == k and term.of_reading == of_reading
                )
                for of_reading in (False, True)
            )
            axes.append(
                {
                    "letter": letter,
                    "raw": self.raw(k, f"{source}->{letter}"),
                    "free": self.less(f"raw_{letter}", steady),
                    "next": self.less(f"free_{letter}", moving),
                    "warm": self.warm(k, letter) if own.warm[k] else "",
                    "row": self.row(k),
                }
            )
        inputs = [
            {"name": need, "value": self.input(need, f"scan->{_FIELDS.get(need, need[-1])}")}
            for need in own.needs
        ]
        return {"type": self.type, "inputs": inputs, "axes": axes, "passes": own.passes}

    def _clamped(self, value: str, limit: int | None = None) -> str:
        """Return the C expression for a value within ± `limit`, by default the limit of a reading."""
        largest = int(self.polynomial.limit * (1 << self.polynomial.q)) if limit is None else limit
        return f"{self.name}_clamped_({value}, {largest}L)"

    def _times(self, value: str, factor: Scaled, q: int = 0) -> str:
        """Return the C expression for a value times a constant, with `q` more binary digits."""
        return f"{self.name}_shifted_((int64_t){value} * {_whole(factor.number)}, {factor.shift - q})"

    def input(self, need: str, source: str) -> str:
        """Return the C expression for an input of the polynomial, such as the temperature `t`.

        `need` is the name of the input, `source` the C expression for its number in the scan.
        """
        own = self.polynomial.inputs[need]
        value = f"({source} - {_whole(own.zero)})" if own.zero else source
        return self._clamped(self._times(value, Scaled.of(own.step), Q), int(own.limit * ONE))

    def raw(self, k: int, source: str) -> str:
        """Return the C expression for the reading of axis k minus its bias, from the number `source`."""
        own = self.polynomial
        scaled = self._times(source, Scaled.of(own.step[k]), own.q)
        # More than 32 bits if the zero of a sensor with counts is far away.
        bias = round(math.ldexp(own.bias[k] * own.step[k], own.q))
        return self._clamped(f"{scaled} - {_whole(bias)}")

    def term(self, term: Monomial) -> str:
        """Return the C expression for a term of the polynomial."""
        product, *rest = map(_factor, term.factors)
        for factor in rest:
            product = f"{self.name}_shifted_((int64_t){product} * {factor}, {Q})"
        # The product is in Q29; its digits are reduced to the digits of a reading.
        down = Q - self.polynomial.q
        return self._times(product, Scaled.of(term.coefficient, 62 - down), -down)

    def less(self, value: str, terms: str) -> str:
        """Return the C expression for a value minus a sum of terms; the value alone if `terms` is empty."""
        return self._clamped(f"(int64_t){value} - ({terms})") if terms else value

    def warm(self, k: int, value: str) -> str:
        """Return the C expression for a value divided by the relative gain of axis k at the temperature."""
        gain = self._times("t", Scaled(round(math.ldexp(self.polynomial.warm[k], Q)), Q))
        return self._clamped(f"(int64_t){value} * {ONE}L / ({ONE}L + {gain})")

    def row(self, k: int) -> str:
        """Return the C expression for component k of the result: row k of the matrix times the readings."""
        pairs = zip(AXES, map(Scaled.of, self.polynomial.matrix[k].tolist()), strict=False)
        return " + ".join(self._times(letter, entry) for letter, entry in pairs if entry.number)


class _Float(_Fixed):
    """Writes the C expressions that compute a polynomial in single precision (`float`)."""

    type = "float"

    def _scaled(self, source: str, zero: float, step: float, limit: float) -> str:
        value = f"((float){source} - {_single(zero)}) * {_single(step)}"
        return f"{self.name}_clampedf_({value}, {_single(limit)})"

    def input(self, need: str, source: str) -> str:
        own = self.polynomial.inputs[need]
        return self._scaled(source, own.zero, own.step, own.limit)

    def raw(self, k: int, source: str) -> str:
        own = self.polynomial
        return self._scaled(source, own.bias[k], own.step[k], own.limit)

    def term(self, term: Monomial) -> str:
        return " * ".join([_single(term.coefficient), *map(_factor, term.factors)])

    def less(self, value: str, terms: str) -> str:
        limit = _single(self.polynomial.limit)
        return f"{self.name}_clampedf_({value} - ({terms}), {limit})" if terms else value

    def warm(self, k: int, value: str) -> str:
        return f"{value} / (1.0f + t * {_single(self.polynomial.warm[k])})"

    def row(self, k: int) -> str:
        pairs = zip(AXES, self.polynomial.matrix[k].tolist(), strict=False)
        return " + ".join(f"{_single(entry)} * {letter}" for letter, entry in pairs if entry != 0.0)


# -- comments and the self-check ---------------------------------------------------------------------


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
    gyro, rows = calibration.gyro, []
    for one in (*calibration.listed, *(() if gyro is None else gyro.parameters)):
        u = "not known" if one.u is None else f"{one.u:.2g}"
        unit = one.unit.replace("dps", "deg/s")
        rows.append(_comment(f"{one.name:20} {one.value:<18.9g} {unit:13} {u}"))
    return rows


def _remarks(calibration: Calibration) -> list[str]:
    """Return comment lines on missing parameters, uncorrected effects, and required offset registers."""
    where, gyro = calibration.provenance, calibration.gyro
    parts: list[tuple[str, Calibration | GyroCalibration, Sequence[int] | None, str]] = [
        ("holds", calibration, where.offsets_lsb, "ACCL_OFF")
    ]
    if gyro is not None:
        parts.append(("rates hold", gyro, gyro.offsets_lsb, "GYRO_OFF"))
    rows = []
    for hold, part, offsets, register in parts:
        rows += [f"{name}: not determined, taken as nominal" for name in part.assumed]
        rows += [f"not corrected: {one.effect}: {one.reason}" for one in part.not_corrected]
        if offsets is not None:
            contents = f"{', '.join(map(str, offsets))} in X{register}, Y{register}, Z{register}"
            rows.append(f"{hold} with {contents}: others need a new header")
    return [_comment(row) for row in rows]


def _checks(
    calibration: Calibration, polynomial: Polynomial, plane: dict[str, Any]
) -> list[dict[str, str]]:
    """Return test vectors for the header: scans at 1 g around a turn, with their angles by the calibration.

    The angles avoid the multiples of 45°. `plane` has the numbers of the two axes as `first` and `second`.
    """
    psi = (np.arange(CHECKS) + 0.37) * 2 * np.pi / CHECKS
    g = np.zeros((CHECKS, polynomial.axes))
    g[:, 0], g[:, 1] = np.cos(psi), np.sin(psi)
    scans = np.rint(g / polynomial.step + np.array(polynomial.bias)).astype(np.int64)
    around, temperature_c, supply_v = _surroundings(polynomial, CHECKS, 11, 9)
    readings = scans * np.array(polynomial.step) * MG_PER_G * calibration.per_mg
    gravity = calibration.apply(readings, temperature_c, supply_v=supply_v)
    angles_deg = np.degrees(np.arctan2(gravity[:, plane["second"]], gravity[:, plane["first"]]))
    return [
        {
            "scan": _listed([*scan, *[0] * (3 - polynomial.axes), *others]),
            "udeg": _whole(round(1e6 * angle)),
        }
        for scan, others, angle in zip(scans.tolist(), around.tolist(), angles_deg.tolist(), strict=True)
    ]


def _rate_checks(gyro: GyroCalibration, accelerometers: Polynomial) -> list[dict[str, str]]:
    """Return test vectors for the header: readings of all sensors, with their rates by the calibration.

    The turns are about every axis in both senses, at forces of about 1 g; temperature and supply voltage
    differ from 25 °C and 5 V.
    """
    dps = np.array([[250.0, -31.0, 7.0], [-250.0, 90.0, -60.0], [3.0, -4.0, 270.0], [0.0, 0.0, 0.0]])
    g = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.6, -0.8], [0.5, 0.5, 0.7]])
    step = accelerometers.step[0]
    turns = np.rint(dps / fixed_point.STEP_DPS).astype(np.int64)
    scans = np.rint(g / step).astype(np.int64)
    around, temperature_c, supply_v = _surroundings(accelerometers, len(dps), 23, 17)
    rates = gyro.correct(turns * fixed_point.STEP_DPS, scans * step, temperature_c, supply_v=supply_v)
    udps = np.rint(1e6 * rates).astype(np.int64)
    return [
        {"turn": _listed(turn), "scan": _listed([*scan, *others]), "udps": _listed(rate)}
        for turn, scan, others, rate in zip(
            turns.tolist(), scans.tolist(), around.tolist(), udps.tolist(), strict=True
        )
    ]


def _surroundings(
    polynomial: Polynomial, count: int, degrees: int, volts: int
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Return readings (count, 2) of thermometer and voltmeter for test vectors, rising in equal steps.

    The readings are integers in 1/256 LSB; `degrees` and `volts` are the steps in LSB of the sensor. The
    middle reading is 25 °C and 5 V. The second and third result are the temperatures (count,) in °C and
    the supply voltages (count,) in V.
    """
    rise = fixed_point.PARTS * (np.arange(count, dtype=np.float64) - count // 2)
    t, v = (polynomial.inputs[name] for name in ("t", "v"))
    readings = np.stack([t.zero + degrees * rise, v.zero + volts * rise], axis=1).astype(np.int64)
    temperature_c = REFERENCE_C + fixed_point.SPAN_C * t.step * degrees * rise
    return readings, temperature_c, REFERENCE_V + fixed_point.SPAN_V * v.step * volts * rise
