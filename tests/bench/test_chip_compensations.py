"""What the chip takes off its own readings (MSC_CTRL[7:6]) is said wherever a session is shown."""

import pytest

from adis_gonio.bench.events import Configured
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.faces.bench_words import configuration_lines
from adis_gonio.handover.calibration_report import facts
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings

SAID = {
    "linear_g": "gyros for linear acceleration (MSC_CTRL[7])",
    "origin": "accelerometers for their places (MSC_CTRL[6])",
}


@pytest.mark.parametrize("bits", [(), ("linear_g",), ("origin",), ("linear_g", "origin")])
def test_a_session_and_its_report_say_what_the_chip_compensates_and_nothing_where_it_does_not(
    bits, tmp_path
):
    path = tmp_path / "a.session"
    with open_sensor("sim:?seed=1") as sensor:
        sensor.configure(**dict.fromkeys(bits, True))
        runner = SessionRunner.begin(sensor, path, plan("two-position"), Settings(dwell_s=1.0), auto=True)
        (seen,) = [event for event in runner.run() if isinstance(event, Configured)]
    said = [line for line in configuration_lines(seen) if "compensates" in line]
    assert said == ([f"the chip compensates {', '.join(SAID[bit] for bit in bits)}"] if bits else [])
    session = load_session(path)
    assert {name: session.facts["configuration"][name] for name in SAID} == {
        name: name in bits for name in SAID
    }
    shown = facts(session)["the chip compensates"]
    assert shown.splitlines() == [SAID[bit] for bit in bits]
