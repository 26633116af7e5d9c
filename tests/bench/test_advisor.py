"""The advisor that traces a session: the measurements of a trace that it asks for, and when it ends."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.bench.advisor import AT_ONCE, TraceAdvisor
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.plans import Position
from adis_gonio.tracing.proposals import LEAST_SEPARATION
from adis_gonio.tracing.trace_result import NextDwell

TRACE = import_module("adis_gonio.tracing.trace")  # the package has a function of this name


def measurement(angle: float, **changes: object) -> NextDwell:
    made = NextDwell(angle, None, 1, 0.0, 5.0, 0.5, "decide", (("quadratic",), ("asymmetry",)), "measure")
    return replace(made, **changes)


def advised(monkeypatch, measurements, *, adequate=True, tested=True, visited=0, reach=None, dwells=0):
    error = SimpleNamespace(chi2_per_dof=1.0 if tested else None, as_dict=lambda: {})
    result = SimpleNamespace(
        adequate=adequate and tested,
        tested=tested,
        after=error,
        found=(),
        steps=(),
        confounded=(),
        measurements=measurements,
    )
    monkeypatch.setattr(TRACE, "trace", lambda session: result)
    session = Session((Dwell(1, np.zeros(1), np.zeros((1, 3)), 0.0),) * dwells)
    return TraceAdvisor().advise(session, visited, reach or (lambda position: True))


def test_it_asks_for_a_few_at_once_and_never_for_more_than_24_by_default(monkeypatch):
    many = tuple(measurement(15.0 * k) for k in range(7))
    assert len(advised(monkeypatch, many).positions) == AT_ONCE
    assert len(advised(monkeypatch, many, visited=22).positions) == 2
    said = advised(monkeypatch, many, visited=24)
    assert said.positions == ()
    assert said.ended == "the limit of further positions is reached (24 were added); not all is decided"


def test_a_model_that_is_adequate_is_left_alone_with_what_nothing_asks_for(monkeypatch):
    only_unseen = (measurement(45.0, purpose="cover"),)
    said = advised(monkeypatch, only_unseen)
    assert said.positions == ()
    assert said.ended == "the model is adequate, and no further position would decide anything more"
    assert advised(monkeypatch, only_unseen, tested=False).positions == (Position(45.0),)


@pytest.mark.parametrize(
    ("adequate", "dwells", "asks"), [(True, 23, False), (False, 23, True), (False, 24, False)]
)
def test_a_position_that_decides_little_is_asked_for_while_few_dwells_contradict_the_model(
    monkeypatch, adequate, dwells, asks
):
    weak = (measurement(45.0, separation=0.9 * LEAST_SEPARATION), measurement(90.0, purpose="cover"))
    said = advised(monkeypatch, weak, adequate=adequate, dwells=dwells)
    assert said.positions == ((Position(45.0),) if asks else ())
    assert advised(monkeypatch, (measurement(45.0, separation=LEAST_SEPARATION),), dwells=dwells).positions


@pytest.mark.parametrize(
    ("asked", "position"),
    [
        (measurement(45.0, approach=-1), Position(45.0, -1)),
        (measurement(45.0, approach=0), Position(45.0, 1)),
        (
            replace(measurement(0.0, approach=0), angle_deg=None, direction=(0.0, 0.0, 1.0)),
            Position(None, 0, direction=(0.0, 0.0, 1.0)),
        ),
    ],
)
def test_an_angle_without_a_direction_of_travel_is_approached_from_below(monkeypatch, asked, position):
    assert advised(monkeypatch, (asked,)).positions == (position,)


def test_a_model_that_is_not_adequate_and_has_no_advice_left_says_so(monkeypatch):
    assert advised(monkeypatch, (), adequate=False).ended.startswith("the advice is exhausted")


def test_what_cannot_be_reached_ends_the_loop_without_calling_the_model_adequate(monkeypatch):
    late = (measurement(45.0, wait_s=600.0),)
    said = advised(monkeypatch, late, reach=lambda position: position.wait_s == 0.0)
    assert said.positions == ()
    assert said.ended.startswith("the advice is exhausted: no position that can be reached")
    (asked,) = advised(monkeypatch, late).positions
    assert asked.wait_s == 600.0
