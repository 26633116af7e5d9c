"""`devices` lists what others can use, whatever one package does; `serve` says who may connect."""

import json

import pytest

from adis_gonio.device.bus import Device, opening
from adis_gonio.faces.cli import main


class Point:
    """An entry point of a package that is not installed."""

    dist = None

    def __init__(self, name, finder):
        self.name, self.value, self._finder = name, f"my_bench.{name}:find_devices", finder

    def load(self):
        if isinstance(self._finder, ImportError):
            raise self._finder
        return self._finder


@pytest.fixture
def plugged(monkeypatch):
    """Adds finders beside those that are installed."""
    own = opening.entry_points

    def plug(*points: Point) -> None:
        monkeypatch.setattr(
            opening,
            "entry_points",
            lambda group: [*own(group=group), *(points if group == opening.DEVICE_GROUP else ())],
        )

    return plug


def rows(capsys) -> dict[str, str]:
    assert main(["devices", "--json"]) == 0
    return {row["url"]: row["description"] for row in json.loads(capsys.readouterr().out)["devices"]}


def broken():
    raise RuntimeError("no such thing:\n  as a bridge")


@pytest.mark.parametrize(
    ("finder", "says"),
    [
        (broken, "RuntimeError: no such thing: as a bridge"),
        (lambda: None, "TypeError"),
        (lambda: ["zap:1"], "no adis_gonio.device.bus.Device"),
        ("no function", "TypeError"),
    ],
)
def test_a_package_whose_finder_fails_is_named_in_one_line_and_hides_no_other(
    capsys, plugged, finder, says
):
    def late():
        return [Device("zzz:1", "found after it")]

    plugged(Point("broken", finder), Point("zzz", late))
    found = rows(capsys)
    assert found["zzz:1"] == "found after it"
    assert "sim:?seed=1" in found
    assert found["broken:"].startswith("not usable: my_bench.broken:find_devices failed: ")
    assert says in found["broken:"]
    assert "\n" not in found["broken:"]
    assert main(["devices"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert says in " ".join(out.split())


def test_the_extra_that_a_bus_needs_stands_in_the_list_word_for_word(capsys, plugged):
    plugged(Point("usb", ImportError("missing", name="libfoo")))
    assert main(["devices"]) == 0
    assert "libfoo is missing; run pip install '.[usb]'" in " ".join(capsys.readouterr().out.split())


def test_brackets_and_colons_of_a_description_are_no_markup(capsys, plugged):
    plugged(Point("odd", lambda: [Device("odd:[red]", "bench [bold]3[/] :warning:")]))
    assert main(["devices"]) == 0
    out = capsys.readouterr().out
    assert any(line.startswith("odd:[red] ") for line in out.splitlines())
    assert "bench [bold]3[/] :warning:" in out


@pytest.mark.parametrize(
    ("options", "address", "writing", "warned"),
    [
        ([], "127.0.0.1", "read-only", False),
        (["--allow-writes"], "::1", "clients may write", False),
        (["--listen", "0.0.0.0"], "0.0.0.0", "read-only", True),
        (["--listen", "fe80::1%eth0"], "fe80::1%eth0", "read-only", True),
    ],
)
def test_serve_tells_on_standard_error_where_and_to_whom(
    capsys, monkeypatch, options, address, writing, warned
):
    class Server:
        def __init__(self, sensor, host, port, *, allow_writes, tell, ready):
            self.ready = ready

        def run(self):
            self.ready(address, 30431)

    monkeypatch.setattr("adis_gonio.faces.serve.IioServer", Server)
    assert main(["serve", "sim:?seed=1", *options]) == 0
    out, err = capsys.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert (
        lines[0] == f"sim:?seed=1: served as iio:device0 at ip:{address}:30431, {writing}; Ctrl-C ends it"
    )
    assert ["there is no password" in line for line in lines[1:]] == [True] * warned
