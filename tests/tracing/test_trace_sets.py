"""Who votes for what in the place of a cause, on models whose scores are set by hand."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.tracing.averaging import AveragedFit, average
from adis_gonio.tracing.credible_sets import CredibleSet, judge, merge_by_function, set_of, votes
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.model_search import weigh
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.selection import Selection, select
from tracing.blind import draw, write
from tracing.test_trace_gates import forth_and_back
from tracing.undeclared import BEYOND


@pytest.fixture(scope="module")
def selection() -> Selection:
    data = readings_of(forth_and_back(k2_x=3.0))
    return select(data, [*named_terms(data)[0], *nameless_terms(data)], 3)


def believed(selection: Selection, weight: Mapping[tuple[str, ...], float]) -> Selection:
    """The selection with nothing but models of these labels, the first of them chosen."""
    number = {term.label: k for k, term in enumerate(selection.problem.terms)}
    scores = {tuple(sorted(number[label] for label in m)): float(np.log(w)) for m, w in weight.items()}
    found = replace(selection.found, scores=scores)
    verdict = replace(weigh(found), best=next(iter(scores)))
    return replace(selection, verdict=verdict, found=found)


def test_a_cause_is_what_models_have_in_its_place_and_absent_where_they_have_nothing(
    selection: Selection,
) -> None:
    weight = {
        ("bias[xy]", "quadratic[x]"): 0.6,
        ("bias[xy]", "cross_quadratic[x]"): 0.3,
        ("bias[xy]",): 0.1,
    }
    share, present = votes(believed(selection, weight), "quadratic")
    assert share == pytest.approx({"quadratic": 2 / 3, "cross_quadratic": 1 / 3})
    assert present == pytest.approx(0.9)
    assert set_of(believed(selection, weight), "quadratic").names == ("quadratic", "cross_quadratic")
    assert votes(believed(selection, weight), "bias") == (pytest.approx({"bias": 1.0}), pytest.approx(1.0))


def test_what_cannot_add_what_a_cause_adds_does_not_stand_for_it(selection: Selection) -> None:
    dwell = next(t.label for t in selection.problem.terms if t.name == "outlier_dwell")
    weight = {("bias[xy]", "quadratic[x]", dwell): 0.8, ("bias[xy]", "cross_quadratic[x]"): 0.2}
    chosen = believed(selection, weight)
    number = {term.label: k for k, term in enumerate(chosen.problem.terms)}

    def part(cause: str, other: str) -> float:
        """Share of what the cause adds to the chosen model that lies in the other model's span."""
        rest = columns("bias[xy]", other)
        added = off(rest, chosen.problem.target) - off(
            columns("bias[xy]", other, cause), chosen.problem.target
        )
        left = off(columns("bias[xy]", "cross_quadratic[x]"), added)
        return 1 - float(left @ left / (added @ added))

    def columns(*labels: str) -> Floats:
        return np.linalg.qr(np.hstack([chosen.problem.block(number[label]) for label in labels]))[0]

    def off(basis: Floats, rows: Floats) -> Floats:
        return np.asarray(rows - basis @ (basis.T @ rows))

    for cause, other in ((dwell, "quadratic[x]"), ("quadratic[x]", dwell)):
        name = cause.split("[")[0]
        stands = 0.2 * part(cause, other)
        share, present = votes(chosen, name)
        assert present == pytest.approx(0.8 + stands)
        assert share == pytest.approx({name: 0.8 / present, "cross_quadratic": stands / present})
    assert part(dwell, "quadratic[x]") < 0.2
    assert part("quadratic[x]", dwell) > 0.9


def test_a_name_beside_an_unknown_function_of_its_kind_may_be_a_piece_of_that(selection: Selection) -> None:
    unknown = next(
        t
        for t in selection.problem.terms
        if t.name is None and t.covariates == ("angle",) and t.enters_angle
    )
    weight = {("bias[xy]", "quadratic[x]"): 0.7, ("bias[xy]", "quadratic[x]", unknown.label): 0.3}
    share, _ = votes(believed(selection, weight), "quadratic")
    assert share == pytest.approx({"quadratic": 0.7, "unnamed: angle": 0.3})


def test_a_name_beside_a_smooth_function_of_its_kind_may_be_a_piece_of_that(selection: Selection) -> None:
    alone = believed(selection, {("bias[xy]", "quadratic[x]"): 1.0})
    smooth = next(t for t in nameless_terms(alone.data) if t.covariates == ("angle",))
    averaged = cast("AveragedFit", SimpleNamespace(smooth=smooth, weight=0.6))
    assert votes(alone, "quadratic", averaged)[0] == pytest.approx(
        {"quadratic": 0.4, "unnamed: angle": 0.6}
    )
    assert votes(alone, "bias", averaged)[0] == pytest.approx({"bias": 1.0})
    assert judge(alone, averaged).rejected == {"quadratic": "may be a piece of the same unnamed cause"}
    assert judge(alone, averaged).accepted == ("bias",)
    of_time = next(t for t in nameless_terms(alone.data) if t.covariates == ("time",))
    slow = cast("AveragedFit", SimpleNamespace(smooth=of_time, weight=0.6))
    assert votes(alone, "quadratic", slow)[0] == pytest.approx({"quadratic": 1.0})
    assert set(judge(alone, slow).accepted) == {"bias", "quadratic"}


def test_causes_led_by_one_function_without_a_name_have_one_set_and_by_one_name_each_its_own() -> None:
    causes = ("bias", "quadratic", "cubic", "unnamed: angle")
    led = [CredibleSet(cause, ("cross_quadratic", cause), (0.6, 0.4), 1.0) for cause in causes[:2]]
    led += [CredibleSet(cause, ("unnamed: angle",), (1.0,), 1.0) for cause in causes[2:]]
    likelier = {"cubic": "unnamed: angle"}
    assert [one.cause for one in merge_by_function(led, likelier)] == ["bias", "quadratic", "cubic"]


def test_a_page_does_not_name_slips_and_a_smooth_function_for_the_same_readings(tmp_path: Path) -> None:
    # A worn tooth: harmonics and a slip do a part of it, a process of the angle the rest.
    write(tmp_path / "session.csv", *draw("beyond", 77123, 86))
    result = trace(load_session(tmp_path / "session.csv"))
    assert result.unnamed is not None
    assert result.unnamed.covariates == ("angle",)
    assert [finding.effect for finding in result.found] == ["bias"]
    assert sorted(one.names for one in result.sets) == [("bias",), ("unnamed: angle",)]


def test_a_process_that_is_adequate_outweighs_formulas_that_are_not(tmp_path: Path) -> None:
    # A chirp is no formula of the grammar.
    def formulas(index: int) -> Selection:
        write(tmp_path / "session.csv", *draw("beyond", 41, index))
        data = readings_of(load_session(tmp_path / "session.csv")).training
        return select(data, [*named_terms(data)[0], *nameless_terms(data)], 6)

    chirps = itertools.count(list(BEYOND).index("chirp_of_time"), len(BEYOND))
    chosen = next(one for one in map(formulas, chirps) if not one.adequate)
    averaged = average(chosen)
    assert averaged is not None
    final = chosen.with_fit(averaged)
    assert final.adequate
    assert final.inflation == 1.0
    assert "time" in averaged.smooth.covariates


def test_a_name_is_not_found_where_its_set_holds_a_function_without_one_for_likelier(
    tmp_path: Path,
) -> None:
    # The whole part turns with the temperature; in one plane a misalignment of one axis does half of it.
    path = tmp_path / "blind.csv"
    write(path, *draw("uncatalogued", 1263815290, 7))
    result = trace(load_session(path))
    assert [one.names for one in result.sets if one.names != ("bias",)] == [
        ("unnamed: temperature", "misalignment_temperature")
    ]
    assert [finding.effect for finding in result.found] == ["bias"]
    assert "unnamed: temperature" in result.reasons["misalignment_temperature"]
