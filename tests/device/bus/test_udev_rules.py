"""The udev rules: what they hold, and that the command prints them."""

import re

import pytest
from click.testing import CliRunner

from adis_gonio.device.bus import cp2130 as requests, mcp2210 as reports
from adis_gonio.device.bus.host import RULES_FILE, udev_rule, udev_rules
from adis_gonio.faces.cli.device_commands import devices_command

LINES = [line for line in udev_rules().splitlines() if line and not line.startswith("#")]


def test_every_rule_is_well_formed_and_gives_access():
    part = r'[A-Za-z_{}]+(==|\+?=)"[^"]+"'
    for line in LINES:
        assert re.fullmatch(f"{part}(, {part})+", line), line
        assert 'TAG+="uaccess"' in line
        assert 'MODE="0660"' in line


def test_both_backends_of_hidapi_and_every_bridge_are_covered():
    ids = {
        ("hidraw", reports.VENDOR_ID, reports.PRODUCT_ID),
        ("usb", reports.VENDOR_ID, reports.PRODUCT_ID),
        ("usb", requests.VENDOR_ID, requests.PRODUCT_ID),
    }
    for subsystem, vendor, product in ids:
        line = udev_rule(f'SUBSYSTEM=="{subsystem}" "{vendor:04x}" "{product:04x}"')
        assert line in LINES
    assert udev_rule('SUBSYSTEM=="spidev"')
    assert udev_rule('SUBSYSTEM=="tty" 2341')
    assert "ID_MM_DEVICE_IGNORE" in udev_rule('SUBSYSTEM=="tty" ATTRS{manufacturer}=="adis-gonio"')


def test_uaccess_tags_only_work_below_73():
    assert int(RULES_FILE.split("-")[0]) < 73


def test_a_rule_that_is_not_there_is_an_error():
    with pytest.raises(LookupError):
        udev_rule("ffff")


def test_the_command_prints_the_file_as_it_is():
    result = CliRunner().invoke(devices_command, ["--udev"])
    assert result.exit_code == 0
    assert result.output == udev_rules()
