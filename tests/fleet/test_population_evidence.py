"""Evidence of a session: what it is against the whole fit, and that it comes back from JSON."""

import json
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fleet.session_evidence import SessionEvidence, evidence_of
from adis_gonio.model.effects import effect
from fleet.units import estimate, evidence_with, session_with
from tracing.named_truth import catalogued_term
from tracing.plans import draw_bench

HYSTERESIS = "hysteresis||x|hysteresis_x|mg"


def test_an_estimate_is_that_of_the_full_nonlinear_fit() -> None:
    rng = np.random.default_rng(3)
    session = session_with(draw_bench(rng), rng, [catalogued_term("hysteresis", "x", 0.0)])
    evidence = evidence_of(session)
    data = readings_of(session).training
    terms = tuple(
        NamedTerm(name, (), 0.0, effect(name, axes)) for name, axes in (("bias", "xy"), ("hysteresis", "x"))
    )
    fit = Fit.begin(data).with_terms(terms, (np.zeros(2), np.zeros(1))).refit()
    value, u = estimate(evidence, HYSTERESIS)
    assert value == pytest.approx(float(fit.values.terms[1][0]), abs=0.05 * u)
    assert u == pytest.approx(float(np.sqrt(fit.covariance[-1, -1])), rel=0.01)


def test_scores_of_sessions_without_an_effect_are_standard_normal() -> None:
    rng = np.random.default_rng(8)
    every = [evidence_with(rng, []) for _ in range(40)]
    z = np.concatenate([one.z for one in every])
    assert abs(z.std() - 1) < 0.1
    ratio = [part.chi2 / part.dof for one in every for part in one.scatter]
    assert 0.85 < np.mean(ratio) < 1.15


def test_evidence_comes_back_from_json() -> None:
    evidence = evidence_with(np.random.default_rng(1), [])
    text = json.dumps(evidence.as_dict())
    again = SessionEvidence.from_dict(json.loads(text))
    assert again.keys == evidence.keys
    assert again.z == pytest.approx(evidence.z, rel=1e-4, abs=1e-9)
    was, now = (one.directions.T @ one.directions for one in (evidence, again))
    assert np.abs(was - now).max() < 2e-4
    assert len(text) < 60_000


def test_what_was_not_recorded_is_said() -> None:
    rng = np.random.default_rng(2)
    session = session_with(draw_bench(rng), rng, [])
    bare = replace(session, dwells=tuple(replace(d, temperature_c=None) for d in session.dwells))
    assert "temperature" in evidence_of(bare).missing["bias_temperature"]
