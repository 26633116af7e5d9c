"""Plans of positions, and the readings to expect at a position.

Plans: the positions of a session, their order and their use.

| plan | positions | reason |
|---|---|---|
| `two-position` | 0°, 90° | the paper's; determines ΔK and Δφ, but no bias |
| `four-position` | 0°, 90°, 180°, 270° | opposite positions cancel a bias |
| `mmpm` | nine, every 40° | all six planar parameters, with the largest information of nine positions |
| `tumble` | n up and n back (12) | the way back shows backlash, hysteresis and drift |
| `poses` | n free attitudes in space (14) | bias, scale and skew of all three axes; needs no stage |

Why steps of 40° for nine positions: readings of a turn are a first-order trigonometric regression, for
which equally spaced angles over the full circle are D-optimal. The information of all six planar parameters
(start angle, two gains, Δφ, two biases) then does not depend on the start angle. Nine angles in steps of
45° would repeat one angle, and a quarter turn is worse by orders of magnitude (a test computes the
determinants). An odd number separates the harmonics of the residual up to the fourth (n harmonics need 2n +
1 positions).

Readings: the expected angle of gravity at a position, and its largest deviation for a good sensor.

The angle of a reading is φ = atan2(U_y, U_x) = α − θ + the effects of gains, misalignment and biases. These
are unknown when a session begins, but the sensor's data sheet limits each of them. The unknowns are
estimated by a linear Gaussian model, dwell by dwell. At the first positions the limits of the data sheet
determine the allowed deviation; later the dwells have shown the gains and biases, and the fixture
determines it.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.base.errors import DataError, UsageError, suggest
from adis_gonio.base.jsonable import OPTIONAL, JsonRecord, finite, json_value
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in, write_text
from adis_gonio.base.shapes import ShapeError, anything, choice, fields, list_of, number, shown, text
from adis_gonio.base.uncertainty import POSITION_QUESTIONED
from adis_gonio.model.records import Plane, Use
from adis_gonio.record.stillness import SHIFT_MG

Approach = Literal[-1, 0, 1]

MOST_POSITIONS = 3600
"""Largest number of positions of a plan."""
GYRO_TURNS = "gyro-turns"
"""Name of the plan of whole turns about the vertical on a table (`gyro_turns`)."""
DEFAULT_PLAN = "two-position"


class Position(JsonRecord):
    """One position of a plan: its angle or direction, approach and use.

    Attributes
    ----------
    angle_deg : float or None
        Angle of the stage to declare, positive for the rotation of the paper's equation 6; None for a free
        attitude.
    approach : {1, -1, 0}
        Direction of travel in which the angle is reached; 0 for a free attitude.
    use : {"fit", "check"}
        `check` positions are kept out of every fit.
    direction : tuple of 3 float or None
        For a free attitude: the reading of an ideal sensor there, in units of G. It is a suggestion that a
        stage can follow if it turns in space; fits do not use it.
    wait_s : float
        Additional wait at the position before the dwell, in s.
    turned_deg : float or None
        Turn of the sensor about the vertical on the way to this position, exact by a mark or a stop;
        positive counter-clockwise seen from above. None if the way does not matter.
    """

    angle_deg: float | None
    approach: Approach = 1
    use: Use = "fit"
    direction: tuple[float, float, float] | None = None
    wait_s: float = 0.0
    turned_deg: float | None = field(default=None, metadata=OPTIONAL)

    def __str__(self) -> str:
        if self.turned_deg is not None:
            way = "counter-clockwise" if self.turned_deg > 0 else "clockwise"
            return f"{counted(round(abs(self.turned_deg) / 360), 'turn')} {way}"
        place = "a new attitude" if self.angle_deg is None else f"{self.angle_deg:g}°"
        way = {1: "", 0: "", -1: " from above"}[self.approach]
        return f"{place}{way}{' (check)' if self.use == 'check' else ''}"


class Plan(JsonRecord):
    """A plan: the positions of a session in the order in which they are visited.

    Attributes
    ----------
    name : str
        Name of the plan, such as `tumble`.
    positions : tuple of Position
        Positions in the order of the visits.
    plane : {"xy", "none"}
        Plane in which the sensor turns; "none" for attitudes anywhere in space.
    turns : int
        Number of full turns of a continuous recording; 0 for a plan of positions.
    """

    document_keys = ("name", "plane", "positions", "turns")

    name: str
    positions: tuple[Position, ...]
    plane: Plane = "xy"
    turns: int = field(default=0, metadata=OPTIONAL)

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Plan:
        """Create a plan from its JSON form, which `as_dict` returns."""
        positions = []
        for entry in data["positions"]:
            way = entry["direction"]
            positions.append(Position(**{**entry, "direction": None if way is None else tuple(way)}))
        return cls(data["name"], tuple(positions), data["plane"], data.get("turns", 0))


_FIXED = {"two-position": 2, "four-position": 4}
_KINDS = {name: (count, count) for name, count in _FIXED.items()}
_KINDS |= {"mmpm": (9, 9), "tumble": (12, 3), "poses": (14, 9)}
"""Usual and smallest number of positions of each built-in plan; plans in `_FIXED` allow no other number."""

PLAN_NAMES: tuple[str, ...] = tuple(_KINDS)
"""Names of the built-in plans, which `plan` creates."""


def plan(name: str = DEFAULT_PLAN, positions: int | None = None, check: int = 0) -> Plan:
    """Create a built-in plan by its name.

    Parameters
    ----------
    name : str
        One of `PLAN_NAMES`.
    positions : int or None
        Number of angles (`tumble` visits each twice); None for the plan's default, which is fixed for the
        two- and the four-position plan.
    check : int
        Number of check positions (kept out of every fit) to insert between the others. They are spread over
        the session: at its end a drift would make them extrapolations.

    Raises
    ------
    UsageError
        There is no such plan, or it does not allow this number of positions.
    """
    if name == "free-turn":
        raise UsageError("a free turn has no positions: calibrate URL --plan free-turn records it")
    if name == GYRO_TURNS:
        raise UsageError("gyro turns have no positions: calibrate URL --plan gyro-turns --turns N")
    if name not in _KINDS:
        known = suggest(name, (*_KINDS, "free-turn", GYRO_TURNS, "or a plan file (.json)"))
        raise UsageError(f"no plan is called '{name}'; {known}")
    usual, least = _KINDS[name]
    count = usual if positions is None else positions
    if count != _FIXED.get(name, count):
        raise UsageError(
            f"plan '{name}' has {counted(usual, 'position')}, not {count}; mmpm and tumble take any"
        )
    if not least <= count <= MOST_POSITIONS:
        raise UsageError(f"plan '{name}' takes {least} to {MOST_POSITIONS} positions, not {count}")
    _refuse_checks(check)
    if name == "poses":
        return Plan(name, _poses(count, check), "none")
    if name == "two-position":
        return Plan(name, _with_checks([Position(0.0), Position(90.0)], check))
    turn = [Position(360.0 * k / count) for k in range(count)]
    if name == "tumble":
        turn += [replace(position, approach=-1) for position in reversed(turn)]
    return Plan(name, _with_checks(turn, check))


def _poses(count: int, check: int) -> tuple[Position, ...]:
    """Return attitudes spread evenly over the sphere, on a spiral with the golden angle."""
    uses: list[Use] = ["fit"] * count
    # Insert from the end, so that the earlier indices stay valid.
    for k in reversed(range(check)):
        uses.insert(math.ceil((k + 1) * count / (check + 1)), "check")
    golden, poses = math.pi * (3.0 - math.sqrt(5.0)), []
    for k, use in enumerate(uses):
        z = 1.0 - (2 * k + 1) / len(uses)
        radius = math.sqrt(1.0 - z * z)
        vector = (radius * math.cos(golden * k), radius * math.sin(golden * k), z)
        poses.append(Position(None, 0, use, vector))
    return tuple(poses)


def _refuse_checks(check: int) -> None:
    if not 0 <= check <= MOST_POSITIONS:
        raise UsageError(f"a plan takes 0 to {MOST_POSITIONS} check positions, not {check}")


def _with_checks(fit: list[Position], check: int) -> tuple[Position, ...]:
    """Insert `check` check positions, spread evenly over the gaps between positions of use `fit`.

    A check position is approached in the direction in which the stage moves from the position before it to
    the position after it.
    """
    gaps = [
        k for k, (here, there) in enumerate(itertools.pairwise(fit)) if here.angle_deg != there.angle_deg
    ]
    inserted = [0] * len(fit)
    for k in range(check):
        # Divide the gaps into equal parts and use their middles: one check goes to the middle gap.
        inserted[gaps[int((k + 0.5) * len(gaps) / check)]] += 1
    result: list[Position] = []
    for k, position in enumerate(fit):
        result.append(position)
        for j in range(inserted[k]):
            here, there = fit[k].angle_deg or 0.0, fit[k + 1].angle_deg or 0.0
            angle = here + (there - here) * (j + 1) / (inserted[k] + 1)
            result.append(Position(angle, 1 if there > here else -1, "check"))
    return tuple(result)


def blindness(plan: Plan, bias_mg: float, gravity_mg: float = 1000.0) -> float | None:
    """Return u of ΔK (unit 1), and of Δφ in rad, from a bias of each axis that a plan cannot determine.

    Returns None for plans that separate the bias: with three or more different angles, or with free
    attitudes.

    At two positions, the two readings of X are a vector (U_x1, U_x2). With the start angle α and gravity G,
    a bias b_x turns this vector by b_x (cos α - sin α)/G and lengthens it by b_x (cos α + sin α)/G; b_y
    turns and lengthens the vector of Y with the two factors exchanged. For equal, independent biases of
    standard deviation b the squares add up to 2 whatever α is: u(Δφ) = √2 b/G rad and u(ΔK) = √2 b/G.

    Parameters
    ----------
    bias_mg : float
        Standard deviation of the bias that an axis may have, in mg.
    gravity_mg : float
        Local gravity in mg.
    """
    angles = [position.angle_deg for position in plan.positions if position.use == "fit"]
    separate = {round((angle or 0.0) % 360.0, 6) for angle in angles}
    # Three separate angles separate the bias of an axis from its direction.
    if any(angle is None for angle in angles) or len(separate) >= 3:
        return None
    return math.sqrt(2.0) * bias_mg / gravity_mg


def describe_direction(direction: Sequence[float]) -> str:
    """Describe a direction of gravity by the axes with a large component, such as `reads +x −z`.

    `direction` is the reading of an ideal sensor in units of G.
    """
    axes = [f"{'+' if part > 0 else '−'}{'xyz'[k]}" for k, part in enumerate(direction) if abs(part) > 0.3]
    return f"reads {' '.join(axes)}"


def extension(plan: Plan, done: int) -> Plan | None:
    """Return a plan that continues a finished two-position plan and determines the biases, or None.

    Parameters
    ----------
    plan : Plan
        Current plan.
    done : int
        Number of its positions that have a dwell.

    Returns
    -------
    Plan or None
        For a completed two-position plan, the four-position plan that begins with its positions; None for
        any other plan or if dwells are missing.
    """
    if plan.name != "two-position" or done < len(plan):
        return None
    return Plan("four-position", (*plan.positions, Position(180.0), Position(270.0)), plan.plane)


# -- plan files: JSON with a version ------------------------------------------------------------------

SCHEMA = "adis-gonio/plan"
VERSION = 1
LARGEST_BYTES = 10_000_000
LARGEST_DEG = 3600.0
LONGEST_WAIT_S = 86_400.0
_ENTRY = fields(
    {"angle_deg": number(-LARGEST_DEG, LARGEST_DEG)},
    {"approach": choice(1, -1), "use": choice("fit", "check"), "wait_s": number(0.0, LONGEST_WAIT_S)},
)
_DOCUMENT = fields(
    {"name": text, "plane": choice("xy"), "positions": list_of(_ENTRY, 2, MOST_POSITIONS)},
    {"schema": anything, "version": anything, "made_for": anything},
)


def document_of(made: Plan, made_for: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the JSON document that a plan file contains.

    Parameters
    ----------
    made : Plan
        The plan to write.
    made_for : mapping, optional
        Facts for people about the search that found the plan; the program does not read them.
    """
    names = ("angle_deg", "approach", "use", "wait_s")
    document = {
        "schema": SCHEMA,
        "version": VERSION,
        "name": made.name,
        "plane": made.plane,
        "positions": [{name: getattr(position, name) for name in names} for position in made.positions],
    }
    return document if made_for is None else {**document, "made_for": finite(made_for)}


def write_plan(path: str | Path, made: Plan, made_for: Mapping[str, Any] | None = None) -> None:
    """Write a plan to a JSON file.

    `made_for` are facts for people about the search that found the plan; None writes none.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    content = json.dumps(document_of(made, made_for), ensure_ascii=False, indent=1, allow_nan=False)
    write_text(path, f"{content}\n")


def read_plan(path: str | Path) -> Plan:
    """Read a plan from a JSON file.

    Raises
    ------
    DataError
        The file cannot be read or is no plan; the message names the file and the field.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_BYTES:
            raise DataError(f"{path}: is no plan: it has more than {LARGEST_BYTES // 1_000_000} MB")
        content = path.read_text(encoding="utf-8-sig")
        document = json_value(content, object_pairs_hook=_unique_fields, parse_constant=float)
    except ShapeError as error:
        raise DataError(f"{path}: {error} is given twice: remove one of them") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from None
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: is no plan: no JSON at line {error.lineno}") from None
    except ValueError as error:
        raise DataError(f"{path}: is no plan: {error}") from None
    return plan_from(document, str(path))


def _unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ShapeError(shown(twice))
    return dict(pairs)


def plan_from(document: Any, name: str = "plan") -> Plan:
    """Convert a JSON document to a plan; error messages begin with `name`.

    Raises
    ------
    DataError
        The document is no plan, has a newer version, or a field with an impossible value.
    """
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise DataError(f"{name}: schema is not '{SCHEMA}'; make a plan with adis-gonio plan -o NAME.json")
    version = document.get("version")
    if isinstance(version, bool) or version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        cure = "update adis-gonio" if newer else f"take {VERSION}"
        raise DataError(f"{name}: version is {shown(version)}, this program reads {VERSION}: {cure}")
    try:
        _DOCUMENT(document)
    except ShapeError as error:
        raise DataError(f"{name}: {str(error).lstrip(' .')}") from None
    called = document["name"]
    if not re.fullmatch(r"[\w.+-]{1,60}", called):
        raise DataError(f"{name}: name is {shown(called)}: take a word of letters, digits and . + - _")
    if called in PLAN_NAMES:
        raise DataError(f"{name}: name is '{called}', which is a plan of the program: take another")
    positions = tuple(
        Position(**{**entry, "angle_deg": float(entry["angle_deg"])}) for entry in document["positions"]
    )
    if all(position.use == "check" for position in positions):
        raise DataError(f"{name}: positions are all for checking: at least two have to be of use 'fit'")
    return Plan(called, positions)


def find_plan(name: str, positions: int | None = None, check: int = 0) -> Plan:
    """Return a built-in plan by its name; if `name` looks like a path, read the plan from this file.

    Parameters
    ----------
    positions : int or None
        Number of angles of a built-in plan, None for its default; must be None for a file.
    check : int
        Number of check positions to insert between the others.

    Raises
    ------
    DataError
        The file is no plan.
    UsageError
        The plan is unknown, or does not allow this number.
    """
    if name in PLAN_NAMES or not (ends_in(name, ".json") or "/" in name or Path(name).is_file()):
        return plan(name, positions, check)
    made = read_plan(name)
    if positions is not None:
        raise UsageError(f"{name}: fixes {counted(len(made), 'position')}: leave --positions out")
    _refuse_checks(check)
    return replace(made, positions=_with_checks(list(made.positions), check)) if check else made


K = NormalDist().inv_cdf(1 - POSITION_QUESTIONED / 2)
"""Deviation of an angle, in standard uncertainties, above which a position is reported as doubtful."""

GAIN_LIMIT = 0.02
"""Limit of the relative error of a gain: ±2 % (rectangular distribution), by the ADIS16350's data sheet."""
ANGLE_LIMIT_DEG = 0.25 + 0.5
"""Limit of Δφ in degrees: non-orthogonality ±0.25° and axis to frame ±0.5° (ADIS16350's data sheet)."""
UNMODELLED_MG = SHIFT_MG / math.sqrt(3)
"""Standard uncertainty in mg of a reading from effects outside this model.

It is the rectangular distribution of the largest shift (`SHIFT_MG`) that the stillness watch allows.
"""
UNSTATED_FIXTURE_DEG = 0.5
"""Standard uncertainty in degrees assumed for a fixture that states none: half a division of a scale."""
_RECTANGULAR = 1 / math.sqrt(3)


@dataclass(frozen=True)
class PriorKnowledge:
    """Uncertainties of a sensor and its fixture that are known before the first measurement.

    Attributes
    ----------
    bias_mg : float
        Standard deviation of the bias of an axis in mg.
    reading_mg : float
        Standard uncertainty of the mean of a window of samples in mg.
    fixture_deg : float or None
        Standard uncertainty of a stage angle in degrees; None if it is not stated.
    gravity_mg : float
        Local gravity in mg.
    """

    bias_mg: float
    reading_mg: float
    fixture_deg: float | None
    gravity_mg: float = 1000.0


@dataclass(frozen=True)
class Off:
    """Deviation of the angle that a reading of gravity shows from the requested angle, with its limit.

    Attributes
    ----------
    off_deg : float
        Angle shown by gravity minus the requested angle, within ±180°; positive in the sense in which the
        stage counts its angles.
    limit_deg : float
        Largest deviation of a good sensor in this fixture; infinite if it is not known yet.
    """

    off_deg: float
    limit_deg: float

    @property
    def allowed(self) -> bool:
        """True if the deviation is not larger than the limit."""
        return abs(self.off_deg) <= self.limit_deg


class Expectation:
    """Model of a turn in the plane, updated dwell by dwell: start angle, two gains, Δφ, two biases.

    Parameters
    ----------
    spread : PriorKnowledge
        Uncertainties before the first dwell.
    sense : {1, -1}
        1 if the stage counts angles like the plan, −1 if it counts in the opposite direction.
    """

    def __init__(self, spread: PriorKnowledge, sense: int = 1) -> None:
        self.sense = sense
        gravity = spread.gravity_mg
        gain, bias = GAIN_LIMIT * _RECTANGULAR, spread.bias_mg / gravity
        skew = math.radians(ANGLE_LIMIT_DEG) * _RECTANGULAR
        fixture = UNSTATED_FIXTURE_DEG if spread.fixture_deg is None else spread.fixture_deg
        self._reading = math.hypot(spread.reading_mg, UNMODELLED_MG) / gravity
        self._angle = math.hypot(self._reading, math.radians(fixture))
        self._information = np.diag([0.0, gain**-2, gain**-2, skew**-2, bias**-2, bias**-2])
        self._weighted = np.zeros(6)
        self._gravity = gravity
        self._start_rad: float | None = None

    @property
    def begun(self) -> bool:
        """True after the first dwell, from which the start angle is known."""
        return self._start_rad is not None

    def add(self, accel_mg: Floats, angle_deg: float) -> None:
        """Update the model by a dwell: its mean reading (x, y and perhaps z) in mg, at a stage angle."""
        phi, log_norm = self._polar(accel_mg)
        seen = phi + self.sense * math.radians(angle_deg)
        if self._start_rad is None:
            self._start_rad = seen
        # Two observations for each dwell: the angle, and the logarithm of the length of the reading.
        rest = wrap_radians(seen - self._start_rad)
        c, s = math.cos(phi), math.sin(phi)
        norm_row = np.array([0.0, c * c, s * s, s * c, c, s])
        for row, value, u in (
            (_angle_row(phi), rest, self._angle),
            (norm_row, log_norm, self._reading),
        ):
            self._information += np.outer(row, row) / u**2
            self._weighted += row * value / u**2

    def off(self, accel_mg: Floats, angle_deg: float) -> Off:
        """Return the deviation of the angle that a reading in mg shows from the requested stage angle.

        Before the first dwell the deviation is 0 and its limit infinite.
        """
        if self._start_rad is None:
            return Off(0.0, math.inf)
        phi, _ = self._polar(accel_mg)
        covariance = np.linalg.inv(self._information)
        mean = covariance @ self._weighted
        expected = self._start_rad + mean[0] - self.sense * math.radians(angle_deg)
        # Linear prediction of the angle; its variance comes from the parameters and from the reading.
        row = _angle_row(expected)
        residual = wrap_radians(phi - expected - float(row[1:] @ mean[1:]))
        limit = K * math.sqrt(float(row @ covariance @ row) + self._angle**2)
        return Off(-self.sense * math.degrees(residual), math.degrees(limit))

    def angle_deg(self, accel_mg: Floats) -> float:
        """Return the stage angle in degrees, within ±180°, that a reading in mg shows.

        The parameters known so far are used; before the first dwell the start angle counts as zero.
        """
        phi, _ = self._polar(accel_mg)
        if self._start_rad is None:
            return -self.sense * math.degrees(phi)
        mean = np.linalg.solve(self._information, self._weighted)
        rest = self._start_rad + float(_angle_row(phi) @ mean)
        return self.sense * math.degrees(wrap_radians(rest - phi))

    def _polar(self, accel_mg: Floats) -> tuple[float, float]:
        x, y = float(accel_mg[0]), float(accel_mg[1])
        return math.atan2(y, x), math.log(max(math.hypot(x, y), 1.0) / self._gravity)


def turned_deg(before_mg: Floats, now_mg: Floats, sense: int = 1) -> float:
    """Return the angle in degrees, within ±180°, by which the stage turned between two readings in mg.

    `sense` is −1 if the stage counts angles in the opposite direction to the plan.
    """
    before = math.atan2(float(before_mg[1]), float(before_mg[0]))
    now = math.atan2(float(now_mg[1]), float(now_mg[0]))
    return -sense * math.degrees(wrap_radians(now - before))


def _angle_row(psi: float) -> Floats:
    """Return the derivatives (6,) of the angle of a reading with respect to the parameters of the model.

    `psi` is the angle atan2(U_y, U_x) of the reading in rad. The parameters are the start angle, gains of X
    and Y, Δφ, and biases of X and Y in units of G.
    """
    c, s = math.cos(psi), math.sin(psi)
    return np.array([1.0, -s * c, s * c, c * c, -s, c])
