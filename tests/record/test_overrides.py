"""What a file should have said: each correction mends what it is for, and is recorded."""

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.fitting import fit
from adis_gonio.record.loading import Overrides, load_session
from fakes import planar_session as planar


@pytest.fixture
def file(tmp_path):
    def write(*keys, name="s.csv", **rows):
        path = tmp_path / name
        path.write_text(planar.text(planar.rows(**rows), *keys), encoding="utf-8")
        return path

    return write


def assert_right(result):
    for name, truth in (("delta_k", planar.DELTA_K), ("delta_phi", planar.DELTA_PHI_DEG)):
        assert abs(result[name].value - truth) < 4 * result[name].u + 1e-12


def test_a_reversed_session_is_refused_and_then_fitted_right(file):
    path = file("accel_unit: mg", "sensor: generic", turned=-1)
    with pytest.raises(DataError, match="--reverse"):
        fit(load_session(path))
    session = load_session(path, Overrides(reverse=True))
    result = fit(session)
    assert_right(result)
    assert result.as_dict()["overrides"] == {"reverse": {"old": False, "new": True}}
    assert any("the stage turned the other way" in note for note in session.notes)


def test_a_right_session_that_is_reversed_is_told_to_leave_it_out(file):
    path = file("accel_unit: mg", "sensor: generic")
    with pytest.raises(DataError, match="leave --reverse out"):
        fit(load_session(path, Overrides(reverse=True)))


def test_two_positions_of_a_reversed_stage_have_their_closed_form(file):
    path = file("accel_unit: mg", "sensor: generic", turned=-1, angles=(0.0, 90.0))
    result = fit(load_session(path, Overrides(reverse=True)))
    assert result.method == "two-position"
    assert_right(result)


def test_reversing_turns_angle_and_approach_and_leaves_what_is_unknown():
    from adis_gonio.model.records import Dwell, Session

    def dwell(k, **more):
        return Dwell(k, np.array([float(k)]), np.ones((1, 2)), **more)

    session = Session(
        (dwell(0, angle_deg=0.0, approach=1), dwell(1), dwell(2, angle_deg=30.0, approach=-1))
    )
    a, b, c = Overrides(reverse=True).apply(session).dwells
    assert [(d.angle_deg, d.approach) for d in (a, b, c)] == [(0.0, -1), (None, 0), (-30.0, 1)]
    assert math.copysign(1, a.angle_deg) == 1
    with pytest.raises(UsageError, match="nothing to reverse"):
        Overrides(reverse=True).apply(replace(session, dwells=(dwell(0),)))


def test_an_angle_that_was_noted_wrong_is_mended_and_recorded(file):
    path = file("accel_unit: mg", "sensor: generic")
    old = load_session(path)
    number = old.dwells[2].position
    session = load_session(path, Overrides(angles={number: 33.0}))
    angles = [dwell.angle_deg for dwell in old.dwells]
    assert [dwell.angle_deg for dwell in session.dwells] == [*angles[:2], 33.0, *angles[3:]]
    change = session.facts["overrides"]["angles"]
    assert (change["old"], change["new"]) == ({str(number): angles[2]}, {str(number): 33.0})
    last = old.dwells[-1].position
    with pytest.raises(UsageError, match=f"--angles 99=1: .*numbers go from 0 to {last}"):
        load_session(path, Overrides(angles={99: 1.0}))
    with pytest.raises(UsageError, match="no declared angles of a plane"):
        Overrides(angles={0: 1.0}).apply(replace(old, plane="none"))


def test_twice_reversed_is_the_session(file):
    session = load_session(file("accel_unit: mg"))
    again = Overrides(reverse=True).apply(Overrides(reverse=True).apply(session))
    assert [(d.angle_deg, d.approach) for d in again.dwells] == [
        (d.angle_deg, d.approach) for d in session.dwells
    ]


def test_a_wrong_unit_is_mended_by_its_override(file):
    path = file("sensor: generic", "accel_unit: mg", scale=9.80665e-3)
    with pytest.raises(DataError, match=r"--unit mps2"):
        fit(load_session(path))
    session = load_session(path, Overrides(accel_unit="mps2"))
    assert_right(fit(session))
    assert session.facts["overrides"] == {"accel_unit": {"old": "mg", "new": "mps2"}}


def test_gravity_and_fixture_replace_what_the_file_says_and_the_words_name_both(file):
    path = file("accel_unit: mg", "sensor: generic", "gravity_mps2: 9.80665", "fixture_sigma_deg: 0.5")
    session = load_session(
        path, Overrides(gravity_mps2=9.81, fixture_sigma_deg=math.inf, sensor="adis16350")
    )
    assert (session.gravity_mps2, session.sensor) == (9.81, "adis16350")
    assert session.free_attitudes
    assert session.facts["overrides"] == {
        "gravity_mps2": {"old": 9.80665, "new": 9.81},
        "fixture_sigma_deg": {"old": 0.5, "new": "free"},
        "sensor": {"old": "generic", "new": "adis16350"},
    }
    (note,) = session.notes
    for words in (
        "gravity 9.81 m/s² instead of 9.80665",
        "free instead of 0.5°",
        "adis16350 instead of generic",
    ):
        assert words in note


def test_what_the_file_says_already_is_no_override(file):
    session = load_session(file("accel_unit: mg"), Overrides(accel_unit="mg", gravity_mps2=9.80665))
    assert "overrides" not in session.facts
    assert session.notes == ()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"gravity_mps2": -1.0}, "gravity is -1"),
        ({"gravity_mps2": math.nan}, "gravity is nan"),
        ({"fixture_sigma_deg": -0.1}, "fixture is -0.1"),
        ({"fixture_sigma_deg": math.nan}, "fixture is nan"),
        ({"accel_unit": "furlong"}, "known are lsb"),
        ({"sensor": "adis16000"}, "known are adis16354"),
    ],
)
def test_values_that_no_session_can_have_are_refused(wrong, words):
    with pytest.raises(UsageError, match=words):
        Overrides(**wrong)
