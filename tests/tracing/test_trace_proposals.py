"""What to measure next: the design in figures, and the words that are made of it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.numbers import format_duration
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.proposals import (
    Predictions,
    expected_separations,
    information_nats,
    place,
    sentences,
)
from adis_gonio.tracing.trace import trace
from adis_gonio.tracing.trace_result import NextDwell

RNG = np.random.default_rng(11)


def predicted(means: list[float], spreads: list[float]) -> Predictions:
    """One row, one parameter a hypothesis."""
    return [np.array([[[mean, spread]]]) for mean, spread in zip(means, spreads, strict=True)]


def information(weights: list[float], means: list[float], spreads: list[float]) -> float:
    return float(information_nats(np.array(weights), predicted(means, spreads))[0])


def test_information_is_nothing_between_equals_and_all_there_is_between_strangers():
    assert information([0.5, 0.5], [3.0, 3.0], [0.0, 0.0]) == pytest.approx(0.0, abs=1e-12)
    assert information([0.5, 0.5], [0.0, 1e4], [0.0, 0.0]) == pytest.approx(np.log(2))
    assert information([0.9, 0.1], [0.0, 1e4], [0.0, 0.0]) == pytest.approx(
        -0.9 * np.log(0.9) - 0.1 * np.log(0.1)
    )


def test_information_is_a_lower_bound_of_the_true_one():
    """Mutual information of a hypothesis and one reading, by numerical integration."""
    x = np.linspace(-80, 80, 160001)
    for weight, distance, spread in ((0.5, 2.0, 0.0), (0.8, 4.0, 0.0), (0.5, 0.0, 5.0), (0.3, 3.0, 2.0)):
        sigma = np.sqrt(1 + spread**2)
        one = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        two = np.exp(-(((x - distance) / sigma) ** 2) / 2) / np.sqrt(2 * np.pi) / sigma
        both = weight * one + (1 - weight) * two
        parts = [
            w * p * np.log(np.where(p > 1e-300, p / np.maximum(both, 1e-300), 1.0))
            for w, p in ((weight, one), (1 - weight, two))
        ]
        true = float(np.trapezoid(sum(parts), x))
        bound = information([weight, 1 - weight], [0.0, distance], [0.0, spread])
        assert 0.3 * true < bound <= true + 1e-9


def test_the_separation_is_the_chi2_that_the_wrong_model_leaves():
    """Excess of χ² of hypothesis j where i is true, against draws."""
    roots = [np.array([[[0.5, 0.0]], [[0.3, 0.2]]]), np.array([[[2.0, 0.0]], [[0.0, 1.0]]])]
    means = [np.array([[0.0], [1.0]]), np.array([[3.0], [-1.0]])]
    apart = expected_separations([np.dstack([mean, root]) for mean, root in zip(means, roots, strict=True)])
    flat = [root.reshape(2, 2) for root in roots]
    covariance = [root @ root.T + np.eye(2) for root in flat]
    for i, j in ((0, 1), (1, 0)):
        drawn = RNG.multivariate_normal(means[i].ravel(), covariance[i], size=200_000)
        off = drawn - means[j].ravel()
        chi2 = (off * np.linalg.solve(covariance[j], off.T).T).sum(axis=1).mean()
        assert apart[i, j] == pytest.approx(chi2 - 2, rel=0.03)
    assert apart[0, 0] == 0


# -- sessions -------------------------------------------------------------------------------------------


def turn(
    angles: list[float],
    approach: list[int],
    bias: tuple[float, float] = (8.0, -5.0),
    added: tuple[float, ...] = (),
    reading: object = None,
) -> Session:
    """Readings of 0.1 mg at declared angles, 20 s apart; `added` turns the part by degrees."""
    rng = np.random.default_rng(3)
    dwells = []
    for k, (angle, side) in enumerate(zip(angles, approach, strict=True)):
        psi = np.radians(10 - angle + (added[k] if added else 0.0))
        psi += np.radians(0.003) * rng.standard_normal()
        x, y = 1000 * np.cos(psi), 1001 * np.sin(psi)
        if reading is not None:
            x += reading(k, x)
        accel = np.array([[x + bias[0], y + bias[1]]]) + 0.1 * rng.standard_normal((1, 2))
        dwells.append(Dwell(k, np.array([20.0 * k]), accel, angle, side))
    return Session(
        tuple(dwells),
        sensor="generic",
        accel_unit="mg",
        reading_u_mg=0.1,
        fixture_sigma_deg=0.003,
    )


def test_hysteresis_that_one_side_hides_is_asked_for_from_the_other():
    """From one side it is a bias, and a dwell from the other side parts them."""
    angles = [float(a) for a in range(0, 360, 30)] * 2
    result = trace(turn(angles, [1] * 24))
    assert any({"bias", "hysteresis"} <= set(group) for group in result.confounded)
    asked = [m for m in result.measurements if "hysteresis" in sum(m.separates, ())]
    assert asked
    assert all(m.approach < 0 for m in asked)
    both = trace(turn(angles, [1] * 12 + [-1] * 12))
    assert not any({"backlash", "hysteresis"} & set(sum(m.separates, ())) for m in both.measurements)


def test_time_that_is_angle_is_parted_by_coming_back():
    """One turn in order with a drift, which a function of the angle imitates until positions repeat."""
    angles = [float(a) for a in range(0, 360, 40)]

    def drift(k: int, x: float) -> float:
        return 0.6 * k

    def imitated(groups) -> bool:
        return any("bias_drift" in group and any("θ" in name for name in group) for group in groups)

    before = trace(turn(angles, [1] * 9, reading=drift))
    assert imitated(before.confounded)
    more = angles + [m.angle_deg for m in before.measurements if m.purpose == "decide"]
    assert len(more) > len(angles)
    after = trace(turn(more, [1] * len(more), reading=drift))
    assert not imitated(after.confounded)
    assert "bias_drift" in {finding.effect for finding in after.found}


def test_measurements_come_in_the_order_of_their_information_and_are_worth_while():
    angles = [float(a) for a in range(0, 360, 40)]
    result = trace(turn(angles, [1] * 9, reading=lambda k, x: 3e-6 * x**2))
    for purpose in ("decide", "cover"):
        chosen = [m for m in result.measurements if m.purpose == purpose]
        assert len(chosen) <= 4
        assert all(m.separation >= 3.0 for m in chosen)
        assert all(m.information > 0 for m in chosen)


def test_the_document_has_words_under_next_and_figures_under_measurements():
    result = trace(turn([0.0, 90.0, 180.0, 270.0], [1] * 4))
    document = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert document["next"]
    assert all(isinstance(line, str) for line in document["next"])
    assert document["measurements"]
    keys = {
        "angle_deg", "direction", "approach", "wait_s", "separation", "information", "purpose", "separates",
        "sentence",
    }  # fmt: skip
    for entry in document["measurements"]:
        assert set(entry) == keys
        assert entry["sentence"].startswith("measure at ")
    assert not any("`" in line or "<" in line for line in document["next"])


def test_a_turn_without_declared_angles_gets_words_only():
    session = turn([float(a) for a in range(0, 360, 30)], [0] * 12)
    session = replace(session, dwells=tuple(replace(d, angle_deg=None) for d in session.dwells))
    result = trace(session)
    assert result.measurements == ()
    assert any(line.startswith("declare the angles") for line in result.advice)


def test_in_space_attitudes_are_proposed_as_directions():
    rng = np.random.default_rng(5)
    dwells = []
    for k in range(10):
        unit = rng.standard_normal(3)
        unit[2] = 0.15 * unit[2]
        unit /= np.linalg.norm(unit)
        accel = 1000 * unit + np.array([5.0, -3.0, 8.0]) + 0.1 * rng.standard_normal(3)
        dwells.append(Dwell(k, np.array([20.0 * k]), accel[None, :]))
    session = Session(
        tuple(dwells), sensor="generic", accel_unit="mg", reading_u_mg=0.1, plane="none",
        fixture_sigma_deg=float("inf"),
    )  # fmt: skip
    result = trace(session)
    assert result.measurements
    assert all(m.angle_deg is None and m.direction is not None for m in result.measurements)
    lengths = [np.linalg.norm(m.direction) for m in result.measurements if m.direction is not None]
    assert lengths == pytest.approx([1.0] * len(lengths))


# -- words ----------------------------------------------------------------------------------------------


def made(angle: float, **changes: object) -> NextDwell:
    first = NextDwell(angle, None, 1, 0.0, 7.3, 0.5, "decide", (("quadratic",), ("asymmetry",)))
    return replace(first, **changes)


def test_what_parts_the_same_is_one_sentence():
    lines = sentences([made(45.0), made(135.0, approach=-1), made(90.0, separates=((), ("backlash",)))])
    assert lines == (
        "measure at 45° and 135° from above: that tells quadratic from asymmetry "
        "(expected difference about 7 standard uncertainties)",
        "measure at 90°: that shows whether backlash is there "
        "(expected difference about 7 standard uncertainties)",
    )


def test_a_faint_difference_promises_nothing_and_a_place_is_said_once():
    assert sentences([made(45.0, separation=0.42), made(45.0, separation=0.3)]) == (
        "measure at 45°: that may tell quadratic from asymmetry "
        "(expected difference about 0.4 standard uncertainties)",
    )


def test_what_could_not_be_seen_is_one_sentence():
    unseen = [
        made(45.0, purpose="cover", separates=((), ("backlash",))),
        made(90.0, purpose="cover", separates=((), ("backlash", "cubic"))),
    ]
    assert sentences(unseen) == (
        "measure at 45° and 90°: only then could backlash and cubic be seen, if present",
    )


def test_places_say_the_side_and_the_wait():
    assert place(made(45.0, approach=-1, wait_s=600.0)) == "45° from above, after waiting 10 min"
    assert place(made(0.0, angle_deg=None, direction=(0.7, 0.0, -0.7))) == "an attitude that reads +x −z"
    assert (format_duration(30.0), format_duration(90.0)) == ("30 s", "1 min 30 s")
