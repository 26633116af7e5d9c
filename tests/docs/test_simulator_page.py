"""The page on the simulator: its names exist, its commands run."""

import re
import shlex
from pathlib import Path

import pytest

from adis_gonio.faces.cli import main
from adis_gonio.record.loading import load_session
from adis_gonio.sim import World, WorldSettings

PAGE = (
    (Path(__file__).parents[2] / "docs" / "simulator.md")
    .read_text(encoding="utf-8")
    .partition("## Test doubles")[0]
)
COMMANDS = re.search(r"```sh\n(.*?)```", PAGE, re.S)[1].splitlines()


def test_every_name_on_the_page_is_a_setting_or_stands_in_the_truth():
    known = {*WorldSettings.__dataclass_fields__, *World().truth()}
    named = set(
        re.findall(r"\b(?:gyro|g|die|hand|mark|accel_place|origin|earth|move)_[a-z0-9_]*[a-z0-9]", PAGE)
    )
    assert len(named) > 10
    assert named - known - {"gyro_faults", "g_sensitivity"} == set()


@pytest.mark.parametrize("command", COMMANDS)
def test_the_commands_run(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(command)[1:]
    assert main([*words, "--dwell", "1"]) == 0
    truth = load_session(words[words.index("-o") + 1]).facts["truth"]
    if "gyro_scale_z" in command:
        assert truth["gyro_scale_error_z"] == pytest.approx(0.01)
    if "tempco" in command:
        assert truth["gyro_bias_temperature_y"] == 0.05
    if "--effect" in command:
        assert truth["g_sensitivity.g_sensitivity_yz"] == 0.15
