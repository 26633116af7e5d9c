"""The benchmark of disturbances that the catalogue does not know: kinds, sessions, oracle, scores."""

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from strangers.bench import draw_bench
from strangers.kinds import ENTRIES, FAMILIES, KINDS
from strangers.score import judge, rate_table, verdict_of, verdict_record, wilson
from strangers.session import (
    Oracle,
    consult_oracle,
    draw_session,
    dwell_means,
    kind_of,
    noise_alone,
    session_of,
)

ROOT = Path(__file__).resolve().parents[2]
ORACLE = Oracle(
    check_mg=0.1,
    fit_mg=0.1,
    check_deg=0.01,
    bias_check_mg=0.5,
    bias_fit_mg=0.5,
    bias_check_deg=0.05,
    log_likelihood_gain=99,
)


def draw(name, seed=3):
    return draw_session(KINDS[name], np.random.default_rng(seed))


@pytest.mark.parametrize("name", sorted(KINDS))
def test_a_kind_is_finite_repeats_by_its_seed_and_is_visible(name):
    first, again, other = draw(name), draw(name), draw(name, 4)
    assert np.isfinite(first.basis_mg).all()
    assert first.csv == again.csv
    assert not np.array_equal(first.basis_mg, other.basis_mg)
    # The true shape has one parameter, so noise alone would give a gain of about one half.
    assert consult_oracle(first).log_likelihood_gain > 10
    kind = first.kind
    assert kind.family in FAMILIES
    assert kind.enters in ENTRIES
    assert kind.causes
    assert kind.origin


def test_each_family_has_fifteen_kinds():
    assert all(sum(kind.family == family for kind in KINDS.values()) >= 15 for family in FAMILIES)


def test_a_run_has_each_kind_before_one_repeats():
    assert {kind_of(index, 5).name for index in range(len(KINDS))} == set(KINDS)
    assert [kind_of(index, 5) for index in range(9)] != [kind_of(index, 6) for index in range(9)]


def test_fair_names_are_in_the_catalogue():
    command = [sys.executable, "-m", "adis_gonio", "simulate", "--list-effects"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    catalogue = {line.split()[0] for line in listed.splitlines() if line[:1].isalpha()}
    assert set().union(*(kind.fair for kind in KINDS.values())) <= catalogue


def test_the_file_holds_the_true_model_and_the_disturbance():
    session = draw("popcorn")
    bench = session.bench
    psi = bench.alpha_rad - np.radians(bench.angle_deg)
    gravity = 1000 * np.column_stack(
        [bench.scales[0] * np.cos(psi), bench.scales[1] * np.sin(psi + bench.misalignment_rad)]
    )
    residual = dwell_means(session) - gravity - np.array(bench.bias_mg) - session.basis_mg
    allowed = np.hypot(bench.dwell_mg, 1000 * bench.fixture_rad)
    assert np.abs(residual).max() < 5 * allowed
    assert np.abs(residual + session.basis_mg).max() > np.abs(residual).max()


def test_noise_alone_refuses_the_oracle_about_as_often_as_it_should():
    outcomes = []
    for seed in range(60):
        session = draw("knocked_part", seed)
        outcomes.append(noise_alone(session.bench, False, consult_oracle(session).fit_mg))
    assert np.mean(np.array(outcomes) < 0.05) < 0.15
    assert min(noise_alone(session.bench, False, 2 * session.bench.dwell_mg), 1) < 1e-6


def test_the_direction_of_approach_is_the_direction_of_the_last_move():
    for seed in range(8):
        bench = draw_bench(np.random.default_rng(seed))
        moves = np.diff(bench.travel_deg)
        assert (moves * bench.approach[1:] >= 0).all()
        np.testing.assert_allclose(np.cos(np.radians(moves - np.diff(bench.angle_deg))), 1)


def document(names, unnamed=None, adequate=True, check_mg=0.12, base=None):
    return {
        "adequate": adequate,
        "found": [{"effect": name, "probability": value} for name, value in names.items()],
        "unnamed": unnamed,
        "error": {
            "after": {"heldout_rms_mg": check_mg, "residual_rms_mg": 0.1, "angle_rms_deg": 0.01},
        },
        "base": base or {},
    }


def test_a_verdict_tells_wrong_names_and_covariates_from_right_ones():
    session = draw("regulator_dropout")
    names = {"bias": 1.0, "supply_bias": 0.999, "warm_up": 0.97}
    verdict = judge(session, ORACLE, document(names, {"covariates": ["supply"], "probability": 0.96}))
    assert verdict.names == {"supply_bias": 0.999, "warm_up": 0.97}
    assert verdict.wrong == {"warm_up": 0.97}
    assert verdict.covariates_right
    other = judge(session, ORACLE, document({}, {"covariates": ["supply", "time"], "probability": 0.99}))
    assert not other.covariates_right
    table = {line[:44].strip(): line[44:].split() for line in rate_table([verdict, other]).splitlines()}
    assert table["a wrong name is found"][:3] == ["1", "of", "2"]
    assert table["a wrong name has more than 95 %"][:3] == ["1", "of", "2"]
    assert table["names at 99.9 % are fair"][:3] == ["1", "of", "1"]
    assert table["covariates above 95 % are right"][:3] == ["1", "of", "2"]
    assert verdict_of(json.loads(json.dumps(verdict_record(verdict)))) == verdict


def test_adequate_is_judged_by_the_true_noise():
    session = draw("popcorn")
    noise = session.bench.dwell_mg
    quiet = document({}, check_mg=0.5 * noise)
    quiet["error"]["after"]["residual_rms_mg"] = 0.5 * noise
    assert not judge(session, ORACLE, quiet).residual_left
    assert judge(session, ORACLE, document({}, check_mg=4 * noise)).residual_left


def test_coverage_counts_only_kinds_without_a_part_in_the_gains():
    session = draw("popcorn")
    x, y = session.bench.scales
    base = {"scale_x": {"value": x + 0.002, "U": 0.001}, "delta_k": {"value": x / y - 1, "U": 0.001}}
    errors = judge(session, ORACLE, document({}, base=base)).errors_in_u
    assert errors["scale_x"] == pytest.approx(2)
    assert errors["delta_k"] == pytest.approx(0, abs=1e-9)
    assert judge(draw("activity_dip"), ORACLE, document({}, base=base)).errors_in_u == {}


def test_wilson_agrees_with_a_published_value():
    # Newcombe 1998, table I: 81 of 263.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)
    assert math.isclose(wilson(0, 10)[0], 0.0, abs_tol=1e-12)


def test_a_session_is_traced_from_its_file(tmp_path):
    command = [sys.executable, "-m", "benchmarks.strangers", "--seed", "11", "--only", "1"]
    subprocess.run([*command, "--csv", str(tmp_path / "one.csv")], cwd=ROOT, check=True, timeout=300)
    assert (tmp_path / "one.csv").read_text(encoding="utf-8") == session_of(1, 11).csv
    done = subprocess.run(command, cwd=ROOT, check=True, timeout=300, capture_output=True, text=True)
    assert "1 sessions, 1 kinds" in done.stdout
    assert "failed" not in done.stdout
