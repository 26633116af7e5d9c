"""A simulated part's flash in a file."""

import json

import pytest

from adis_gonio import open_sensor
from adis_gonio.base.errors import UsageError


def url(path, seed=3):
    return f"sim:?seed={seed}&flash={path}"


def test_the_flash_outlives_the_process_and_the_registers_do_not(tmp_path):
    path = tmp_path / "part.flash"
    with open_sensor(url(path)) as sensor:
        sensor.write("XACCL_OFF", -33)
        sensor.save_to_flash()
        sensor.write("YACCL_OFF", 12)
    with open_sensor(url(path)) as sensor:
        assert sensor.read("XACCL_OFF") == -33
        assert sensor.read("YACCL_OFF") == 0
        assert sensor.read("ENDURANCE") == 1


def test_without_a_flash_update_no_file_is_made(tmp_path):
    with open_sensor(url(tmp_path / "part.flash")) as sensor:
        sensor.write("XACCL_OFF", -33)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("no JSON", "is no flash"),
        ("[1, 2]", "is no flash"),
        (json.dumps({"part": "adis16354, seed 4", "flash": {}, "endurance": 0}), "seed 4"),
        (json.dumps({"part": "adis16354, seed 3", "flash": {}, "endurance": -1}), "ENDURANCE"),
        (json.dumps({"part": "adis16354, seed 3", "flash": {"NONE": 1}, "endurance": 0}), "NONE"),
    ],
)
def test_a_file_that_is_no_flash_of_this_part_is_refused(tmp_path, text, said):
    path = tmp_path / "part.flash"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=said):
        open_sensor(url(path))


def test_an_empty_name_is_refused():
    with pytest.raises(UsageError, match="name a file"):
        open_sensor("sim:?seed=1&flash=")
