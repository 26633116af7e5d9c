"""Effects that a user writes as formulas: their values, what they need, and the texts that are refused."""

import ast
import pickle

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects import Conditions
from adis_gonio.model.effects.formula import COVARIATES_OF_FORMULAS, formula_effect

ANGLE_DEG = np.arange(12) * 30.0 + 3
IDEAL_MG = 1000 * np.column_stack([np.cos(np.radians(ANGLE_DEG)), -np.sin(np.radians(ANGLE_DEG))])
TURN = Conditions(
    time_s=60.0 * np.arange(12),
    angle_rad=np.radians(ANGLE_DEG),
    approach=np.tile([1.0, -1.0, -1.0], 4),
    temperature_c=30 + 6 * np.sin(np.arange(12)),
    supply_v=5 + 0.1 * np.cos(np.arange(12)),
)
ALLOWED = {*COVARIATES_OF_FORMULAS, "pi", "sin", "cos", "exp", "log", "sqrt", "sign", "abs", "min", "max"}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("gx", lambda c, i: i[:, 0] / 1000),
        ("-gy**2 + 3", lambda c, i: 3 - (i[:, 1] / 1000) ** 2),
        ("+gy - -1", lambda c, i: i[:, 1] / 1000 + 1),
        ("angle / 90", lambda c, i: np.degrees(c.angle_rad) / 90),
        ("t", lambda c, i: c.time_s / 60),
        ("(T - 25)*V", lambda c, i: (c.temperature_c - 25) * c.supply_v),
        ("approach", lambda c, i: c.approach),
        ("sin(angle*pi/180)", lambda c, i: np.sin(c.angle_rad)),
        ("max(gx, gy, 0.5)", lambda c, i: np.maximum(np.maximum(i[:, 0], i[:, 1]) / 1000, 0.5)),
        ("min(gx, 0)", lambda c, i: np.minimum(i[:, 0] / 1000, 0)),
        ("sqrt(abs(gx)) * sign(gx)", lambda c, i: np.sign(i[:, 0]) * np.sqrt(abs(i[:, 0]) / 1000)),
        ("exp(-t/5) - cos(t) + log(T)", lambda c, i: _wave(c)),
        ("2", lambda c, i: 2 * np.ones(len(i))),
    ],
)
def test_a_formula_has_the_value_that_it_says(text: str, value) -> None:
    made = formula_effect(f"mine_y = {text}", "mg")
    (found,) = made.basis(1, IDEAL_MG, TURN)
    np.testing.assert_allclose(found, value(TURN, IDEAL_MG), rtol=1e-12, atol=1e-15)
    again = pickle.loads(pickle.dumps(made))
    np.testing.assert_array_equal(again.basis(1, IDEAL_MG, TURN)[0], found)
    assert again.parameters == made.parameters


def _wave(c: Conditions) -> np.ndarray:
    minutes = c.time_s / 60
    return np.exp(-minutes / 5) - np.cos(minutes) + np.log(c.temperature_c)


def test_gx_in_a_formula_of_gyros_is_the_specific_force_and_not_the_rate() -> None:
    force_g = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    turning = Conditions(np.zeros(2), force_g=force_g)
    made = formula_effect("mine_z = gz - gx", "deg/s")
    assert made.basis(2, np.full((2, 3), 50.0), turning)[0] == pytest.approx([0.8, -1.0])


def test_a_formula_has_an_amplitude_for_each_axis_in_the_unit_of_the_readings() -> None:
    made = formula_effect("my_own_xz = T + V*t - T", "mV")
    assert (made.name, made.axes) == ("my_own", ("x", "z"))
    assert [(one.name, one.unit) for one in made.parameters] == [("my_own_x", "mV"), ("my_own_z", "mV")]
    assert made.covariates == ("temperature", "supply", "time")
    assert made.needs == ("temperature_c", "supply_v")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mine = gx**2", "'mine' names no axis"),
        ("mine_xx = gx**2", "'mine_xx' names no axis"),
        ("mine_a = gx", "'mine_a' names no axis"),
        ("9mine_x = gx", "'9mine_x' names no axis"),
        ("mine_x = gx.real", "'gx.real' is not allowed"),
        ("mine_x = True", "'True' is not allowed"),
        ("mine_x = not gx", "'not gx' is not allowed"),
        ("mine_x = gx % 2", "'gx % 2' is not allowed"),
        ("mine_x = (gx", "this is no expression"),
        ("mine_x = sin(x=gx)", "'sin(x=gx)' is not allowed"),
        ("mine_x = open('a')", "no function is called 'open'"),
        ("mine_x = foo * 2", "no covariate is called 'foo'"),
        ("mine_x = sin(gx, 2)", "sin takes one argument, not 2"),
        ("mine_x = sin()", "sin takes one argument, not 0"),
        ("mine_x = max(gx)", "max takes two arguments or more, not 1"),
        ("mine_x = 1" + 150 * "0" + " * 1" + 309 * "0", "at most 200"),
        ("mine_x = gx\t", "cannot be printed"),
    ],
)
def test_a_text_that_is_no_formula_is_refused_with_its_reason(text: str, message: str) -> None:
    with pytest.raises(UsageError) as caught:
        formula_effect(text, "mg")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_formula_may_have_200_characters() -> None:
    text = "mine_x = gx" + "+1" * 94 + " "
    assert len(text) == 200
    assert formula_effect(text, "mg").basis(0, IDEAL_MG, TURN)[0][0] == pytest.approx(94.99863)
    with pytest.raises(UsageError, match="has 201 characters: at most 200"):
        formula_effect(text + " ", "mg")


@pytest.mark.parametrize(
    ("text", "place"),
    [("mine_x = gx + foo", 15), ("m_x=µ*2", 5), ("m_x=  (gx", 7), ("m_x = gx*'µ'*a.b", 10), ("m_x = ", 7)],
)
def test_the_message_points_at_the_place_in_the_text(text: str, place: int) -> None:
    with pytest.raises(UsageError, match=rf"\(character {place}\)"):
        formula_effect(text, "mg")


def test_a_covariate_that_the_session_did_not_record_is_refused() -> None:
    for text, message in (("mine_x = gz", "does not record gz"), ("mine_x = T", "temperature_c")):
        made = formula_effect(text, "mg")
        with pytest.raises(UsageError, match=message):
            made.basis(0, IDEAL_MG, Conditions(TURN.time_s))


STRANGE = ("foo", "__class__", "1j", "'a'", "True", "None", "[1]", "{}", "x.y", "x[0]", "f'{gx}'", "gx:=1")
ATOMS = st.sampled_from(
    [*COVARIATES_OF_FORMULAS, "pi", "2", "0.5", "1e400", "9" * 30, "lambda: 0", "*gx", "ﬀ", "°", *STRANGE]
)


def _grown(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    signs = st.sampled_from(
        ["+", "-", "*", "/", "**", "//", "%", "@", "<", "==", " and ", " if ", ",", "."]
    )
    names = st.sampled_from(["sin", "abs", "min", "max", "eval", "open", "__import__", "gx", "getattr"])
    return st.one_of(
        st.builds("({}{}{})".format, inner, signs, inner),
        st.builds("{}({})".format, names, inner),
        st.builds("{}({}, {})".format, names, inner, inner),
        st.builds("-{}".format, inner),
    )


def _made(text: str):
    try:
        return formula_effect(text, "mg")
    except UsageError as error:
        return str(error)


@settings(max_examples=200, deadline=None)
@given(st.recursive(ATOMS, _grown, max_leaves=12) | st.text(max_size=60))
def test_any_text_is_a_formula_of_known_names_or_one_clear_line(text: str) -> None:
    made = _made(f"mine_x = {text}")
    if isinstance(made, str):
        assert "\n" not in made
        assert made.startswith("formula")
        return
    # An accepted text has nothing but numbers, operators, and the names of the tables.
    tree = ast.parse(text.strip(), mode="eval")
    assert {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)} <= ALLOWED
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.Attribute | ast.Subscript)]
    in_space = np.column_stack([IDEAL_MG, np.ones(12)])
    assert made.basis(0, in_space, TURN)[0].shape == (12,)
