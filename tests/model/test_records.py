"""Records of measured data: series, columns, turns of a recording, the stage's certificate, gravity."""

import math

import numpy as np
import pytest

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.model.records import Dwell, Session, StageCurve, Turn, checked_gravity_mps2

TIME_S = 0.5 * np.arange(12)


def dwell(position: int, first: int, last: int, **more) -> Dwell:
    """Rows `first` to `last` of a recording, without the last."""
    rows = slice(first, last)
    return Dwell(position, TIME_S[rows], np.arange(36.0).reshape(12, 3)[rows], **more)


def recorded(*dwells: Dwell, free_turn: bool = False) -> Session:
    whole = dwell(0, 0, 12, temperature_c=20 + TIME_S)
    return Session(dwells, recording=whole, free_turn=free_turn)


def test_turns_are_the_samples_of_a_recording_between_its_dwells():
    session = recorded(dwell(1, 1, 4), dwell(2, 6, 9, turned_deg=-90.0), dwell(5, 9, 11))
    first, empty = session.turns
    assert (first.before, first.position, first.turned_deg) == (1, 2, -90.0)
    assert first.time_s.tolist() == [2.0, 2.5]
    assert first.accel.tolist() == [[12, 13, 14], [15, 16, 17]]
    assert first.temperature_c.tolist() == [22.0, 22.5]
    assert first.gyro is None
    assert (len(empty), empty.before, empty.position) == (0, 2, 5)
    assert recorded(dwell(1, 1, 4), dwell(2, 6, 9), free_turn=True).turns == ()
    assert Session((dwell(1, 1, 4), dwell(2, 6, 9))).turns == ()


def test_turns_of_a_file_are_those_between_dwells_that_are_still_there():
    every = tuple(Turn(k, k + 1, TIME_S[:1], np.zeros((1, 3))) for k in range(4))
    session = Session(tuple(dwell(k, k, k + 1) for k in (1, 2, 4)), turns_from=lambda: every)
    assert [(turn.before, turn.position) for turn in session.turns] == [(1, 2)]


def test_columns_are_those_that_any_dwell_states():
    one = dwell(3, 0, 2, angle_deg=90.0, supply_v=np.array([5.0, 5.1]))
    columns = one.columns()
    assert list(columns) == ["time_s", "position", "angle_deg", "ax", "ay", "az", "supply_v"]
    assert columns["position"].tolist() == [3, 3]
    assert columns["ay"].tolist() == [1.0, 4.0]
    assert columns["supply_v"].tolist() == [5.0, 5.1]
    other = dwell(4, 2, 5, approach=-1, use="check", supply_v=np.array([5.2] * 3))
    angle, approach, use = (
        Session((one, other)).columns()[name] for name in ("angle_deg", "approach", "use")
    )
    assert angle[0].tolist() == [90.0, 90.0]
    assert np.isnan(angle[1]).all()
    assert [part.tolist() for part in approach] == [[0, 0], [-1, -1, -1]]
    assert [part.tolist() for part in use] == [["fit"] * 2, ["check"] * 3]


def test_the_columns_of_a_free_turn_are_its_recording_without_a_position():
    columns = recorded(dwell(1, 1, 4), free_turn=True).columns()
    assert "position" not in columns
    assert [len(part) for part in columns["ax"]] == [12]


def test_series_that_only_some_dwells_have_and_no_dwell_at_all_are_refused():
    some = Session((dwell(1, 0, 2, supply_v=np.ones(2)), dwell(7, 2, 4)), source="a.csv")
    with pytest.raises(DataError, match=r"a\.csv: position 7 has no 'supply_v'"):
        some.columns()
    with pytest.raises(DataError, match="no dwell"):
        Session(()).columns()


def test_records_show_what_they_hold():
    assert repr(dwell(3, 0, 2, angle_deg=90.0)) == "Dwell(3: 90°, 2 samples)"
    assert repr(dwell(3, 0, 1)) == "Dwell(3: no angle, 1 sample)"
    assert repr(Turn(1, 2, TIME_S[:4], np.zeros((4, 3)))) == "Turn(1 to 2: 4 samples)"
    session = Session((dwell(1, 0, 2), dwell(2, 2, 5)), title="a\nb")
    assert repr(session) == "Session(a b: 2 dwells, 5 samples, adis16354)"
    assert "a free turn, 12 samples" in repr(recorded(free_turn=True))


def test_facts_of_the_file_have_the_filter_if_they_are_known():
    assert Session((), facts={"configuration": {"filter_m": 4}}).filter_m == 4
    assert Session((), facts={"configuration": None}).filter_m is None
    assert Session(()).filter_m is None


def test_gravity_is_stated_in_thousandths_of_the_standard_one():
    assert Session((), gravity_mps2=9.81).gravity_mg == pytest.approx(1000.34161, abs=1e-5)


def test_a_fixture_of_infinite_uncertainty_leaves_the_attitudes_free():
    assert Session((), fixture_sigma_deg=math.inf).free_attitudes
    assert not Session((), fixture_sigma_deg=5.0).free_attitudes
    assert not Session(()).free_attitudes


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (981.0, "981 cm/s² (Gal) are 9.81 m/s²"),
        (981000.0, "981000 mGal are 9.81 m/s²"),
        (1.0, "1 g are 9.80665 m/s²"),
        (1000.0, "1000 mg are 9.80665 m/s²"),
        (32.174, "32.174 ft/s² are 9.80664 m/s²"),
    ],
)
@pytest.mark.parametrize("anywhere", [False, True])
def test_gravity_in_another_unit_is_refused_with_the_unit(value, told, anywhere):
    with pytest.raises(UsageError) as caught:
        checked_gravity_mps2(value, anywhere=anywhere)
    assert told in str(caught.value)


def test_gravity_on_earth_is_taken_and_that_of_the_moon_if_the_user_says_so():
    # Huascarán and the Arctic Ocean: the extremes of a global model (Hirt et al. 2013).
    for value in (9.7, 9.7639, 9.8337, 9.9):
        assert checked_gravity_mps2(value) == value
    for value in (1.62, 9.6, math.nan):
        with pytest.raises(UsageError, match=r"9\.7 to 9\.9 on Earth; for another place"):
            checked_gravity_mps2(value)
    assert checked_gravity_mps2(1.62, anywhere=True) == 1.62
    for value in (0.0, -9.81, math.inf, math.nan):
        with pytest.raises(UsageError):
            checked_gravity_mps2(value, anywhere=True)


def curve(*angle_deg: float) -> StageCurve:
    n = len(angle_deg)
    return StageCurve("k.xml", np.array(angle_deg), 0.01 * np.arange(n), 1e-6 * np.eye(n))


def test_a_certificate_covers_angles_between_steps_of_at_most_45_degrees():
    covered = curve(0.0, 45.0, 90.0, 135.5, 180.0, 225.0, 270.0, 315.0)
    covered.check([10.0, 90.0, None, 135.5, 350.0, -20.0, 400.0])
    for wrong in (100.0, 135.4, 90.1 - 360):
        with pytest.raises(UsageError, match="no errors of the stage near"):
            covered.check([10.0, wrong])
    with pytest.raises(UsageError, match="no angle is declared"):
        covered.check([None])


def test_a_certificate_across_zero_is_read_back_and_interpolated_over_the_turn():
    made = curve(20.0, 60.0, 340.0)
    made.check([0.0, 350.0, 19.0])
    with pytest.raises(UsageError):
        made.check([200.0])
    there, root = made.at(np.array([40.0, 0.0, -10.0]))
    assert there == pytest.approx([0.005, 0.01, 0.015])
    assert (root**2).sum(axis=1) == pytest.approx(1e-6 * np.array([1 / 2, 1 / 2, 5 / 8]))
    again = StageCurve.of(made.as_dict())
    assert again.digest == made.digest
    assert again.at(np.array([40.0]))[0] == pytest.approx([0.005])
    assert curve(20.0, 60.0, 341.0).digest != made.digest
