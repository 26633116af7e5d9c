"""Values of options: numbers with and without a unit, lists, and the line that refuses a wrong one."""

from __future__ import annotations

import json
import math
from pathlib import Path

import click
import pytest

from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.options import parse_fixture, parse_gravity, parse_positive, parse_unit
from fakes import planar_session as planar


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (parse_gravity, "9.81", 9.81),
        (parse_gravity, "9.81m/s²", 9.81),
        (parse_gravity, " 1.62mps2", 1.62),  # on the Moon
        (parse_gravity, "1.62", None),
        (parse_gravity, "0mps2", None),
        (parse_gravity, "infmps2", None),
        (parse_fixture, "0", 0.0),
        (parse_fixture, "179.9", 179.9),
        (parse_fixture, "Free", math.inf),
        (parse_fixture, "180", None),
        (parse_fixture, "-0.1", None),
        (parse_fixture, "nan", None),
        (parse_positive, "1e-3", 1e-3),
        (parse_positive, "0", None),
        (parse_unit, "M/S^2", "mps2"),
        (parse_unit, "furlong", None),
    ],
)
def test_a_value_is_a_number_in_its_range(parse, text, value):
    if value is not None:
        assert parse(text) == value
    else:
        with pytest.raises(click.BadParameter, match=text.strip().removesuffix("mps2")):
            parse(text)


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--angles", "7=210,7=240"], "position 7 is given twice"),
        (["--angles", "7:210"], "'7:210': write position=degrees"),
        (["--angles", "7=210,-1=20"], "'-1=20': write position=degrees"),
        (["--angles", "7=inf"], "'7=inf': write position=degrees"),
        (["--columns", "time=t,time=u"], "'time' is given twice"),
        (["--columns", "time=t,ax="], "'ax=': write name=column"),
        (["--fixture", "0.1", "--fixture", "0.2"], "one uncertainty and one certificate at most"),
        (["--tolerance", "wide"], "'wide' is no angle"),
        (["--tolerance", "0.1deg", "--risk", "low"], "'low' is no risk"),
        (
            ["--tolerance", "0.1°", "--rule", "simple", "--risk", "2%"],
            "goes with the rule guarded, not with",
        ),
        (["--rule", "simple"], "--rule: goes with --tolerance"),
    ],
)
def test_a_value_that_means_nothing_is_wrong_usage(options, why, tmp_path: Path, capsys):
    path = tmp_path / "own.csv"
    path.write_text(planar.text(planar.rows()), encoding="utf-8")
    assert main(["fit", str(path), *options]) == 2
    err = capsys.readouterr().err
    assert why in " ".join(err.split())


@pytest.mark.parametrize("risk", ["2%", "0.02"])
def test_a_risk_is_a_percentage_or_a_share(risk, tmp_path: Path, capsys):
    path = tmp_path / "own.csv"
    path.write_text(planar.text(planar.rows(), "accel_unit: mg", "sensor: generic"), encoding="utf-8")
    assert (
        main(["fit", str(path), "--tolerance", "3deg", "--risk", risk, "--fixture", "0.01", "--json"]) == 0
    )
    stated = json.loads(capsys.readouterr().out)["conformity"]
    assert (stated["tolerance_deg"], stated["rule"], stated["risk"]) == (3.0, "guarded", 0.02)
