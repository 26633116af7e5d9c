"""What a result advises: which positions to measure, and what an uncertainty does not hold."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import root

from adis_gonio import fit
from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SingularError
from adis_gonio.fitting.linked import LinkReport
from adis_gonio.fitting.methods import advise_positions
from adis_gonio.model.measurement import sensitivity
from adis_gonio.model.records import Dwell, Session
from fitting.test_uncertainty import FOUR, turn


@pytest.mark.parametrize(
    ("lost", "advice"),
    [
        (["bias_z", "scale_z", "skew_xz", "skew_xy"], "measure positions with axis z up and down"),
        (["bias_z"], "measure positions with axis z up and down"),
        (["skew_xz", "scale_z"], "measure positions with axis z up and down"),
        (["scale_x", "bias_z"], "measure positions with axis x, z up and down"),
        (["bias_x", "scale_y"], "measure positions all around the turn (0°, 90°, 180°, 270°)"),
        (["bias_x", "bias_z"], "measure positions with axis x, z up and down"),
        (["scale_y", "bias_y", "bias_z"], "measure positions with axis y, z up and down"),
        (["skew_xy"], "measure positions that share gravity between the two axes"),
        (["bias_z", "skew_yz"], "measure positions that share gravity between the two axes"),
        (["bias_x"], "measure the opposite positions too (180° and 270°)"),
        (["bias_x", "scale_x"], "measure positions all around the turn (0°, 90°, 180°, 270°)"),
        (["delta_phi"], "measure positions all around the turn (0°, 90°, 180°, 270°)"),
    ],
)
def test_positions_that_would_show_what_is_lost_are_named(lost: list[str], advice: str) -> None:
    assert advise_positions(lost) == advice


def test_a_session_without_declared_angles_is_advised_to_declare_them() -> None:
    session = turn(FOUR)
    session = replace(session, dwells=tuple(replace(dwell, angle_deg=None) for dwell in session.dwells))
    with pytest.raises(SingularError, match=r"declare the stage's angle .*column angle_deg"):
        fit(session)


@pytest.mark.parametrize(
    ("sensor", "held"),
    [
        ("adis16354", "the uncertainty includes the part's figure for it"),
        ("generic", "the uncertainty does not include it"),
    ],
)
def test_two_positions_say_whether_u_holds_the_bias_that_they_cannot_see(sensor: str, held: str) -> None:
    told = fit(replace(turn((0, 90)), sensor=sensor), "two-position").warnings
    (line,) = [one for one in told if "a bias cannot be seen" in one]
    assert f"{held}; measure 180° and 270° too and use method four-position" in line


def test_four_positions_name_the_bias_and_what_it_does_to_two_of_them() -> None:
    biased = turn(FOUR)
    moved = (57.3, -20.6) - np.array([dwell.accel for dwell in biased.dwells]).mean(axis=(0, 1))
    biased = replace(biased, dwells=tuple(replace(d, accel=d.accel + moved) for d in biased.dwells))
    (line,) = [one for one in fit(biased, "two-position").warnings if "a bias cannot be seen" in one]
    assert "finds a bias of +57.3 mg on X and −20.6 mg on Y" in line
    assert line.endswith("use method four-position or ml")

    def skew(bias: tuple[float, float]) -> float:
        """Δφ in degrees by hand, from the readings at 0° and 90°."""
        (a_x, a_y), (b_x, b_y) = np.array([dwell.accel[0] for dwell in biased.dwells[:2]]) - bias
        return math.degrees(math.atan2(a_y, -b_y) - math.atan2(b_x, a_x))

    stated = float(line.replace("−", "-").rsplit("moves Δφ by ", 1)[1].split("°")[0])
    assert stated == pytest.approx(skew((0.0, 0.0)) - skew((57.3, -20.6)), abs=0.05)


def test_a_session_of_nine_that_shows_the_bias_names_the_methods_that_do() -> None:
    told = fit(turn((0, 90, *range(100, 170, 10))), "two-position").warnings
    (line,) = [one for one in told if "a bias cannot be seen" in one]
    assert line.endswith("methods mmpm and ml see it in this session")


def test_what_a_milligram_of_an_unseen_bias_moves_is_said_with_it() -> None:
    session = turn((0, 90))
    rows = np.array([dwell.accel[0] for dwell in session.dwells])

    def by_hand(bias: tuple[float, float]) -> tuple[float, float]:
        """ΔK and Δφ in degrees of cosine and sine, which are the readings at 0° and 90°."""
        (a_x, a_y), (b_x, b_y) = rows - bias
        skew = math.atan2(a_y, -b_y) - math.atan2(b_x, a_x)
        return math.hypot(a_x, b_x) / math.hypot(a_y, b_y), math.degrees(skew)

    found = fit(session, "ml")
    for axis, one in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
        (told,) = [line for line in found.warnings if line.startswith(f"bias_{axis} cannot be seen")]
        k, phi = np.subtract(by_hand(one), by_hand((0.0, 0.0)))
        assert told.replace("−", "-") == (
            f"bias_{axis} cannot be seen in these positions and was taken as zero: 1 mg of it moves "
            f"delta_k by {k:+.2g}, delta_phi by {phi:+.2g}°; measure the opposite positions too "
            "(180° and 270°)"
        )


def test_what_a_tenth_of_a_degree_of_an_unseen_skew_moves_is_said_with_it() -> None:
    faces = np.array(
        [[20, 1, 3], [-20, 4, 1], [2, 20, -5], [1, -20, 4], [-3, 2, 20], [5, 3, -20]], dtype=float
    )
    rows = 1000 * faces / np.linalg.norm(faces, axis=1, keepdims=True) + [12.0, -7.0, 20.0]
    dwells = tuple(Dwell(k, np.array([10.0 * k]), row[None]) for k, row in enumerate(rows))
    found = fit(Session(dwells, accel_unit="mg", sensor="generic", plane="none", reading_u_mg=0.1))

    def bias(skew_deg: float) -> Floats:
        """The bias with which six norms are gravity's, X and Y as far from a right angle as said."""

        def off(x: Floats) -> Floats:
            gains = sensitivity(np.array([*x[:3], math.radians(skew_deg), 0.0, 0.0]))
            return np.linalg.norm(np.linalg.solve(gains, (rows - 1000 * x[3:]).T), axis=0) / 1000 - 1

        return 1000 * root(off, [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], tol=1e-12).x[3:]

    (told,) = [line for line in found.warnings if line.startswith("skew_xy cannot be seen")]
    assert "was taken as zero: 0.1° of it moves bias_x by" in told
    said = [
        float(figure) for figure in re.findall(r"bias_. by ([-+][0-9.e-]+)\smg", told.replace("−", "-"))
    ]
    assert said == pytest.approx((bias(0.01) - bias(-0.01)) / 0.2, rel=0.05)


# -- turns between poses ----------------------------------------------------------------------------------

USED = LinkReport(5, 12.34, 6, ((1, 2, "saturated"),), calibrated=True)


def test_what_turns_between_poses_gave_is_told_in_a_line() -> None:
    assert USED.line == (
        "5 turns between the poses by the gyros; χ² 12.3 at 6 degrees of freedom; "
        "1 to 2 left out: saturated"
    )
    plain = replace(USED, refused=(), used=1, dof=1)
    assert plain.line == "1 turn between the poses by the gyros; χ² 12.3 at 1 degree of freedom"


def test_of_many_turns_that_were_left_out_two_are_named() -> None:
    many = tuple((k, k + 1, "saturated") for k in range(5))
    told = replace(USED, refused=many).line
    assert told.endswith("0 to 1 left out: saturated; 1 to 2 left out: saturated; and 3 more")
    assert "more" not in replace(USED, refused=many[:2]).line


def test_turns_that_are_not_used_say_why() -> None:
    none = LinkReport(0, None, 0, why="they contradict gravity")
    assert none.line == "turns between the poses are not used: they contradict gravity"
    assert none.as_dict()["why_none"] == "they contradict gravity"
    document = USED.as_dict()
    assert document["why_none"] is None
    assert document["gyros"] == "calibrated"
    assert none.as_dict()["gyros"] == "data sheet"
    assert document["refused"] == [{"from": 1, "to": 2, "why": "saturated"}]
