"""What counts as held out, and that a corrected model does not run off there."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm
from adis_gonio.tracing.averaging import AveragedTerm, average
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.validation import HeldOut, determined, drop_unpredicted, folds, predicted_dwells
from tracing.blind import draw, write
from tracing.test_trace_gates import forth_and_back
from tracing.undeclared import BEYOND, GRAMMAR, Draw
from tracing.verdict import error_before


def labelled(data, *labels: str) -> list[NamelessTerm]:
    terms = {term.label: term for term in nameless_terms(data)}
    return [terms[label] for label in labels]


def test_a_range_of_angles_that_was_left_out_says_nothing_of_harmonics_there() -> None:
    data = readings_of(forth_and_back())
    designs = folds(data)
    quarters = [np.abs(data.mean[:, 0]) == np.abs(data.mean).max(axis=1)]
    bend = labelled(data, "bias[x]~a smooth function of the angle (harmonics to 5)")
    assert determined(data, quarters).sum() > determined(data, quarters, bend).sum()
    counts = predicted_dwells(data, designs, bend)
    assert counts["whole dwells"].all()
    assert counts["blocks of time"].all()  # forth and back: every angle is in another block as well
    drift = labelled(data, "bias[x]~a smooth function of time (degree 6)")
    assert not predicted_dwells(data, designs, drift).get("blocks of time", np.zeros(1, bool)).all()


def test_names_do_not_choose_the_dwells_by_which_they_are_judged() -> None:
    data = readings_of(forth_and_back())
    designs = folds(data)
    named = [t for t in named_terms(data)[0] if t.label in {"bias_drift[x]", "stage_ellipticity"}]
    assert len(named) == 2
    for design, mask in predicted_dwells(data, designs, named).items():
        np.testing.assert_array_equal(mask, predicted_dwells(data, designs, [])[design])


def test_the_average_holds_no_polynomial_where_a_process_bends_as_well() -> None:
    data = readings_of(forth_and_back())
    time = data.conditions.time_s / np.ptp(data.conditions.time_s)
    mean = data.mean.copy()
    mean[:, 0] += 1.5 * np.sin(9 * time**2)
    data = replace(data, mean=mean)
    selection = select(data, [*named_terms(data)[0], *nameless_terms(data)], 3)
    averaged = average(selection)
    assert averaged is not None
    mixed = [term for term in averaged.terms if isinstance(term, AveragedTerm)]
    members = [t for term in mixed for _, t, _ in term.members]
    assert members
    assert not any(t.basis.approximates and t.covariates == ("time",) for t in members)
    assert any(t.prior_sd is not None for t in members)


@pytest.mark.parametrize(
    ("kind", "shapes", "shape"),
    [
        ("uncatalogued", GRAMMAR, "gain_jump"),
        ("beyond", BEYOND, "lean_wanders"),
        ("beyond", BEYOND, "smooth_of_time"),
    ],
)
def test_the_corrected_model_does_not_run_off_where_dwells_are_left_out(
    tmp_path: Path, kind: str, shapes: dict[str, Draw], shape: str
) -> None:
    # With polynomials in the average single folds were wrong by ten times the effect.
    path = tmp_path / "blind.csv"

    def traced(index: int) -> dict[str, Any]:
        write(path, *draw(kind, 302, index))
        return trace(load_session(path)).as_dict()

    every = map(traced, itertools.count(list(shapes).index(shape), len(shapes)))
    result = next(one for one in every if one["unnamed"] and "time" in one["unnamed"]["covariates"])
    assert result["error"]["after"]["heldout_rms_mg"] < 0.6 * error_before(result)


def test_a_harmonic_that_is_rounding_on_the_grid_of_a_session_is_no_candidate() -> None:
    # On a grid of 36° a fit gave sin 5θ an amplitude of 10¹⁴, which the angles of check dwells then showed.
    data = readings_of(forth_and_back())
    wave = Basis("sin 5θ", ("angle",), lambda c: np.sin(5 * c.covariate("angle_rad"))[:, None])
    term = NamelessTerm("bias[x]~sin 5θ", ("angle",), 1.0, "bias", (0,), wave)
    grid = data.conditions.rows(np.isclose(np.rad2deg(data.conditions.angle_rad) % 36, 0))
    other = replace(grid, angle_rad=grid.angle_rad + 0.1)
    ideal = np.full((len(grid), 2), 500.0)
    assert len(grid) > 1
    assert not term.columns(ideal, grid).any()
    assert np.abs(term.columns(ideal, other)).max() > 0.4


def test_functions_with_and_without_a_constant_keep_their_own_columns() -> None:
    data = readings_of(forth_and_back())
    terms = {term.label: term for term in nameless_terms(data)}
    pairs = [(terms[label], terms[f"{label} + const"]) for label in terms if f"{label} + const" in terms]
    assert len(pairs) > 50
    for plain, beside in pairs:
        alone, both = (t.columns(data.mean, data.conditions) for t in (plain, beside))
        axes, width = len(plain.axes), alone.shape[-1] // len(plain.axes)
        assert both.shape[-1] == alone.shape[-1] + axes
        first = both[:, plain.axes[0], : width + 1]
        np.testing.assert_array_equal(first[:, 0], 1.0)
        np.testing.assert_array_equal(first[:, 1:], alone[:, plain.axes[0], :width])


def test_a_dwell_that_the_model_chosen_without_it_leaves_open_counts_under_no_design() -> None:
    known = np.array([True] * 8 + [False] * 4)
    every = np.ones(12, dtype=bool)

    def left(predicted: np.ndarray) -> HeldOut:
        return HeldOut(np.zeros((12, 3)), None, predicted)

    counts = {"whole dwells": every, "body axes": every}
    rest = drop_unpredicted(counts, {"whole dwells": left(known), "body axes": left(~known)})
    assert set(rest) == {"whole dwells", "body axes"}
    assert (rest["whole dwells"] == known).all()
    few = np.arange(12) < 3
    assert set(drop_unpredicted(counts, {"whole dwells": left(known), "body axes": left(few)})) == {
        "whole dwells"
    }
    # Where no design has a third of its dwells left, all count: an error is better than none.
    assert drop_unpredicted(counts, {"whole dwells": left(few), "body axes": left(few)}) == counts
