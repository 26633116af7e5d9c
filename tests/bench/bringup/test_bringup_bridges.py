"""The harmless steps over every bridge's fake: what a bridge has not is said, never guessed."""

import itertools

import pytest

from adis_gonio.bench.bringup import STEPS, Verdict, bring_up
from adis_gonio.sim.chip import State
from fakes.benches import StoppedHost, open_bridge

NAMES = ("link", "timing", "supply", "variant", "sample rate", "data-ready")


def done(kind, options="", names=NAMES):
    bus, chip = open_bridge(kind, options)
    with bus:
        found = bring_up(bus, steps=tuple(step for step in STEPS if step.name in names))
    assert chip.state is State.RUNNING
    assert not found.accused, [found.row(name).text for name in found.accused]
    return found


@pytest.mark.parametrize("kind", ["mcp2210", "cp2130", "spidev"])
def test_a_bridge_without_data_ready_says_so_and_measures_the_rest(kind):
    found = done(kind)
    assert found.row("data-ready").text == (
        "this bridge has no data-ready input (neither streams nor an event counter)"
    )
    assert found.answers["data_ready_edge"].text.startswith("this bridge has no")
    assert all(found.row(name).verdict is Verdict.OK for name in ("link", "timing", "supply", "variant"))
    rate = found.row("sample rate")
    if kind == "mcp2210":
        assert rate.text.startswith("this bridge reads a word in 2")
    else:
        assert rate.figures[0].value == pytest.approx(819.2, rel=1e-3)


@pytest.mark.parametrize("kind", ["mcp2210", "cp2130"])
def test_a_bridge_that_only_counts_edges_says_what_it_cannot_tell(kind):
    found = done(kind, "?event_counter=1")
    assert "edges" in found.row("data-ready").text
    assert "not measured, this bridge starts no scans at the edge" in found.row("data-ready").text
    assert found.answers["data_ready_edge"].outcome == "not measured"


def test_a_host_that_stops_at_any_time_finds_no_fault_of_the_data_ready_line():
    steps = tuple(step for step in STEPS if step.name == "data-ready")
    for at in itertools.count(1):
        bus, _ = open_bridge("cp2130", "?event_counter=1")
        bus._clock = clock = StoppedHost(bus._clock, at)
        with bus:
            assert bring_up(bus, steps=steps).row("data-ready").verdict is Verdict.OK, at
        if clock.looks < at:
            break
    assert at > 50


@pytest.mark.parametrize("options", ["", "?edge=rising"])
def test_the_firmware_finds_the_edge_that_leads_whichever_it_waits_for(options):
    names = ("link", "sample rate", "data-ready") if options else (*NAMES, "noise")
    found = done("serial", options, names)
    assert found.row("data-ready").verdict is Verdict.OK
    assert "first edge of the pulse leads" in found.row("data-ready").text
    assert options or "white behind the filter" in found.row("noise").text
    assert found.bridge["firmware"]


def test_a_bridge_that_polls_more_slowly_than_the_part_samples_shows_no_tones():
    """Its scans come at even times, 1.18 sample periods apart, and skip updates."""
    found = done("cp2130", names=("link", "bit errors", "noise"))
    assert found.row("noise").verdict is Verdict.NOT_MEASURED


def test_the_clocks_tried_are_the_bridges_own():
    found = done("cp2130", names=("link", "bit errors"))
    clocks = [figure.name for figure in found.row("bit errors").figures]
    assert clocks == [f"wrong of 1008 at {khz} kHz" for khz in ("93.75", "187.5", "375", "750", "1500")]
