"""Sessions of the simulated sensor, recorded through chip and driver, at a time that a test chooses."""

from __future__ import annotations

from pathlib import Path

from adis_gonio import open_sensor
from adis_gonio.bench import runner as runner_module
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings


def recorded(
    path: Path,
    monkeypatch,
    *,
    when: str = "2024-03-01T09:00:00.000+00:00",
    url: str = "sim:?seed=1",
    serial: str = "A7",
    operator: str = "Ada",
    stage: str = "rotary 3",
    positions: int | None = None,
    name: str = "four-position",
    dwell_s: float = 0.5,
) -> Path:
    """A session file; the wall clock is the one thing that is not simulated."""
    monkeypatch.setattr("adis_gonio.record.archive_tables.utc_now", lambda: when)
    with open_sensor(url) as sensor:
        settings = Settings(dwell_s=dwell_s)
        world = sensor.bus.world.settings
        runner = runner_module.SessionRunner.begin(
            sensor,
            path,
            plan(name, positions),
            settings,
            auto=True,
            serial=serial,
            operator=operator,
            stage=stage,
            fixture_sigma_deg=world.fixture_sigma_deg,
            created_utc=when,
        )
        run_through(runner)
    return path


def run_through(runner: SessionRunner) -> None:
    """To the end, as the plain face does without anybody to ask."""
    from adis_gonio.faces.cli.line_prompts import PlainBench

    assert PlainBench(runner, auto=True).run()
