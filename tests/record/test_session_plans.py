from __future__ import annotations

import math

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.record.plans import PLAN_NAMES, Plan, Position, blindness, extension, plan


def angles(made: Plan, use: str = "fit") -> list[float | None]:
    return [position.angle_deg for position in made.positions if position.use == use]


def log_information(angles_deg: np.ndarray, alpha: float) -> float:
    """log det of the information of α, K_x, K_y, Δφ, b_x, b_y at unit noise."""
    psi = alpha - np.radians(angles_deg)
    zero, one = np.zeros_like(psi), np.ones_like(psi)
    x = np.stack([-np.sin(psi), np.cos(psi), zero, zero, one, zero], axis=1)
    y = np.stack([np.cos(psi), zero, np.sin(psi), np.cos(psi), zero, one], axis=1)
    design = np.concatenate([x, y])
    return float(np.linalg.slogdet(design.T @ design)[1])


def test_two_position_is_the_default_and_visits_0_and_90():
    assert plan().name == "two-position"
    assert angles(plan()) == [0.0, 90.0]


def test_four_position_visits_opposite_angles():
    assert angles(plan("four-position")) == [0.0, 90.0, 180.0, 270.0]


@pytest.mark.parametrize("alpha_deg", [0.0, 7.0, 45.0, 200.0])
def test_mmpm_has_nine_positions_and_more_information_than_other_nines(alpha_deg):
    nine = np.array(angles(plan("mmpm")), dtype=float)
    assert len(nine) == 9
    alpha = math.radians(alpha_deg)
    ours = log_information(nine, alpha)
    for other in (np.linspace(0, 90, 9), np.linspace(0, 180, 9), np.arange(9) * 45.0, np.arange(9) * 22.5):
        assert ours > log_information(other, alpha) + 0.05
    rng = np.random.default_rng(3)
    for _ in range(200):
        assert ours >= log_information(rng.uniform(0, 360, 9), alpha)
    assert ours == pytest.approx(log_information(nine, 0.0))


def test_tumble_comes_back_through_the_same_angles_from_the_other_side():
    made = plan("tumble", 6)
    assert angles(made) == [0, 60, 120, 180, 240, 300, 300, 240, 180, 120, 60, 0]
    assert [position.approach for position in made.positions] == [1] * 6 + [-1] * 6


@pytest.mark.parametrize(
    ("name", "usual", "least", "fewest"),
    [("mmpm", 9, 9, 9), ("tumble", 24, 3, 6), ("poses", 14, 9, 9)],  # tumble visits each angle twice
)
def test_each_plan_has_a_usual_and_a_smallest_number_of_positions(name, usual, least, fewest):
    assert len(plan(name)) == usual
    assert len(plan(name, least)) == fewest
    with pytest.raises(UsageError, match=f"takes {least} to"):
        plan(name, least - 1)


def test_poses_have_no_angle_and_no_plane():
    made = plan("poses", 20)
    assert len(made) == 20
    assert made.plane == "none"
    assert {position.angle_deg for position in made.positions} == {None}


def test_suggested_poses_are_directions_spread_over_the_sphere():
    vectors = np.array([position.direction for position in plan("poses", 20).positions])
    assert np.linalg.norm(vectors, axis=1) == pytest.approx(np.ones(20))
    between = np.degrees(np.arccos(np.clip(vectors @ vectors.T, -1, 1)))[~np.eye(20, dtype=bool)]
    assert between.min() > 25
    assert np.abs(vectors.mean(axis=0)).max() < 0.03
    assert np.linalg.eigvalsh(vectors.T @ vectors / 20) == pytest.approx(np.full(3, 1 / 3), abs=0.03)


@pytest.mark.parametrize("name", PLAN_NAMES)
@pytest.mark.parametrize("check", [0, 1, 3, 7])
def test_check_positions_are_added_at_other_places_and_leave_the_fit_alone(name, check):
    made, bare = plan(name, check=check), plan(name)
    assert angles(made) == angles(bare)
    assert len(angles(made, "check")) == check
    if name != "poses":
        assert not set(angles(made, "check")) & set(angles(bare))
    if check == 1 and len(bare) > 2:
        place = [position.use for position in made.positions].index("check")
        assert 0.3 < place / (len(made) - 1) < 0.7


def test_a_check_position_is_approached_in_the_direction_of_travel():
    made = plan("tumble", 6, check=4)
    by_use = [(p.angle_deg, p.approach) for p in made.positions if p.use == "check"]
    assert by_use == [(90.0, 1), (210.0, 1), (210.0, -1), (90.0, -1)]
    previous = made.positions[0].angle_deg
    for position in made.positions[1:]:
        step = position.angle_deg - previous
        assert step == 0 or np.sign(step) == position.approach
        previous = position.angle_deg


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("two-positions",), "did you mean 'two-position'"),
        (("xyz",), "known: two-position"),
        (("two-position", 3), "has 2 positions, not 3"),
        (("tumble", 10**6), "takes 3 to"),
        (("tumble", 12, -1), "check positions"),
    ],
)
def test_an_unknown_plan_or_number_is_one_line(arguments, words):
    with pytest.raises(UsageError, match=words) as caught:
        plan(*arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("made", [plan("tumble", 5, check=2), plan("poses"), plan()])
def test_a_plan_survives_json(made):
    assert Plan.from_dict(made.as_dict()) == made


def test_two_positions_are_extended_to_four_once_they_are_done():
    two = plan()
    assert extension(two, 1) is None
    longer = extension(two, 2)
    assert longer is not None
    assert longer.positions[:2] == two.positions
    assert angles(longer) == angles(plan("four-position"))
    assert extension(longer, 4) is None


@pytest.mark.parametrize("alpha_deg", [0.0, 20.0, 45.0, 130.0])
def test_blindness_is_the_spread_that_unseen_biases_give_the_closed_form(alpha_deg):
    blind = blindness(plan(), bias_mg=10.0, gravity_mg=1000.0)
    assert blind is not None
    rng = np.random.default_rng(5)
    b_x, b_y = 10.0 * rng.standard_normal((2, 40_000))
    alpha = math.radians(alpha_deg)
    x1, y1 = 1000 * math.cos(alpha) + b_x, 1000 * math.sin(alpha) + b_y
    x2, y2 = 1000 * math.sin(alpha) + b_x, -1000 * math.cos(alpha) + b_y
    phi = np.arctan2(y1, -y2) - np.arctan2(x2, x1)
    phi = (phi + np.pi) % (2 * np.pi) - np.pi
    gain = np.hypot(x1, x2) / np.hypot(y1, y2) - 1
    assert np.degrees(phi.std()) == pytest.approx(math.degrees(blind), rel=0.02)
    assert gain.std() == pytest.approx(blind, rel=0.02)


@pytest.mark.parametrize("name", ["four-position", "mmpm", "tumble", "poses"])
def test_plans_that_see_a_bias_have_no_blindness(name):
    assert blindness(plan(name), 10.0) is None


def test_a_position_says_where_it_is():
    assert str(Position(90.0)) == "90°"
    assert str(Position(0.0, turned_deg=-719.9)) == "2 turns clockwise"
    assert str(Position(90.0, -1, "check")) == "90° from above (check)"
    assert str(Position(None, 0)) == "a new attitude"
