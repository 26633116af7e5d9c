"""Sessions that nobody planned: few poses, odd columns. All end in a result or in an error of our own."""

import numpy as np
import pytest

from adis_gonio import trace
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.model.records import Dwell, Session
from tracing.odd_sessions import ending

FACES = np.vstack([np.eye(3), -np.eye(3)])


def session(directions, bias=(5.0, -3.0, 8.0), u=0.1, seed=0, **keys) -> Session:
    """Dwells of 20 samples in the directions (n, 3), `u` mg a reading."""
    rng = np.random.default_rng(seed)
    dwells = []
    for k, unit in enumerate(directions):
        accel = 1000 * np.asarray(unit) + bias + u * np.sqrt(20) * rng.standard_normal((20, 3))
        dwells.append(Dwell(k, 10.0 * k + 0.1 * np.arange(20), accel))
    keys = {"accel_unit": "mg", "plane": "none", "sensor": "generic", **keys}
    return Session(tuple(dwells), **keys)


def tilted(faces, degrees, seed):
    rng = np.random.default_rng(seed)
    out = faces + np.radians(degrees) * rng.standard_normal(faces.shape)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


@pytest.mark.parametrize(("turns", "degrees"), [(1, 0.0), (1, 0.5), (1, 1.0), (2, 0.0), (2, 1.0)])
def test_six_faces_show_a_bias_and_what_they_cannot_tell_it_from(turns, degrees):
    result = trace(session(tilted(np.tile(FACES, (turns, 1)), degrees, 3)))
    assert [finding.effect for finding in result.found] == ["bias"]
    values = result.found[0].parameters
    for axis, truth in zip("xyz", (5, -3, 8), strict=True):
        assert abs(values[f"bias_{axis}"].value - truth) < 5 * 0.1
    if turns == 1:
        assert {"quadratic", "asymmetry"} <= {name for group in result.confounded for name in group}
    # Skews that the faces do not show are said to be so, not given as numbers.
    assert result.base["skew_xy"].u is None


def test_a_name_does_not_stand_on_a_model_that_leaves_nothing_to_check_it_by():
    wrong = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        unit = rng.standard_normal((8, 3))
        result = trace(session(unit / np.linalg.norm(unit, axis=1, keepdims=True), seed=seed))
        wrong += bool({finding.effect for finding in result.found} - {"bias"})
    assert wrong == 0


def test_free_attitudes_in_a_plane_keep_the_start_angle_where_it_is():
    rng = np.random.default_rng(1)
    dwells = []
    for k, angle in enumerate(np.arange(0, 360, 20.0)):
        psi = np.radians(12 - angle)
        accel = 1000 * np.array([np.cos(psi), np.sin(psi)]) + [5, -3] + 0.3 * rng.standard_normal((10, 2))
        dwells.append(Dwell(k, 10.0 * k + 0.1 * np.arange(10), accel, angle_deg=angle))
    made = Session(tuple(dwells), accel_unit="mg", sensor="generic", fixture_sigma_deg=np.inf)
    result = trace(made)
    assert [finding.effect for finding in result.found] == ["bias"]
    assert abs(result.base["alpha"].value - 12) < 1
    assert result.base["alpha"].u is None
    assert result.after.heldout_rms < 0.1 * result.before.heldout_rms


@pytest.mark.parametrize(
    ("scale", "unit", "words"),
    [(1e-3, "mg", "by accel_unit mg and"), (9.81e-3, "g", "by accel_unit g and")],
)
def test_another_unit_is_one_line(scale, unit, words):
    made = session(FACES, u=0.05)
    dwells = tuple(Dwell(d.position, d.time_s, scale * d.accel) for d in made.dwells)
    with pytest.raises(AdisGonioError, match=words):
        trace(Session(dwells, accel_unit=unit, plane="none", sensor="generic"))


def test_a_dead_axis_and_a_dwell_that_is_none_are_named():
    poses = tilted(np.tile(FACES, (2, 1)), 5.0, 0)
    with pytest.raises(AdisGonioError, match=r"readings of positions .*an axis is dead"):
        trace(session(poses * [1, 1, 0]))
    with pytest.raises(AdisGonioError, match="readings of position 12 are not 1 g long"):
        trace(session(np.vstack([poses, [[0, 0, 3.0]]])))


def test_a_session_that_is_all_for_checking_is_one_line():
    made = session(FACES)
    dwells = tuple(Dwell(d.position, d.time_s, d.accel, use="check") for d in made.dwells)
    with pytest.raises(AdisGonioError, match="for checking"):
        trace(Session(dwells, accel_unit="mg", plane="none", sensor="generic"))


@pytest.mark.parametrize("seed", range(8))
def test_any_small_session_ends_in_a_result_or_an_error_of_our_own(seed):
    """scripts/small_sessions.py does it for thousands of seeds."""
    assert "\n" not in ending(seed)
