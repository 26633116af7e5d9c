"""Sources of a fit's uncertainty, links, and what is determined, against dense matrices."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting import determination as seen, linked, uncertainty as module
from adis_gonio.fitting.determination import NoiseAssumptions, chi2_quantile
from adis_gonio.fitting.estimation.links import Links
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.model.effects import Conditions

RNG = np.random.default_rng(7)
N = 4
RESPONSE = RNG.standard_normal((3, N, 2))
"""∂parameter/∂reading of three parameters."""


def readings(**more: object) -> Readings:
    roots = RNG.standard_normal((N, 2, 2))
    covariance = roots @ roots.transpose(0, 2, 1) + 3 * np.eye(2)
    made = from_means(np.ones((N, 2)), covariance, Conditions(time_s=np.arange(float(N))), gravity_mg=980.0)
    return replace(made, **more)


def carried(blocks: Floats) -> Floats:
    """Covariance of the parameters by independent noise of each dwell, (n, axes, axes)."""
    return sum(RESPONSE[:, k] @ blocks[k] @ RESPONSE[:, k].T for k in range(N))


def test_a_root_is_one_of_its_covariance_also_where_that_is_singular() -> None:
    roots = RNG.standard_normal((5, 3, 3))
    whole = roots @ roots.transpose(0, 2, 1)
    flat = roots[:, :, :1] @ roots[:, :, :1].transpose(0, 2, 1)
    plain = np.stack([np.diag(row) for row in RNG.uniform(0, 2, (5, 3))])
    for covariance in (whole, flat, plain):
        found = module._root(covariance)
        np.testing.assert_allclose(found @ found.transpose(0, 2, 1), covariance, atol=1e-9)


def test_noise_that_averaging_lowers_is_what_the_other_parts_leave() -> None:
    quantization, flicker = RNG.uniform(0, 1, (N, 2)), RNG.uniform(0, 1, (N, 2))
    data = readings(quantization=quantization, flicker=flicker)
    own = np.array(data.own_covariance)
    own -= np.stack([np.diag(row) for row in quantization + flicker])
    source = module._repeatability(data, NoiseAssumptions(), RESPONSE)
    np.testing.assert_allclose(source.moves @ source.moves.T, carried(own))
    np.testing.assert_allclose(source.reading_mg2, own.mean(axis=0))
    assert source.u == pytest.approx(math.sqrt(np.trace(own.mean(axis=0)) / 2))
    rounding = module._quantization(data, RESPONSE)
    np.testing.assert_allclose(
        rounding.moves @ rounding.moves.T, carried(np.stack([np.diag(row) for row in quantization]))
    )
    np.testing.assert_allclose(rounding.reading_mg2, np.diag(quantization.mean(axis=0)))
    assert rounding.u == pytest.approx(math.sqrt(quantization.mean()))
    assert rounding.note == ""
    none = module._quantization(readings(), RESPONSE)
    assert none.u == 0
    assert none.note == "the noise dithers it, or readings are averages"


def test_an_estimate_is_that_of_all_dwells_of_each_or_of_the_residual() -> None:
    data = readings(dof=np.array([3.0, 4.0, 5.0, np.inf]))
    settled = NoiseAssumptions()
    _, dof, estimate = module.repeatability_of(data, settled)
    assert dof.tolist() == [[3, 3], [4, 4], [5, 5], [math.inf, math.inf]]
    assert estimate.tolist() == [[0, 1], [0, 1], [0, 1], [0, 1]]
    _, _, each = module.repeatability_of(replace(data, pooled=False), settled)
    assert each.tolist() == [[6, 7], [9, 10], [12, 13], [15, 16]]
    _, same, own = module.repeatability_of(data, replace(settled, extra_mg=1.0))
    assert (same.tolist(), own.tolist()) == (dof.tolist(), estimate.tolist())
    unknown = replace(readings(), noise_known=False, own_covariance=np.tile(np.eye(2), (4, 1, 1)))
    roots, of_residual, one = module.repeatability_of(unknown, NoiseAssumptions(scale=3.0, scale_dof=7.0))
    np.testing.assert_allclose(roots, np.tile(3 * np.eye(2), (4, 1, 1)))
    assert (of_residual.tolist(), one.tolist()) == ([[7, 7]] * 4, [[5, 5]] * 4)


def test_one_over_f_noise_is_what_dwells_have_and_what_they_share() -> None:
    flicker, slow = RNG.uniform(0, 1, (N, 2)), RNG.standard_normal((N, 2, 3))
    data = readings(flicker=flicker, slow=slow, flicker_shown=True)
    source = module._flicker(data, RESPONSE)
    shared = np.einsum("pna,nak->pk", RESPONSE, slow)
    own = carried(np.stack([np.diag(row) for row in flicker]))
    np.testing.assert_allclose(source.moves @ source.moves.T, own + shared @ shared.T)
    variance = flicker.mean(axis=0) + (slow**2).sum(axis=2).mean(axis=0)
    np.testing.assert_allclose(source.reading_mg2, np.diag(variance))
    assert source.u == pytest.approx(math.sqrt(variance.mean()))
    assert (source.kind, source.note) == ("A", "shown by the dwells")
    sheet = module._flicker(replace(data, flicker_shown=False), RESPONSE)
    assert (sheet.kind, sheet.note) == ("B", "figure of the part")
    none = module._flicker(readings(), RESPONSE)
    assert (none.u, none.moves.shape) == (0, (3, 0))
    assert none.note == "none shown, no figure of the part"


def test_gains_fall_as_gravity_rises() -> None:
    base = np.array([0.3, 1.02, 0.97, 0.01])
    fit = SimpleNamespace(
        values=SimpleNamespace(base=base),
        data=SimpleNamespace(model=SimpleNamespace(names=("alpha", "scale_x", "scale_y", "delta_phi"))),
    )
    source = module._gravity(readings(), fit, 6)
    # Half of 9.780 to 9.834 m/s² as a rectangle, relative to a local gravity of 0.98 g.
    relative = 0.027 / math.sqrt(3) / (0.98 * 9.80665)
    expected = [0, -1.02 * relative, -0.97 * relative, 0, 0, 0]
    np.testing.assert_allclose(source.moves[:, 0], expected)
    assert source.u == pytest.approx(0.027 / math.sqrt(3))
    assert source.by_definition


@pytest.mark.parametrize("sensor", ["adis16354", "generic"])
def test_biases_and_skews_that_nothing_shows_are_as_large_as_the_sheet_says(
    sensor: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    columns = 1000 * RNG.standard_normal((N, 2, 4))
    fit = SimpleNamespace(base_columns=columns)
    data = readings(sensor=sensor)
    noise = NoiseAssumptions(extra_mg=0.4, dof=11.0)
    monkeypatch.setattr(module, "missing_effects", lambda fit: np.zeros((N, 2, 0)))
    found = module._model(data, noise, fit, RESPONSE, (3, 5))
    extra = carried(np.tile(0.16 * np.eye(2), (N, 1, 1)))
    if sensor == "generic":
        np.testing.assert_allclose(found.moves @ found.moves.T, extra, atol=1e-12)
        assert found.note.count("of a size that nothing states: not included") == 2
        assert found.acts_mg is None
        assert found.kind == "A"
    else:
        sheet = VARIANTS[sensor].performance
        bias = sheet.initial_bias_mg * RESPONSE[:, :, 1].sum(axis=1)
        skew = sheet.skew_u_rad * np.einsum("pna,na->p", RESPONSE, columns[:, :, 3])
        np.testing.assert_allclose(
            found.moves @ found.moves.T, extra + np.outer(bias, bias) + np.outer(skew, skew)
        )
        spread = (sheet.skew_u_rad * columns[:, :, 3]) ** 2
        assert found.u == pytest.approx(
            math.sqrt(0.16 + sheet.initial_bias_mg**2 + spread.sum() / spread.size)
        )
        assert found.kind == "B"
        # A further reading has the same bias on Y; what a skew does to it its pose decides.
        np.testing.assert_allclose(
            (found.further_mg @ found.further_mg.T), np.diag([0, sheet.initial_bias_mg**2])
        )
        assert f"bias y taken as zero ({sheet.initial_bias_mg:g} mg, figure of the part)" in found.note
        # Numbers in the offset registers may add to the bias, or compensate it.
        moved = replace(data, offset_mg=(3.0, -24.0, 5.0))
        wider = module._model(moved, noise, fit, RESPONSE, (5,))
        np.testing.assert_allclose(wider.further_mg @ wider.further_mg.T, np.diag([0, 26.0**2]))
        assert "; offset registers −24.0 mg" in wider.note
    np.testing.assert_allclose(found.reading_mg2, 0.16 * np.eye(2))
    assert found.dof[: 2 * N].tolist() == [11.0] * 2 * N
    assert np.isinf(found.dof[2 * N :]).all()
    assert found.estimate[: 2 * N].tolist() == [3] * 2 * N


# -- links ---------------------------------------------------------------------------------------------


def chain(m: int = 5) -> Links:
    roots = 1e-3 * (np.eye(3) + 0.3 * RNG.standard_normal((m, 3, 3)))
    following = np.zeros((m, 3, 3))
    following[:-1] = -0.25 * roots[:-1] @ roots[1:].transpose(0, 2, 1)
    before = np.array([0, 1, 2, 4, 5])[:m]
    return Links(
        before, before + 1, np.tile(np.eye(3), (m, 1, 1)), np.zeros((m, 3)),
        roots @ roots.transpose(0, 2, 1), following, 1e-3 * RNG.standard_normal((m, 3, 2)),
    )  # fmt: skip


def dense(links: Links) -> Floats:
    """Own covariance of all links (3 m, 3 m): neighbours that share a dwell correlate."""
    m = len(links)
    whole = np.zeros((3 * m, 3 * m))
    for k in range(m):
        here = slice(3 * k, 3 * k + 3)
        whole[here, here] = links.own_rad2[k]
        if k + 1 < m and links.after[k] == links.before[k + 1]:
            there = slice(3 * k + 3, 3 * k + 6)
            whole[here, there] = links.next_rad2[k]
            whole[there, here] = links.next_rad2[k].T
    return whole


def test_links_that_share_a_dwell_correlate_and_others_do_not() -> None:
    links = chain()
    np.testing.assert_allclose(links.own_covariance, dense(links), atol=1e-15)
    slope = RNG.standard_normal((3, 5, 3))
    fit = SimpleNamespace(data=SimpleNamespace(links=links, axes=3))
    source = module._links(fit, slope)
    modes = links.modes_rad.reshape(15, 2)
    flat = slope.reshape(3, 15)
    whole = dense(links) + modes @ modes.T
    np.testing.assert_allclose(source.moves @ source.moves.T, flat @ whole @ flat.T)
    variance = np.diagonal(whole).mean()
    assert source.u == pytest.approx(math.degrees(math.sqrt(variance)))
    # Noise of the links by the root of their covariance, then the modes.
    rng = np.random.default_rng(3)
    drawn = np.linalg.cholesky(dense(links)) @ rng.standard_normal(15) + modes @ rng.standard_normal(2)
    found = links.drawn(np.random.default_rng(3)).offset_rad.ravel()
    np.testing.assert_allclose(found, drawn, atol=1e-12)


def test_some_links_keep_all_that_is_theirs() -> None:
    links = chain()
    kept = links.only(np.array([True, False, True, False, True]))
    for name in ("before", "after", "rotation", "offset_rad", "own_rad2", "next_rad2", "modes_rad"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(links, name)[[0, 2, 4]])
    assert links.joined.tolist() == [True, True, False, True]
    moved = links.moved(np.ones((5, 3))).moved(np.ones((5, 3)))
    np.testing.assert_allclose(moved.offset_rad, 2.0)
    assert linked._ends(links, 10 * np.arange(7), 3) == (40, 50)


@pytest.mark.parametrize(
    ("turn_deg", "off_deg", "near"),
    [(30.0, 9.5, True), (30.0, 10.5, False), (170.0, 16.5, True), (170.0, 17.5, False)],
)
def test_a_link_is_near_within_ten_degrees_or_a_tenth_of_its_way(
    turn_deg: float, off_deg: float, near: bool
) -> None:
    start, axis = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    there = Rotation.from_rotvec(math.radians(turn_deg + off_deg) * axis).apply(start)
    rotation = Rotation.from_rotvec(math.radians(turn_deg) * axis).as_matrix()[None]
    links = replace(chain(1), rotation=rotation)
    values = SimpleNamespace(attitude=np.stack([start, there]))
    fit = SimpleNamespace(settled=lambda _: SimpleNamespace(values=values))
    assert linked._near(links, fit).tolist() == [near]


def test_the_worst_link_is_that_of_the_longest_pair_of_rows() -> None:
    residual = np.array([50.0, 1.0, 2.0, -3.0, 0.0, -2.0, 2.0])
    fit = SimpleNamespace(link_rows=SimpleNamespace(links=range(3)), residual=residual)
    assert linked._worst(fit) == 1
    fit.residual = np.array([50.0, 1.0, 2.0, -3.0, 0.0, -2.5, 2.5])
    assert linked._worst(fit) == 2


def test_the_quantile_of_chi2_of_two_is_that_of_an_exponential() -> None:
    assert chi2_quantile(2, 1e-3) == pytest.approx(-2 * math.log(1e-3))


# -- what is determined ----------------------------------------------------------------------------------


def test_directions_beside_a_lost_one_are_orthonormal_and_free() -> None:
    free = np.array([True, True, False, True, True])
    lost = np.zeros((5, 1))
    lost[[0, 1, 4], 0] = [0.6, 0.0, 0.8]
    basis = seen._complement(free, lost)
    assert basis.shape == (5, 3)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(lost.T @ basis, 0, atol=1e-12)
    assert not basis[2].any()
    np.testing.assert_array_equal(seen._complement(free, np.zeros((5, 0))), np.eye(5)[:, free])


def test_fitted_parameters_follow_one_that_is_held_as_least_squares_does() -> None:
    rows = RNG.standard_normal((9, 4))
    fake = SimpleNamespace(
        fisher=rows.T @ rows, free=np.array([True, True, False, True]), null=np.zeros((4, 0))
    )
    moved = seen.shift_by_held(fake, 2)
    rest = [0, 1, 3]
    expected = np.linalg.lstsq(rows[:, rest], -rows[:, 2], rcond=None)[0]
    np.testing.assert_allclose(moved[rest], expected)
    assert moved[2] == 0


@pytest.mark.parametrize(("u", "lost"), [((0.098, 0.01), 0), ((0.102, 0.01), 1), ((0.3, 0.2), 2)])
def test_a_bias_is_determined_up_to_a_tenth_of_gravity(u: tuple[float, float], lost: int) -> None:
    data = readings()
    fit = SimpleNamespace(data=data, jacobian=np.zeros((6, 6)))
    sure = np.array([0.01, 0.01, 0.01, 0.01, *u])
    fit.jacobian = np.diag(1 / sure / seen.natural_units(data))
    null = seen._null_space(fit, np.ones(6, dtype=bool))
    assert null.shape[1] == lost
    assert not null[:4].any()
    held = seen._null_space(fit, np.array([True] * 4 + [False, True]))
    assert held.shape[1] == max(lost - 1, 0)
    assert seen.limits(data)[:4].tolist()[1:3] == [0.1, 0.1]
    assert seen.limits(data)[0] == pytest.approx(math.pi / math.sqrt(3))
