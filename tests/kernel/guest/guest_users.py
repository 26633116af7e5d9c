"""What a person at the bench meets: the list of devices, missing permission, the udev rules."""

import grp
import json
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from adis_gonio.faces.cli import app
from kernel.bench import Bench, Forked, node, reload_rules, serials, settle

BENCH_USER = 4242
RULES = Path("/etc/udev/rules.d/70-adis-gonio.rules")
SUPPLY_5_V = 2730


def command(*arguments: str) -> str:
    """What `adis-gonio` prints; in this process, because the guest takes seconds to start a program."""
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.stdout


def open_as_user(users: Forked, urls: Sequence[str], groups: Sequence[str]) -> list[dict[str, Any]]:
    """Open boards as a user of some groups; return the outcome for each."""
    answer: list[dict[str, Any]] = users.ask(
        (urls, BENCH_USER, [grp.getgrnam(name).gr_gid for name in groups])
    )
    return answer


def plug_all(bench: Bench) -> list[str]:
    """One board of each kind; their URLs, for both of hidapi's backends."""
    bench.plug("mcp2210", "A1")
    bench.plug("cp2130", "B2")
    bench.plug("serial", "C3")
    return ["mcp2210:?backend=hidraw", "mcp2210:?backend=libusb", "cp2130:", f"serial:{node('C3', 'tty')}"]


@pytest.fixture
def no_rules(bench: Bench) -> Iterator[None]:
    """A machine on which the rules are not installed, nor afterwards."""
    RULES.unlink(missing_ok=True)
    reload_rules()
    yield
    RULES.unlink(missing_ok=True)
    reload_rules()


@pytest.mark.usefixtures("no_rules")
def test_boards_are_listed_and_refused_to_a_user_until_the_rules_are_installed(
    bench: Bench, users: Forked
) -> None:
    urls = plug_all(bench)
    ids = {
        serial: tuple((path / name).read_text().strip() for name in ("idVendor", "idProduct"))
        for serial, path in serials().items()
        if serial in ("A1", "B2", "C3")
    }
    assert ids == {"A1": ("04d8", "00de"), "B2": ("10c4", "87a0"), "C3": ("2341", "0043")}
    assert (serials()["A1"] / "product").read_text().strip() == "MCP2210 USB-to-SPI Master"
    devices = {
        row["url"]: row["description"] for row in json.loads(command("devices", "--json"))["devices"]
    }
    assert str(node("A1", "hidraw")) in devices["mcp2210:A1"]
    assert "CP2130" in devices["cp2130:B2"]
    assert "serial number C3" in devices[f"serial:{node('C3', 'tty')}"]

    # Debian gives ttys to dialout without any rule of ours: this user is in no group.
    refused = open_as_user(users, urls, [])
    assert [row.get("error") for row in refused] == ["CannotOpenError"] * len(urls)
    for row, words in zip(
        refused,
        ('SUBSYSTEM=="hidraw"', 'SUBSYSTEM=="usb"', 'ATTR{idProduct}=="87a0"', 'SUBSYSTEM=="tty"'),
        strict=True,
    ):
        assert "no permission" in row["message"]
        assert "adis-gonio devices --udev" in row["message"]
        assert words in row["message"]

    RULES.write_text(command("devices", "--udev"))
    reload_rules()
    bench.clear()
    plug_all(bench)
    settle()
    allowed = open_as_user(users, urls, ["plugdev", "dialout"])
    assert [row.get("message") for row in allowed] == [None] * len(urls)
    assert all(abs(row["supply"] - SUPPLY_5_V) < 100 for row in allowed)
    for place in (node("A1", "hidraw"), node("A1", "usb"), node("B2", "usb")):
        assert stat.filemode(place.stat().st_mode) == "crw-rw----"
        assert place.group() == "plugdev"
