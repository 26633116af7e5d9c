"""Parts of an uncertainty put together by hand: sources, budget rows, and what is reported of a fit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.readings import Readings, Unit, from_means
from adis_gonio.fitting.fit_result import (
    FitResult,
    outputs_of,
    stage_warnings,
    values_of,
    variances,
)
from adis_gonio.fitting.uncertainty import Source, Sources, budget_of, dof_of
from adis_gonio.model.effects import Conditions

RNG = np.random.default_rng(1)
GRADIENT, READING = RNG.standard_normal((5, 3)), RNG.standard_normal((5, 2))
MOVES, FURTHER = RNG.standard_normal((3, 4)), RNG.standard_normal((2, 4))
OWN = np.array([[2.0, 0.5], [0.5, 1.0]])


def source(name: str = "one", **more: object) -> Source:
    facts: dict[str, object] = {
        "kind": "A", "distribution": "Student", "u": 0.5, "unit": "mg", "moves": MOVES,
        "dof": np.array([4.0, np.inf, 9.0, 4.0]), "estimate": np.array([1, 0, 2, 1]), "reading_mg2": OWN,
    }  # fmt: skip
    return Source(name, **{**facts, **more})


def readings(unit: Unit | None = None, gravity: float = 980.0) -> Readings:
    made = from_means(
        np.ones((4, 2)),
        np.tile(np.eye(2), (4, 1, 1)),
        Conditions(time_s=np.arange(4.0), angle_rad=np.arange(4.0)),
        gravity_mg=gravity,
    )
    return made if unit is None else replace(made, unit=unit)


def test_parts_of_a_quantity_are_mean_squares_of_what_each_moves() -> None:
    plain = source().parts(GRADIENT)
    moved = GRADIENT @ MOVES
    assert [part[0] for part in plain] == [1, 0, 2, 1]
    assert [part[1] for part in plain] == [4.0, math.inf, 9.0, 4.0]
    assert [part[2] for part in plain] == pytest.approx([np.mean(moved[:, k] ** 2) for k in range(4)])
    both = source(further_mg=FURTHER).parts(GRADIENT, READING)
    moved = moved + READING @ FURTHER
    assert [part[2] for part in both[:4]] == pytest.approx([np.mean(moved[:, k] ** 2) for k in range(4)])
    # What a further reading adds of itself rests on the estimate of the largest part.
    largest = int(np.argmax([np.mean(moved[:, k] ** 2) for k in range(4)]))
    own = np.mean([row @ OWN @ row for row in READING])
    assert both[4] == (both[largest][0], both[largest][1], pytest.approx(own))
    assert len(source(reading_mg2=np.zeros((2, 2))).parts(GRADIENT, READING)) == 4
    by_place = source(further_mg=FURTHER).variances(GRADIENT, READING).sum(axis=1)
    expected = [(moved[m] ** 2).sum() + READING[m] @ OWN @ READING[m] for m in range(5)]
    assert by_place == pytest.approx(expected)


def test_parts_of_one_estimate_are_one_before_welch_and_satterthwaite() -> None:
    parts = [(1, 4.0, 0.5), (1, 6.0, 1.5), (2, 9.0, 1.0), (3, math.inf, 2.0), (0, math.inf, 1.0)]
    total = 0.5 + 1.5 + 1.0 + 3.0
    assert dof_of(parts) == pytest.approx(total**2 / ((0.5 + 1.5) ** 2 / 4 + 1.0**2 / 9))
    assert math.isinf(dof_of([(0, math.inf, 2.0)]))


def test_a_source_by_definition_moves_parameters_and_is_no_part_of_their_u() -> None:
    both = Sources((source(), source("gravity", by_definition=True), source("more", moves=2 * MOVES)))
    np.testing.assert_allclose(both.covariance, 5 * MOVES @ MOVES.T)
    assert len(both.parts(GRADIENT)) == 8
    each = [one.variances(GRADIENT, READING).sum(axis=1) for one in (source(), source(moves=2 * MOVES))]
    np.testing.assert_allclose(both.by_place(GRADIENT, READING), sum(each))
    u, dof = both.uncertainty(GRADIENT)
    assert u == pytest.approx(math.sqrt(5 * ((GRADIENT @ MOVES) ** 2).sum() / 5))
    assert dof == pytest.approx(dof_of(both.parts(GRADIENT)))


def test_rows_of_a_budget_add_up_and_divide_by_what_the_source_is() -> None:
    none = source("none", moves=1e-14 * MOVES, u=None)
    zero = source("zero", moves=0 * MOVES, u=0.0)
    gravity = source("gravity", by_definition=True, moves=3 * MOVES)
    found = Sources((source(), source("more", moves=2 * MOVES, u=4.0), none, zero, gravity))
    rows = budget_of(found, GRADIENT)
    size = math.sqrt(((GRADIENT @ MOVES) ** 2).sum() / 5)
    assert [row.contribution for row in rows] == pytest.approx([size, 2 * size, 0.0, 0.0, 3 * size])
    assert rows[2].contribution == 0, "what a computation rounds is nothing"
    assert [row.share for row in rows] == pytest.approx([0.2, 0.8, 0.0, 0.0, 0.0])
    assert rows[0].sensitivity == pytest.approx(size / 0.5)
    assert rows[1].sensitivity == pytest.approx(2 * size / 4.0)
    assert [row.sensitivity for row in rows[2:4]] == [None, None]
    assert rows[0].dof == pytest.approx(dof_of(source().parts(GRADIENT)))
    assert all(row.share == 0 for row in budget_of(Sources((zero, gravity)), GRADIENT))
    document = rows[0].as_dict()
    assert (document["source"], document["type"], document["distribution"]) == ("one", "A", "Student")
    assert (document["u"], document["unit"], document["note"]) == (0.5, "mg", "")
    small = Sources((source(), source("small", moves=1e-9 * MOVES)))
    assert budget_of(small, GRADIENT)[1].contribution == pytest.approx(1e-9 * size)


@pytest.mark.parametrize("known", [True, False])
def test_a_gradient_is_the_slope_of_what_is_reported(known: bool) -> None:
    unit = None if known else Unit("counts", np.array([100.0, -50.0]), np.array([2.0, 2.5]))
    data = readings(unit)
    values = np.array([0.3, 1.02, 0.97, 0.01, 12.0, -7.0])
    natural = np.array([1.0, 1.0, 1.0, 1.0, 980.0, 980.0])
    found = outputs_of(data, values)
    assert [o.name for o in found] == [
        "delta_k", "delta_phi", "alpha", "scale_x", "scale_y", "bias_x", "bias_y",
    ]  # fmt: skip
    for k, step in enumerate(1e-6 * np.eye(6)):
        up = outputs_of(data, values + step * natural)
        down = outputs_of(data, values - step * natural)
        for one, high, low in zip(found, up, down, strict=True):
            slope = (high.value - low.value) / 2e-6
            assert one.gradient[k] == pytest.approx(slope, rel=1e-6, abs=1e-6)
    by_name = {o.name: o for o in found}
    gains = [1.0, 1.0] if known else [2.0, 2.5]
    assert by_name["delta_k"].value == pytest.approx(1.02 * gains[0] / (0.97 * gains[1]) - 1)
    assert by_name["alpha"].value == pytest.approx(math.degrees(0.3))
    assert by_name["bias_x"].value == pytest.approx(12.0 if known else 100 + 24.0)
    assert by_name["bias_y"].value == pytest.approx(-7.0 if known else -50 - 17.5)
    if not known:
        # Counts a mg times mg a m/s²: gravity of 9.80665 m/s² is a thousand mg.
        assert by_name["scale_x"].value == pytest.approx(1.02 * 2.0 * 1000 / 9.80665)
        assert by_name["scale_x"].unit == "counts/(m/s²)"


def test_variances_and_estimates_follow_the_gradients() -> None:
    found = outputs_of(readings(), np.array([0.3, 1.02, 0.97, 0.01, 12.0, -7.0]))
    root = RNG.standard_normal((6, 6))
    whole = np.stack([o.gradient for o in found])
    np.testing.assert_allclose(variances(found, root @ root.T), whole @ root @ root.T @ whole.T)
    moves = RNG.standard_normal((6, 4))
    told = values_of(found, Sources((source(moves=moves),)))
    for (name, one), output in zip(told.items(), found, strict=True):
        assert one.u == pytest.approx(float(np.linalg.norm(output.gradient @ moves)))
        assert (name, one.value, one.unit) == (output.name, output.value, output.unit)
    assert all(one.u is None and math.isinf(one.dof) for one in values_of(found, None).values())


@pytest.mark.parametrize(
    ("u_rad", "sigma_rad", "told"),
    [
        (0.11, 0.2, True),
        (0.09, 0.2, False),  # it is determined
        (0.3, 0.2, True),
        (0.5, 0.2, False),  # the stage is not what leaves it open
        (0.11, math.inf, False),
    ],
)
def test_an_angle_between_axes_that_the_stage_alone_knows_is_remarked_on(
    u_rad: float, sigma_rad: float, told: bool
) -> None:
    phi = {"delta_phi": Value(0.0, math.degrees(u_rad), "deg")}
    found = {"alpha": Value(0.0, 9.0, "deg"), **phi}
    lines = stage_warnings(found, sigma_rad)
    assert len(lines) == told
    if told:
        assert lines[0].startswith(f"u of Δφ is {math.degrees(u_rad):.2g}°: only the stage")
        assert "(11.5°)" in lines[0]
    assert stage_warnings({"alpha": found["alpha"]}, sigma_rad) == []


def test_a_result_without_a_session_tells_what_it_has() -> None:
    found = {
        "scale_x": Value(1.5, 0.1, "1"), "bias_x": Value(3.0, None, "mg"), "b": Value(1.0, 0.2, "1")
    }  # fmt: skip
    plain = FitResult(
        method="ml", parameters=found, covariance=np.diag([1.0, 2.0, 3.0]), chi2=5.0, dof=2,
        residual_mg=np.array([[3.0, 4.0], [0.0, 0.0]]), positions=(1, 2),
        angle_error_rad=np.radians([3.0, -4.0]), fixture_sigma_deg=math.inf, extra_mg=0.25,
    )  # fmt: skip
    assert plain.residual_rms_mg == pytest.approx(2.5)
    document = plain.as_dict()
    assert document["angle_error_deg"] == {"rms": pytest.approx(math.sqrt(12.5)), "max": pytest.approx(4.0)}
    assert document["covariance"] == {
        "names": ["scale_x", "bias_x", "b"],
        "matrix": [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]],
    }
    assert document["fixture_sigma_deg"] == "free"
    assert replace(plain, fixture_sigma_deg=0.5).as_dict()["fixture_sigma_deg"] == 0.5
    assert replace(plain, fixture_sigma_deg=None).as_dict()["fixture_sigma_deg"] is None
    assert (document["positions_used"], document["extra_reading_u_mg"]) == (2, 0.25)
    for name in ("recommended", "angle", "reference_temperature_c"):
        assert document[name] is None
    assert document["budget"] == document["scores"] == {}
    assert "links" not in document
    bare = replace(plain, covariance=None, angle_error_rad=None).as_dict()
    assert bare["covariance"] == {"names": [], "matrix": []}
    assert bare["angle_error_deg"] is None
    assert replace(plain, angle_error_rad=np.zeros(0)).as_dict()["angle_error_deg"] is None
    assert repr(plain).startswith("FitResult(ml, 2 dwells, scale_x ")
    assert "bias_x" in repr(plain)
    assert " b " not in repr(plain), "the first two, where what is wanted is not among them"
    assert "bias_x" in plain
    assert "bias_y" not in plain
    assert plain["b"].value == 1.0
    with pytest.raises(KeyError):
        plain["bias_y"]
