"""Turns between poses in space: the integral of attitude, links as equations, and gyros that are false."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import adis_gonio
from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.fitting import fit
from adis_gonio.fitting.answer import Answer
from adis_gonio.fitting.determination import covariance, determine, names_of, natural_units
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.links import LinkRows, Links
from adis_gonio.fitting.estimation.readings import Readings, from_means, readings_of
from adis_gonio.fitting.gyros.gyro_fit import fit_gyro
from adis_gonio.fitting.linked import (
    PARAMETERS,
    Attitude,
    GyroPrior,
    Leg,
    judge_links,
    linked_readings,
    probable_gyros,
)
from adis_gonio.fitting.methods import fit_of, fit_readings
from adis_gonio.fitting.uncertainty import by_rotation_of, response_of
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import sensitivity
from adis_gonio.model.records import Session
from adis_gonio.sim import World, WorldSettings
from fitting.gyros.simulated import Recorder
from typical_gyros import draw_gyros

NOISE = 0.05 * np.eye(3)


# -- the integral of attitude -----------------------------------------------------------------------------


def _rate_dps(time_s: Floats) -> Floats:
    """A turn about an axis that wanders, from rest to rest."""
    course = 90 * np.sin(np.pi * time_s / 2) ** 2
    return np.stack([course, course * np.sin(3 * time_s), 60 * np.sin(np.pi * time_s) ** 2], axis=-1)


def _gyros(rng: np.random.Generator) -> Floats:
    gains = np.eye(3) + 0.02 * rng.standard_normal((3, 3))
    return np.concatenate([gains.ravel(), 0.1 * rng.standard_normal(9), np.zeros(3)])


def attitude(
    time: Floats, read: Floats, force: Floats, gyros: Floats, noise: Floats, size: Floats
) -> Attitude:
    nothing = np.zeros((3, 3))
    leg = Leg((0, 1), time, read, force, size, nothing[0], nothing, nothing[:, :2], nothing[0])
    return leg.attitude(gyros, noise)


def test_attitude_is_that_of_the_differential_equation_and_of_rotations_in_fine_steps() -> None:
    gyros = _gyros(np.random.default_rng(1))
    time = np.linspace(0, 2, 1640)
    force = np.stack([np.sin(time), np.cos(time), 0.3 * time], axis=1)
    read = _rate_dps(time) @ gyros[:9].reshape(3, 3).T + force @ gyros[9:18].reshape(3, 3).T
    found = attitude(time, read, force, gyros, NOISE, np.abs(read))

    solved = solve_ivp(
        lambda t, u: -np.cross(np.radians(_rate_dps(t)), u.reshape(3, 3).T).T.ravel(),
        (0, 2), np.eye(3).ravel(), method="DOP853", rtol=1e-11, atol=1e-12,
    )  # fmt: skip
    assert found.rotation == pytest.approx(solved.y[:, -1].reshape(3, 3), abs=2e-6)

    fine = np.linspace(0, 2, 20001)
    middle = (fine[1:] + fine[:-1]) / 2
    whole = Rotation.identity()
    for step in Rotation.from_rotvec(-np.radians(_rate_dps(middle)) * np.diff(fine)[:, None]):
        whole = step * whole
    assert found.rotation == pytest.approx(whole.as_matrix(), abs=2e-6)


def test_what_an_error_of_the_gyros_does_to_attitude_is_its_derivative() -> None:
    rng = np.random.default_rng(2)
    time = np.linspace(0, 2, 400)
    read, force = _rate_dps(time), np.stack([np.sin(time), np.cos(time), 0.3 * time], axis=1)
    begin = np.concatenate([_gyros(rng)[:9], 0.1 * rng.standard_normal(9), np.zeros(3)])

    def turned(values: Floats, zero: Floats) -> Floats:
        there = attitude(time, read - zero, force, values, NOISE, np.abs(read - force))
        return Rotation.from_matrix(there.rotation @ here.T).as_rotvec()

    magnitude = np.abs(read - force)
    found = attitude(time, read, force, begin, NOISE, magnitude)
    here = found.rotation
    step = 1e-5
    for k in range(PARAMETERS):
        by = step * np.eye(PARAMETERS)[k]
        slope = (turned(begin + by, np.zeros(3)) - turned(begin - by, np.zeros(3))) / (2 * step)
        assert found.by_parameter[:, k] == pytest.approx(slope, abs=2e-4)
    for k in range(3):
        by = step * np.eye(3)[k]
        slope = (turned(begin, by) - turned(begin, -by)) / (2 * step)
        assert found.by_zero[:, k] == pytest.approx(slope, abs=1e-5)


def _turned(time: Floats, read: Floats, force: Floats, gyros: Floats, noise: Floats) -> Floats:
    return attitude(time, read, force, gyros, noise, np.abs(read)).rotation


def test_noise_of_attitude_is_that_of_drawn_rates() -> None:
    rng = np.random.default_rng(3)
    time = np.linspace(0, 2, 300)
    read, force = _rate_dps(time), np.zeros((300, 3))
    perfect = np.concatenate([np.eye(3).ravel(), np.zeros(12)])
    spread = np.diag([0.2, 0.5, 1.0])
    found = attitude(time, read, force, perfect, spread, np.abs(read))
    root = np.sqrt(spread)
    drawn = [
        Rotation.from_matrix(
            _turned(time, read + rng.standard_normal((300, 3)) @ root, force, perfect, spread)
            @ found.rotation.T
        ).as_rotvec()
        for _ in range(800)
    ]
    assert np.cov(np.array(drawn).T) == pytest.approx(
        found.noise_rad2, abs=0.16 * np.abs(found.noise_rad2).max()
    )


# -- links as equations -----------------------------------------------------------------------------------

TRUE = np.array([1.004, 0.997, 1.002, 0.003, -0.002, 0.004])
BIAS_MG = np.array([12.0, -7.0, 20.0])
DRIFTING = 0.3


def linked_part(poses: int, rng: np.random.Generator) -> tuple[Readings, Links]:
    """Readings with noise of unequal axes and shared noise, and links whose neighbours correlate."""
    unit = rng.standard_normal((poses, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    m, q = poses - 1, 4
    modes = 2e-3 * rng.standard_normal((m, 3, q))
    roots = 4e-4 * (np.eye(3) + 0.3 * rng.standard_normal((m, 3, 3)))
    own = roots @ roots.transpose(0, 2, 1)
    following = np.zeros((m, 3, 3))
    following[:-1] = -0.25 * roots[:-1] @ roots[1:].transpose(0, 2, 1)
    rotation = np.empty((m, 3, 3))
    for k in range(m):
        axis = np.cross(unit[k], unit[k + 1])
        turned = Rotation.from_rotvec(
            axis / np.linalg.norm(axis) * np.arccos(unit[k] @ unit[k + 1])
        ) * Rotation.from_rotvec(rng.uniform(-1, 1) * unit[k])
        rotation[k] = turned.as_matrix()
    links = Links(
        np.arange(m), np.arange(1, poses), rotation, np.zeros((m, 3)), own, following, modes
    ).drawn(rng)
    # What was drawn stands in the rotations, as in a session: the prior's mean is zero.
    links = replace(
        links,
        rotation=Rotation.from_rotvec(-links.offset_rad).as_matrix() @ rotation,
        offset_rad=np.zeros((m, 3)),
    )
    spread = np.diag([0.2, 0.4, 0.6]) ** 2
    slow = DRIFTING * rng.standard_normal((poses, 3, 1)) * np.eye(3)[None, :, :1]
    noise = rng.standard_normal((poses, 3)) @ np.sqrt(spread) + slow @ rng.standard_normal(1)
    mean = 1000 * unit @ sensitivity(TRUE).T + BIAS_MG + noise
    data = from_means(
        mean, np.broadcast_to(spread, (poses, 3, 3)).copy(), Conditions(time_s=np.arange(poses) * 1.0)
    )
    return replace(data, slow=slow), links


def _full_least_squares(data: Readings, links: Links) -> tuple[Floats, Floats]:
    """Parameters and covariance with every attitude, rotation and mode as an unknown: no elimination."""
    m, q = len(links), links.modes_rad.shape[2]
    dense = block_diag(*links.own_rad2)
    for k in range(m - 1):
        dense[3 * k : 3 * k + 3, 3 * k + 3 : 3 * k + 6] = links.next_rad2[k]
        dense[3 * k + 3 : 3 * k + 6, 3 * k : 3 * k + 3] = links.next_rad2[k].T
    root = np.linalg.inv(np.linalg.cholesky(dense))
    white = np.linalg.inv(np.linalg.cholesky(data.own_covariance[0]))
    first = data.mean[0] / np.linalg.norm(data.mean[0])

    def left(x: Floats) -> Floats:
        base, bias, tilt, mode, drift = np.split(x[: 12 + q + 1], [6, 9, 12, 12 + q])
        own = x[13 + q :].reshape(m, 3)
        u = [Rotation.from_rotvec(tilt).apply(first)]
        for k in range(m):
            error = 4e-4 * own[k] + links.modes_rad[k] @ mode
            u.append(Rotation.from_rotvec(error).apply(links.rotation[k] @ u[-1]))
        ideal = 1000 * np.array(u) @ sensitivity(base).T + 1000 * bias + data.slow @ drift
        # Of the three ways to tilt the first direction one does nothing: it is held.
        return np.concatenate(
            [
                ((data.mean - ideal) @ white.T).ravel(),
                root @ (4e-4 * own).ravel(),
                mode,
                drift,
                [tilt @ first],
            ]
        )

    begin = np.concatenate([np.ones(3), np.zeros(3 + 3 + 3 + q + 1 + 3 * m)])
    found = least_squares(left, begin, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14, method="lm")
    inverse = np.linalg.inv(found.jac.T @ found.jac)
    return found.x[: 12 + q], inverse[:9, :9]


@pytest.mark.parametrize("poses", [5, 9])
def test_links_are_least_squares_with_all_attitudes_unknown(poses: int) -> None:
    data, links = linked_part(poses, np.random.default_rng(poses))
    found = determine(replace(data, links=links))
    natural = natural_units(data)
    whole, inverse = _full_least_squares(data, links)
    values, modes = whole[:9], whole[12:]
    own = found.fit.values.parameters / natural
    u = np.sqrt(np.diagonal(inverse))
    assert not found.held
    assert found.null.shape[1] == 0
    assert np.abs((own - values) / u).max() < 0.05
    stated = covariance(found.fisher, found.free, found.null)
    assert np.sqrt(np.diagonal(stated)) == pytest.approx(u, rel=0.02)
    assert probable_gyros(found.fit, _Fixed(links).prior) == pytest.approx(modes, abs=0.02)


def test_poses_that_gravity_alone_leaves_undetermined_are_determined_by_links() -> None:
    data, links = linked_part(5, np.random.default_rng(5))
    assert determine(data).null.shape[1] or determine(data).held
    linked = fit_readings(replace(data, links=links))
    assert linked.parameters.keys() == set(names_of(data.model))
    assert not linked.undetermined


def test_slopes_by_readings_and_rotations_are_those_of_a_fit_made_anew() -> None:
    data, links = linked_part(7, np.random.default_rng(7))
    data = replace(data, links=links)
    found = determine(data)
    inverse, natural = covariance(found.fisher, found.free, found.null), natural_units(data)
    by_reading = response_of(found.fit, inverse, natural)
    by_rotation = by_rotation_of(found.fit, inverse, natural)
    assert by_rotation is not None

    def anew(**changed: object) -> Floats:
        return found.refitted(replace(found.fit.data, **changed)).values.parameters / natural

    rng = np.random.default_rng(0)
    for _ in range(3):
        by = rng.standard_normal(data.mean.shape)
        step = 0.02
        slope = (anew(mean=data.mean + step * by) - anew(mean=data.mean - step * by)) / (2 * step)
        assert np.einsum("pna,na->p", by_reading, by) == pytest.approx(
            slope, rel=0.03, abs=3e-3 * np.abs(slope).max()
        )
        by = rng.standard_normal((len(links), 3))
        step = 2e-5
        up, down = links.moved(-step * by), links.moved(step * by)
        slope = (anew(links=up) - anew(links=down)) / (2 * step)
        assert np.einsum("pma,ma->p", by_rotation, by) == pytest.approx(
            slope, rel=0.03, abs=3e-3 * np.abs(slope).max()
        )


def test_u_with_links_covers_what_it_says() -> None:
    rng = np.random.default_rng(11)
    inside = []
    for _ in range(80):
        data, links = linked_part(6, rng)
        result = fit_readings(replace(data, links=links))
        true = dict(zip(names_of(data.model), [*TRUE[:3], *np.degrees(TRUE[3:]), *BIAS_MG], strict=True))
        inside += [abs(one.value - true[k]) <= one.U for k, one in result.parameters.items() if one.U]
    # 720 intervals, nine a session alike: four of their standard deviations.
    assert len(inside) == 720
    assert 0.95 - 0.06 < np.mean(inside) < 0.95 + 0.04


@pytest.mark.parametrize("noise_mg", [1e-3, 1.0, 1e4, 1e7])
def test_an_attitude_moves_by_what_its_reading_moves_along_its_tangent(noise_mg: float) -> None:
    data, links = linked_part(5, np.random.default_rng(4))
    fit = determine(data).fit
    root = noise_mg**-1 * data.own_root
    rows = LinkRows.at(links, fit.values.attitude, fit.tangent, root)
    assert rows.estimator @ fit.tangent == pytest.approx(np.tile(np.eye(2), (5, 1, 1)), abs=1e-9)
    # What weighted least squares gives weight to is not what is across the tangent in its metric.
    normal = (
        np.linalg.inv(root)
        @ np.linalg.inv(root).transpose(0, 2, 1)
        @ np.cross(fit.tangent[:, :, 0], fit.tangent[:, :, 1])[:, :, None]
    )
    moved = rows.estimator @ (normal / np.linalg.norm(normal, axis=1, keepdims=True))
    assert moved == pytest.approx(np.zeros((5, 2, 1)), abs=1e-12)


class _Fixed:
    """Links whose gyros are as they are taken to be."""

    def __init__(self, links: Links, spread: Floats | None = None) -> None:
        self.links = links
        self.refused = ((7, 8, "saturated"),)
        count = links.modes_rad.shape[2]
        own = np.ones(count) if spread is None else spread
        self.prior = SimpleNamespace(values=np.zeros(count), covariance=np.diag(own**2), root=np.diag(own))
        self.asked: list[Floats] = []

    def at(self, values: Floats, position: list[int]) -> Links:
        self.asked.append(values)
        return self.links


def test_the_link_that_contradicts_gravity_and_the_others_is_left_out_by_the_numbers_of_its_dwells() -> (
    None
):
    data, links = linked_part(9, np.random.default_rng(9))
    data = replace(data, position=10 + np.arange(9))
    sound_links, sound = judge_links(data, _Fixed(links))
    assert sound_links is not None
    assert len(sound_links) == 8
    assert sound.refused == ((7, 8, "saturated"),)
    assert sound.dof > 8
    turned = links.rotation.copy()
    turned[5] = Rotation.from_rotvec([0.05, -0.05, 0.05]).as_matrix() @ turned[5]
    found_links, found = judge_links(data, _Fixed(replace(links, rotation=turned)))
    assert found_links is not None
    assert found_links.before.tolist() == [0, 1, 2, 3, 4, 6, 7]
    assert [(b, a) for b, a, _ in found.refused[1:]] == [(15, 16)]


@pytest.mark.parametrize(
    ("far", "odd", "believed"),
    [((), (1, 4), True), ((1, 4), (), True), ((), (1, 4, 6), False), ((4,), (1, 6), False)],
)
def test_a_quarter_of_the_links_may_be_left_out_whatever_for(
    far: tuple[int, ...], odd: tuple[int, ...], believed: bool
) -> None:
    data, links = linked_part(9, np.random.default_rng(9))
    turned = links.rotation.copy()
    for k in far:
        turned[k] = Rotation.from_rotvec([2.0, -1.0, 1.0]).as_matrix() @ turned[k]
    for k in odd:
        turned[k] = Rotation.from_rotvec([0.05, -0.05, 0.05]).as_matrix() @ turned[k]
    found_links, found = judge_links(data, _Fixed(replace(links, rotation=turned)))
    if believed:
        assert found_links is not None
        assert found_links.before.tolist() == [k for k in range(8) if k not in (*far, *odd)]
        assert sorted(b for b, _, _ in found.refused[1:]) == sorted((*far, *odd))
    else:
        assert found_links is None
        assert found.why.startswith("they contradict gravity (χ² ")


def test_a_parameter_of_the_gyros_that_is_known_exactly_is_settled_at_once() -> None:
    data, links = linked_part(6, np.random.default_rng(6))
    spread = np.array([1e-3, 1e-3, 0.0, 1e-3])
    found = _Fixed(replace(links, modes_rad=links.modes_rad * spread), spread)
    settled_links, _ = judge_links(data, found)
    assert settled_links is not None
    assert all(values[2] == 0.0 for values in found.asked)


class _Turning(_Fixed):
    """Links by gyros whose parameters turn what they integrate to."""

    def at(self, values: Floats, position: list[int]) -> Links:
        by = self.links.modes_rad @ (values - np.array([2.0, -1.5, 1.0, 1.5]))
        super().at(values, position)
        return replace(
            self.links,
            rotation=Rotation.from_rotvec(by).as_matrix() @ self.links.rotation,
            offset_rad=-self.links.modes_rad @ values,
        )


def test_links_are_linearised_where_the_parameters_of_the_gyros_end_up() -> None:
    data, links = linked_part(9, np.random.default_rng(9))
    gyros = _Turning(replace(links, modes_rad=20 * links.modes_rad))
    found_links, _ = judge_links(data, gyros)
    assert found_links is not None
    assert len(gyros.asked) > 2
    ended = probable_gyros(determine(replace(data, links=found_links)).fit, gyros.prior)
    assert np.abs(ended - gyros.asked[-1]).max() < 0.05
    assert np.abs(ended - [2.0, -1.5, 1.0, 1.5]).max() < 0.3


def test_links_are_judged_by_what_they_add_to_chi2_where_the_noise_is_known() -> None:
    data, links = linked_part(11, np.random.default_rng(11))
    alone, linked = determine(data).fit.chi2, determine(replace(data, links=links)).fit.chi2
    assert alone > 0.5
    assert judge_links(data, _Fixed(links))[1].chi2 == pytest.approx(linked - alone, rel=1e-3)
    few, links = linked_part(6, np.random.default_rng(6))
    found_links, found = judge_links(replace(few, noise_known=False), _Fixed(links))
    assert (found_links, found.why) == (None, "the noise of the poses is unknown")


def test_one_link_of_three_poses_cannot_be_tested_and_two_can() -> None:
    data, links = linked_part(3, np.random.default_rng(3))
    found_links, found = judge_links(data, _Fixed(links.only(np.array([0]))))
    # Three norms and two equations of the link determine five parameters: none is left over.
    assert (found_links, found.why) == (None, "they are too few to be tested against gravity")
    whole_links, whole = judge_links(data, _Fixed(links))
    assert whole_links is not None
    assert whole.dof == 1


def test_without_links_between_fitted_poses_the_reason_of_the_first_refusal_is_told() -> None:
    data, links = linked_part(5, np.random.default_rng(5))
    none = _Fixed(links.only(np.zeros(4, dtype=bool)))
    assert judge_links(data, none)[1].why == "saturated"
    none.refused = ()
    assert judge_links(data, none)[1].why == "none lies between two poses that are fitted"


def test_links_that_turn_gravity_elsewhere_are_left_out_and_many_of_them_are_false_gyros() -> None:
    data, links = linked_part(9, np.random.default_rng(9))
    turned = links.rotation.copy()
    turned[[2]] = Rotation.from_rotvec([2.0, -1.0, 1.0]).as_matrix() @ turned[[2]]
    found_links, found = judge_links(data, _Fixed(replace(links, rotation=turned)))
    assert found_links is not None
    assert [(b, a) for b, a, why in found.refused[1:] if "wrong direction" in why] == [(2, 3)]
    turned[:4] = Rotation.from_rotvec([2.0, -1.0, 1.0]).as_matrix() @ turned[:4]
    none_links, none = judge_links(data, _Fixed(replace(links, rotation=turned)))
    assert none_links is None
    assert "of 8 the gyros turn gravity" in none.why
    assert none.used == 0
    few_links, few = judge_links(data.rows(np.arange(9) < 2), _Fixed(links))
    assert (few_links, few.why) == (None, "poses are too few to test them by")


def test_links_follow_readings_that_are_left_out() -> None:
    data, links = linked_part(6, np.random.default_rng(6))
    data = replace(data, links=links)
    rest = data.rows(np.array([True, True, False, True, True, True])).links
    assert rest is not None
    assert rest.before.tolist() == [0, 2, 3]
    assert rest.after.tolist() == [1, 3, 4]
    assert rest.joined.tolist() == [False, True]
    assert rest.rotation == pytest.approx(links.rotation[[0, 3, 4]])
    assert data.rows(np.arange(6) == 2).links is None


def test_the_covariance_of_all_links_has_blocks_of_neighbours_that_share_a_dwell() -> None:
    rng = np.random.default_rng(8)
    _, links = linked_part(6, rng)
    dense = block_diag(*links.own_rad2)
    for k in range(4):
        dense[3 * k : 3 * k + 3, 3 * k + 3 : 3 * k + 6] = links.next_rad2[k]
        dense[3 * k + 3 : 3 * k + 6, 3 * k : 3 * k + 3] = links.next_rad2[k].T
    assert links.own_covariance == pytest.approx(dense)


# -- sessions ---------------------------------------------------------------------------------------------


def _session(poses: int, seed: int) -> tuple[Session, World]:
    rng = np.random.default_rng(seed)
    world = World(WorldSettings(hand_moves=1.0, **draw_gyros(rng)), seed=seed)
    recorder = Recorder(world)
    for k, direction in enumerate(rng.standard_normal((poses, 3))):
        unit = direction / np.linalg.norm(direction)
        if k:
            recorder.turn(lambda at, to=unit: world.stage.orient(at, to))
        else:
            recorder.now_s = world.stage.orient(0.5, unit) + 1.0
        recorder.dwell(3.0)
    return recorder.session(plane="none"), world


@pytest.fixture(scope="module")
def simulated() -> tuple[Session, World]:
    """Nine poses by hand; tests take the first ones."""
    return _session(9, 21)


def _first(session: Session, poses: int) -> Session:
    turns = session.turns[: poses - 1]
    return replace(session, dwells=session.dwells[:poses], turns_from=lambda: turns)


def _changed(session: Session, change: object) -> Session:
    dwells = tuple(replace(d, gyro=change(d.gyro)) for d in session.dwells)
    turns = tuple(replace(t, gyro=change(t.gyro)) for t in session.turns)
    return replace(session, dwells=dwells, turns_from=lambda: turns)


def _calibrated(world: World) -> GyroCalibration:
    true = world.truth(np.zeros(1))
    known = {f"gyro_bias_{i}": Value(true[f"gyro_bias_{i}"], 0.5, "dps") for i in "xyz"}
    for i in "xyz":
        known[f"gyro_scale_{i}"] = Value(true[f"gyro_scale_{i}"], 2e-4, "1")
        for j in "xyz":
            known[f"g_sensitivity_{i}{j}"] = Value(true[f"g_sensitivity_{i}{j}"], 0.005, "dps/g")
            if i != j:
                name = f"gyro_misalignment_{i}{j}"
                known[name] = Value(true[name], 0.02, "deg")
    return GyroCalibration.of(known)


def test_five_poses_by_hand_determine_all_parameters_by_the_turns_between_them(
    simulated: tuple[Session, World],
) -> None:
    session, world = _first(simulated[0], 5), simulated[1]
    try:
        alone = fit_of(readings_of(session), "ml")
        assert alone.undetermined
    except FitError:
        pass
    true = world.truth()
    by_sheet, by_calibration = fit(session), fit(session, gyros=_calibrated(world))
    for result in (by_sheet, by_calibration):
        assert result.links is not None
        assert result.links.used == 4
        assert not result.undetermined
        for name, one in result.parameters.items():
            assert one.u is not None
            assert abs(one.value - true[name]) < 4 * one.u
    u = [[one.u or np.inf for one in result.parameters.values()] for result in (by_sheet, by_calibration)]
    assert np.median(np.array(u[1]) / np.array(u[0])) < 0.7


def test_nine_poses_are_surer_with_turns_and_say_so_in_one_line(simulated: tuple[Session, World]) -> None:
    session = simulated[0]
    alone, result = fit_of(readings_of(session), "ml"), fit(session)
    assert result.links is not None
    ratios = [(result[name].u or 0) / (one.u or 0) for name, one in alone.parameters.items()]
    assert max(ratios) <= 1.02
    assert np.median(ratios) < 0.95
    told = [line for line in Answer.of(result).facts() if "turns between the poses" in line]
    assert len(told) == 1
    document = result.as_dict()
    assert document["links"]["used"] == 8
    assert document["links"]["gyros"] == "data sheet"
    assert result.session is not None
    assert result.session.links is not None


def test_seven_poses_show_their_skews_by_the_turns_between_them(
    simulated: tuple[Session, World],
) -> None:
    session = _first(simulated[0], 7)
    assert fit_of(readings_of(session), "ml").undetermined == ("skew_xy", "skew_xz", "skew_yz")
    assert not fit(session).undetermined


def test_links_join_the_dwells_that_they_lie_between_whatever_is_for_checking(
    simulated: tuple[Session, World],
) -> None:
    session = simulated[0]
    dwells = [replace(one, use="check") if k == 3 else one for k, one in enumerate(session.dwells)]
    readings, report = linked_readings(replace(session, dwells=tuple(dwells)))
    links = readings.links
    assert report is not None
    assert links is not None
    assert report.used == len(links)
    joined = list(zip(readings.position[links.before], readings.position[links.after], strict=True))
    assert joined == [(k, k + 1) for k in range(8) if 3 not in (k, k + 1)]
    down = readings.mean / np.linalg.norm(readings.mean, axis=1, keepdims=True)
    came = np.einsum("mij,mj->mi", links.rotation, down[links.before])
    assert ((came * down[links.after]).sum(axis=1) > np.cos(np.radians(3.0))).all()


def test_links_are_worked_out_once_a_session_and_anew_by_a_calibration(
    simulated: tuple[Session, World],
) -> None:
    session, world = simulated
    session = _first(session, 5)
    once = session.once(linked_readings, None)
    assert fit(session).links is once[1]
    by_calibration = linked_readings(session, _calibrated(world))
    assert by_calibration[1] is not None
    assert by_calibration[1].calibrated
    assert fit(session).links is once[1]
    assert once[1] is not None
    assert not once[1].calibrated


@pytest.mark.parametrize(
    "change",
    [
        lambda rate: -rate,
        lambda rate: rate[:, [1, 0, 2]],
        lambda rate: rate * np.array([1, 1, -1]),
        lambda rate: 1.1 * rate,
    ],
    ids=["wrong sign", "axes swapped", "sign of Z", "gain 10 % off"],
)
def test_false_gyros_leave_the_fit_of_gravity_alone_and_one_line(
    simulated: tuple[Session, World], change: object
) -> None:
    session = _changed(simulated[0], change)
    alone, result = fit_of(readings_of(session), "ml"), fit(session)
    assert result.links is not None
    assert result.links.used == 0
    assert [line for line in Answer.of(result).facts() if "not used" in line]
    assert list(result.parameters.items()) == list(alone.parameters.items())


def test_gyros_that_are_clipped_within_their_range_are_seen_and_only_their_turns_left_out(
    simulated: tuple[Session, World],
) -> None:
    session = simulated[0]
    clipped = fit(_changed(session, lambda rate: np.clip(rate, -60, 60))).links
    assert clipped is not None
    faster = sum(bool(np.abs(turn.gyro).max() > 60) for turn in session.turns)
    assert 0 < clipped.used == len(session.turns) - faster
    assert all("beyond its range of ±60 °/s" in why for _, _, why in clipped.refused)


def test_a_turn_with_lost_scans_and_one_beyond_the_range_are_left_out_with_the_reason(
    simulated: tuple[Session, World],
) -> None:
    session = simulated[0]
    turns = list(session.turns)
    moving = int(np.abs(turns[2].gyro).max(axis=1).argmax())
    kept = np.ones(len(turns[2]), dtype=bool)
    kept[moving - 200 : moving + 200] = False
    turns[2] = replace(
        turns[2], time_s=turns[2].time_s[kept], accel=turns[2].accel[kept], gyro=turns[2].gyro[kept]
    )
    beyond = turns[5].gyro.copy()
    beyond[len(beyond) // 2] = 301.0
    turns[5] = replace(turns[5], gyro=beyond)
    result = fit(replace(session, turns_from=lambda: tuple(turns)))
    assert result.links is not None
    assert result.links.used == 6
    told = {(b, a): why for b, a, why in result.links.refused}
    assert "no samples" in told[2, 3]
    assert "beyond its range" in told[5, 6]


def test_one_turn_that_contradicts_the_others_is_left_out(simulated: tuple[Session, World]) -> None:
    session = simulated[0]
    turns = list(session.turns)
    turns[3] = replace(turns[3], gyro=turns[3].gyro * np.where(np.abs(turns[3].gyro) > 5, 1.06, 1.0))
    result = fit(replace(session, turns_from=lambda: tuple(turns)))
    assert result.links is not None
    assert result.links.used == 7
    assert [(b, a) for b, a, _ in result.links.refused] == [(3, 4)]


def test_without_turns_nothing_is_said_of_links(simulated: tuple[Session, World]) -> None:
    session = simulated[0]
    for other in (
        replace(session, turns_from=None),
        replace(session, turns_from=lambda: tuple(replace(t, gyro=None) for t in session.turns)),
        # What `calibrate` keeps without --record-turns: the moments around each dwell.
        replace(session, turns_from=lambda: tuple(_moments(t) for t in session.turns)),
    ):
        result = fit(other)
        assert result.links is None
        assert "links" not in result.as_dict()
        assert not [line for line in Answer.of(result).facts() if "turn" in line]


def _moments(turn: object) -> object:
    rows = np.r_[0:100, len(turn) - 100 : len(turn)]
    return replace(turn, time_s=turn.time_s[rows], accel=turn.accel[rows], gyro=turn.gyro[rows])


def test_gyros_are_calibrated_by_gravity_alone(
    simulated: tuple[Session, World], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links would use the turns twice."""

    def refuse(*_: object) -> None:
        raise AssertionError("a fit of the gyros asked for links")

    monkeypatch.setattr("adis_gonio.fitting.methods.linked_readings", refuse)
    assert len(fit_gyro(replace(simulated[0])).positions) >= 9


def test_gyros_of_the_session_itself_or_for_a_plane_are_refused(
    simulated: tuple[Session, World], tmp_path: object
) -> None:
    session, world = simulated
    calibration = _calibrated(world)
    with pytest.raises(UsageError, match="has a plane"):
        fit(replace(_first(session, 4), plane="xy"), gyros=calibration)
    with pytest.raises(UsageError, match="record-turns"):
        fit(replace(session, turns_from=None), gyros=calibration)
    with pytest.raises(UsageError, match="give another session"):
        adis_gonio.fit(replace(session, source=str(tmp_path)), gyros=str(tmp_path))
    with pytest.raises(UsageError, match="not for part='gyro'"):
        adis_gonio.fit(session, part="gyro", gyros=calibration)


def test_a_calibration_stands_in_the_place_of_the_data_sheet_where_it_knows() -> None:
    sheet = GyroPrior.of_sheet("adis16354")
    partial = GyroCalibration.of(
        {
            **{f"gyro_bias_{i}": Value(0.0, 0.1, "dps") for i in "xyz"},
            "gyro_scale_x": Value(1.01, 1e-4, "1"),
            "gyro_misalignment_yz": Value(0.5, 0.02, "deg"),
        }
    )
    known = sheet.calibrated(partial)
    u = np.sqrt(np.diagonal(known.covariance))
    assert known.values[0] == pytest.approx(1.01)
    assert u[0] == pytest.approx(1e-4, rel=1e-3)
    assert known.values[5] == pytest.approx(np.sin(np.radians(0.5)))
    assert u[5] == pytest.approx(np.radians(0.02), rel=1e-3)
    others = [k for k in range(PARAMETERS) if k not in (0, 5)]
    assert u[others] == pytest.approx(np.sqrt(np.diagonal(sheet.covariance))[others])
    assert np.linalg.eigvalsh(known.covariance).min() > -1e-15


def test_monte_carlo_draws_the_links_too(simulated: tuple[Session, World]) -> None:
    from adis_gonio.fitting.monte_carlo import monte_carlo

    result = fit(_first(simulated[0], 6))
    run = monte_carlo(result, 150, np.random.default_rng(4))
    for name, one in result.parameters.items():
        assert run.parameters[name].u == pytest.approx(one.u, rel=0.35)


def test_rows_of_a_fit_without_links_are_those_of_its_dwells() -> None:
    data, links = linked_part(7, np.random.default_rng(9))
    data = replace(data, slow=data.slow[:, :, :0])
    links = replace(links, modes_rad=0.0 * links.modes_rad)
    plain, linked = Fit.begin(data), Fit.begin(replace(data, links=links))
    assert linked.residual[:7] == pytest.approx(plain.residual.ravel())
    assert linked.jacobian[:7] == pytest.approx(plain.jacobian)
    assert len(linked.residual) == 7 + 2 * len(links)
