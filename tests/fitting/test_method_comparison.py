"""Which method is recommended, decided by scores and uncertainties that are put in."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.answer import (
    DwellPrediction,
    Recommendation,
    Score,
    predicts_worse,
    recommend,
    scores_of,
)
from adis_gonio.fitting.fit_result import FitResult


def result(method: str, u: float | None = 1.0, *, bias: bool = True, other: float = 1.0) -> FitResult:
    names = ["delta_k", "delta_phi"] + ["bias_x"] * bias
    us = [u, 1.0, other][: len(names)]
    found = {name: Value(0.0, one, "1") for name, one in zip(names, us, strict=True)}
    return FitResult(
        method=method, parameters=found, covariance=None, chi2=0.0, dof=0, residual_mg=np.zeros((1, 2)),
        positions=(0,),
    )  # fmt: skip


def angles(errors: Floats) -> DwellPrediction:
    return DwellPrediction(np.asarray(errors, dtype=float), np.ones((len(errors), 2)))


def chosen(
    results: list[FitResult], errors: dict[str, Floats] | None = None, preferred: str = "ml"
) -> Recommendation:
    found = {r.method: angles((errors or {}).get(r.method, np.full(8, 1e-3))) for r in results}
    return recommend(results, found, scores_of(found), preferred)


def test_an_error_is_surely_larger_beyond_three_standard_errors_of_the_paired_difference() -> None:
    # Squares 1 and 1 + d: differences with mean m and scatter s of twelve dwells.
    away = np.tile([1.0, -1.0], 6)
    error = away.std(ddof=1) / math.sqrt(12)
    for mean, worse in ((2.9 * error, False), (3.1 * error, True), (-3.1 * error, False)):
        base = np.full(12, 5.0)
        one = angles(np.sqrt(base + away + mean))
        assert predicts_worse(one, angles(np.sqrt(base))) == worse


def test_a_difference_of_a_thousandth_is_none_however_sure_it_is() -> None:
    base = angles(np.full(9, 1.0))
    assert not predicts_worse(angles(np.full(9, math.sqrt(1.0009))), base)
    assert predicts_worse(angles(np.full(9, math.sqrt(1.0011))), base)


def test_two_dwells_tell_nothing_and_what_is_unknown_does_not_count() -> None:
    large = np.array([9.0, 9.0, np.nan, 9.0])
    assert predicts_worse(angles(large), angles(np.ones(4)))
    assert not predicts_worse(angles(large[:3]), angles(np.ones(3)))


def test_without_declared_angles_the_residuals_are_compared() -> None:
    none = np.full(5, np.nan)
    small = DwellPrediction(none, np.tile([1.0, 0.0], (5, 1)))
    large = DwellPrediction(none, np.tile([0.0, -2.0], (5, 1)))
    assert predicts_worse(large, small)
    assert not predicts_worse(small, large)


def test_of_methods_that_predict_alike_the_surest_is_taken_to_one_percent() -> None:
    # The geometric mean of both uncertainties counts: u of one by 1.03 is 1.5 % of it.
    assert chosen([result("mmpm"), result("ml", 1.03)]).method == "mmpm"
    assert chosen([result("mmpm"), result("ml", 1.015)]).method == "ml"
    assert chosen([result("mmpm"), result("ml", 1.0, other=50.0)]).method == "ml"
    assert chosen([result("mmpm"), result("ml", None)]).method == "mmpm"
    assert chosen([result("mmpm"), result("ml")], preferred="two-position").method == "ml", "the last"


def test_who_sees_no_bias_and_paper_are_out_where_another_is_left() -> None:
    assert chosen([result("two-position", 0.1, bias=False), result("ml")]).method == "ml"
    assert chosen([result("paper", 0.1, bias=False), result("two-position", bias=False)]).method == (
        "two-position"
    )
    assert chosen([result("paper", bias=False)]).method == "paper"


def test_who_predicts_surely_worse_is_out_however_sure_it_is() -> None:
    errors = {"mmpm": np.full(8, 2e-3), "ml": np.full(8, 1e-3)}
    assert chosen([result("mmpm", 0.1), result("ml")], errors, preferred="mmpm").method == "ml"
    assert chosen([result("mmpm", 0.1), result("ml")]).method == "mmpm"


def test_the_reason_says_what_decided() -> None:
    one = chosen([result("ml")])
    assert one.why == "the only method that this session supports"
    errors = {"mmpm": np.full(8, 2e-3), "ml": np.full(8, 1e-3), "two-position": np.full(8, 1e-3)}
    best = chosen([result("two-position", bias=False), result("mmpm"), result("ml")], errors)
    assert best.why == (
        "it determines the biases; it predicts the 8 dwells, each left out of its fit, with 0.057° rms, "
        "the best"
    )
    several = chosen([result("mmpm"), result("ml")])
    assert several.why == (
        "it predicts the 8 dwells, each left out of its fit, with 0.057° rms, and none is shown to predict "
        "them better; no other gives a smaller u of ΔK and Δφ"
    )
    blind = chosen([result("paper", bias=False), result("two-position", bias=False)])
    assert blind.why.startswith("no method sees the biases in these positions, which are taken as zero; ")
    unsure = chosen([result("mmpm", None), result("ml", None)])
    assert unsure.why.endswith("none is shown to predict them better")
    nothing = {name: DwellPrediction(np.ones(3), np.full((3, 2), np.nan)) for name in ("mmpm", "ml")}
    told = recommend([result("mmpm"), result("ml")], nothing, scores_of(nothing), "ml")
    assert told.why == (
        "no dwell can be left out to compare the methods by; no other gives a smaller u of ΔK and Δφ"
    )
    assert told.as_dict() == {"method": "ml", "effects": [], "why": told.why}


def test_scores_are_over_the_dwells_that_every_model_predicts() -> None:
    one = DwellPrediction(
        np.radians([1.0, 2.0, np.nan, 9.0]), np.array([[3.0, 4.0], [0.0, 0.0], [-6.0, 0.0], [50.0, 50.0]])
    )
    two = DwellPrediction(np.full(4, np.nan), np.array([[1.0], [1.0], [-2.0], [np.nan]]))
    scores = scores_of({"one": one, "two": two})
    assert scores["one"].dwells == scores["two"].dwells == 3
    assert scores["one"].angle_rms_deg == pytest.approx(math.sqrt(5 / 2))
    assert scores["one"].angle_max_deg == pytest.approx(2.0)
    assert scores["one"].residual_rms_mg == pytest.approx(math.sqrt(61 / 6))
    assert scores["one"].residual_max_mg == 6.0
    assert scores["two"] == Score(None, None, pytest.approx(math.sqrt(2)), 2.0, 3)
    assert scores_of({}) == {}
