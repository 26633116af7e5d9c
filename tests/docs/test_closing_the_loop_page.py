"""The tutorial on measured data prints figures and lines that the tool still prints."""

import re

import adis_gonio
from adis_gonio.faces.cli import main
from recordings import MEASURED, ROOT
from tracing.planting import plant_effect

PAGE = (ROOT / "docs" / "closing_the_loop.md").read_text(encoding="utf-8")


def test_files_of_the_commands_and_pictures_exist():
    named = re.findall(r"examples/measured/\S+\.(?:csv\.gz|py)", PAGE)
    assert len(named) >= 5
    assert all((ROOT / name).is_file() for name in named)
    assert all((ROOT / "docs" / name).is_file() for name in re.findall(r"\]\((pictures/\S+)\)", PAGE))


def test_the_errors_of_the_thermal_cycle_are_those_that_trace_prints(capsys):
    assert main(["trace", str(MEASURED / "thermal_cycle.csv.gz")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    block = re.search(r"```text\n(Error before and after\n.*?)```", PAGE, re.DOTALL).group(1)
    assert block.count("\n") == 7
    assert " ".join(block.split()) in printed


def test_the_reason_for_the_angle_of_two_positions_is_quoted_as_printed():
    result = adis_gonio.fit(adis_gonio.load_session(MEASURED / "adis16350_xy_turn.csv.gz"), method="paper")
    assert any(warning in " ".join(PAGE.split()) for warning in result.warnings)


def test_the_kinds_of_the_planting_script_are_counted_right():
    kinds = plant_effect.KINDS
    assert (len(kinds), sum(kind.catalogued for kind in kinds)) == (11, 5)
    assert "Five of its eleven kinds" in PAGE
