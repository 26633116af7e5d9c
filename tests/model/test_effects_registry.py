"""Effects by name, from a command line, and from another package."""

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.estimation.readings import from_means
from adis_gonio.model.effects import BUILT_IN, Conditions, Enters, catalogue, effect, parse_effect
from adis_gonio.tracing.named_candidates import named_terms

PLUGIN = '''
from typing import ClassVar
import numpy as np
from adis_gonio.model.effects import Effect, Enters, Parameter
from adis_gonio.model.effects.base import StageEffect

class ThirdHarmonic(StageEffect):
    """Three cycles a turn."""
    name = "third_harmonic"
    cause = "The bearing has three lobes."
    needs = ("angle_rad",)
    parameters: ClassVar = (Parameter("third", "degree", -1.0, 1.0, 0.02),)

    def basis(self, conditions):
        return (np.sin(3 * conditions.covariate("angle_rad")),)

class Impostor(ThirdHarmonic):
    name = "bias"

class Ageing(ThirdHarmonic):
    name = "ageing"
    covariates = ("time",)
    needs = ()

class Moody(ThirdHarmonic):
    name = "moody"
    covariates = ("mood",)

class Silent(Effect):
    name = "silent"
    cause = "The part ages."
    enters = Enters.ATTITUDE
    by_axis = False

    @property
    def parameters(self):
        return (Parameter("rate", "deg/h", -50.0, 50.0, 0.5),)

    def attitude_rad(self, values, conditions):
        return np.deg2rad(values[0]) * conditions.time_s / 3600

class Remembering(Silent):
    name = "remembering"
    needs = ("temperature_history",)

not_an_effect = 3
'''


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a package with entry points, as pip would leave it on the path."""

    def installed(*points: str) -> None:
        (tmp_path / "lobed_stage.py").write_text(PLUGIN, encoding="utf-8")
        info = tmp_path / "lobed_stage-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lobed-stage\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text("[adis_gonio.effects]\n" + "\n".join(points) + "\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(__import__("sys").modules, "lobed_stage", raising=False)

    return installed


def one_line(error: pytest.ExceptionInfo) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def test_another_package_adds_an_effect_and_nothing_else_changes(install):
    install("third_harmonic = lobed_stage:ThirdHarmonic")
    assert set(catalogue()) == {*BUILT_IN, "third_harmonic"}
    one, values = parse_effect("third_harmonic:third=0.1")
    assert one.enters is Enters.ATTITUDE
    angle = one.attitude_rad(values, Conditions(np.zeros(2), angle_rad=np.deg2rad([0.0, 30.0])))
    assert np.rad2deg(angle) == pytest.approx([0, 0.1])


@pytest.mark.parametrize(
    ("point", "says"),
    [
        ("bias = lobed_stage:Impostor", "taken"),
        ("silent = lobed_stage:Silent", "'silent' of lobed_stage:Silent declares neither covariates nor"),
        ("remembering = lobed_stage:Remembering", "neither covariates nor needs that name one"),
        ("other = lobed_stage:ThirdHarmonic", "another name"),
        ("third_harmonic = lobed_stage:not_an_effect", "no subclass"),
        ("third_harmonic = lobed_stage:Missing", "cannot be loaded"),
        ("third_harmonic = no_such_module_here:Missing", "cannot be loaded"),
    ],
)
def test_entry_point_that_is_no_proper_effect_is_named(install, point, says):
    install(point)
    with pytest.raises(UsageError, match=says) as error:
        catalogue()
    assert point.split(" = ")[0] in one_line(error)
    assert effect("quadratic").name == "quadratic", "the built-in effects stay usable"


def test_catalogue_without_other_packages_is_the_built_in_one():
    assert catalogue() == BUILT_IN


def test_unknown_name_is_answered_with_the_nearest_one():
    with pytest.raises(UsageError, match=r"'quadratc'; did you mean 'quadratic'\?$"):
        effect("quadratc")
    with pytest.raises(UsageError, match="no effect is called 'zzz'; known"):
        effect("zzz")


def test_effect_by_name_takes_axes_and_choices():
    assert [p.name for p in effect("quadratic", ("y",)).parameters] == ["k2_y"]
    assert [p.name for p in effect("bias_temperature", ("x",), degree=2).parameters] == [
        "tempco_x",
        "tempco2_x",
    ]
    with pytest.raises(UsageError, match="no choice 'dwell'"):
        effect("quadratic", dwell=1)


def test_bare_name_means_all_parameters_typical():
    one, values = parse_effect("quadratic")
    assert one == effect("quadratic")
    assert values.tolist() == [p.typical for p in one.parameters]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("quadratic:k2_x=2.5", {"k2_x": 2.5, "k2_y": 0}),
        (" bias_drift : drift_x = 0.01 , drift_y=0 ", {"drift_x": 0.01, "drift_y": 0}),
        ("warm_up:warm_up_y=-3", {"warm_up_x": 0, "warm_up_y": -3, "tau": 300}),
        ("warm_up:tau=60,warm_up_x=1e0", {"warm_up_x": 1, "warm_up_y": 0, "tau": 60}),
        ("tone:tone_x=2", {"tone_x": 2, "tone_y": 0, "frequency": 50, "phase": 0}),
        ("saturation:limit=900", {"limit": 900}),
        ("quadratic:k2_z=1", {"k2_x": 0, "k2_y": 0, "k2_z": 1}),
        (
            "bias_temperature:degree=2,tempco2_z=0.1",
            {f"tempco{n}_{a}": 0.1 * (n + a == "2z") for a in "xyz" for n in ("", "2")},
        ),
        ("stage_eccentricity:ecc_cos=0.1", {"ecc_sin": 0, "ecc_cos": 0.1}),
    ],
)
def test_named_parameters_are_set_other_amplitudes_zero_shapes_typical(text, expected):
    one, values = parse_effect(text)
    assert dict(zip([p.name for p in one.parameters], values.tolist(), strict=True)) == expected


def test_choice_stands_in_the_list_and_leaves_the_parameters_typical():
    one, values = parse_effect("position_slip:dwell=3")
    assert one == effect("position_slip", dwell=3)
    assert values.tolist() == [0.1]
    assert parse_effect("outlier_dwell:dwell=0,offset_x=9")[1].tolist() == [9, 0]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("quadratic:k2_w=1", "no parameter 'k2_w'.*it has k2_x, k2_y"),
        ("quadratic:k2_x=much", "k2_x is a number, not 'much'"),
        ("quadratic:k2_x=nan", "outside its physical bounds"),
        ("quadratic:k2_x=inf", "outside its physical bounds"),
        ("quadratic:k2_x=1000", "-100 to 100 mg/g²"),
        ("warm_up:tau=0", "1 to 36000 s"),
        ("quadratic:", "write quadratic:parameter=value"),
        ("quadratic:k2_x", "write quadratic:parameter=value"),
        ("quadratic:k2_x=", "write quadratic:parameter=value"),
        ("quadratic:=1", "write quadratic:parameter=value"),
        ("quadratic:k2_x=1,k2_x=2", "k2_x is given twice"),
        ("quadratic:k2_x=1,", "write quadratic:parameter=value"),
        ("position_slip:dwell=1.5", "dwell is a whole number"),
        ("position_slip:dwell=-1", "it can be 0 or more"),
        ("position_slip:dwell=1,dwell=2", "dwell is given twice"),
        ("bias_temperature:degree=4", "it can be 1, 2 or 3"),
        ("", "no effect is called ''"),
        ("quadric", "did you mean"),
    ],
)
def test_wrong_text_is_one_line_of_usage(text, says):
    with pytest.raises(UsageError, match=says) as error:
        parse_effect(text)
    assert one_line(error)
    assert error.value.exit_code == 2


def test_defaults_by_name_refuse_what_the_effect_has_not():
    one = effect("quadratic")
    assert one.defaults({"k2_y": 3.0}).tolist() == [1.0, 3.0]
    with pytest.raises(UsageError, match="it has k2_x, k2_y"):
        one.defaults({"k2y": 3.0})


def test_what_an_effect_follows_is_declared_by_its_class(install):
    """Also where `needs` names nothing; a class that declares nothing follows what it needs."""
    install("third_harmonic = lobed_stage:ThirdHarmonic", "ageing = lobed_stage:Ageing")
    assert catalogue()["ageing"].covariates == ("time",)
    assert catalogue()["third_harmonic"].covariates == ("angle",)
    data = from_means(
        np.zeros((3, 2)),
        np.tile(np.eye(2), (3, 1, 1)),
        Conditions(time_s=np.arange(3.0), angle_rad=np.arange(3.0)),
        fixture_rad=0.0,
    )
    (term,) = [term for term in named_terms(data)[0] if term.name == "ageing"]
    assert term.covariates == ("time",)


def test_a_covariate_that_does_not_exist_is_refused(install):
    install("moody = lobed_stage:Moody")
    with pytest.raises(UsageError, match="no covariate is called 'mood'"):
        catalogue()
