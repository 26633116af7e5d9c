"""Sessions of the simulated sensor, as `adis-gonio simulate` records them, in a third of its time.

Driver, bus, world, plan and file are the same and so are the samples, bit by bit (test_trace_simulated.py
compares them). What is left out is for an operator: a fit after each dwell, and a look at whether each
place is the one that was asked for.
"""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.record.plans import find_plan
from adis_gonio.record.source import Settings


class _Unattended(SessionRunner):
    """A runner that nobody watches."""

    judges_places = False


def record(
    path: Path,
    seed: int,
    *effects: str,
    positions: int | None = None,
    dwell_s: float = 3.0,
    filter_m: int = 2,
    smpl_prd: int = 1,
    **settings: float,
) -> Path:
    """Record a tumble to `path`, which is given back.

    Parameters
    ----------
    effects : str
        As after `--effect`: "quadratic:k2_x=3".
    positions : int, optional
        Angles of a turn; there and back are twice as many dwells. By default those of the plan, twelve.
    smpl_prd : int
        As in the register: 819.2 samples/s at 1, 205 at 7, which take a quarter of the time to make.
    settings : float
        Of the simulated world, as after `--set`.
    """
    pairs = {"seed": seed, "variant": "adis16354", **settings}
    if effects:
        pairs["effects"] = ";".join(effects)
    url = "sim:?" + "&".join(f"{key}={quote(str(value), safe=':=,;.')}" for key, value in pairs.items())
    with open_sensor(url) as sensor:
        world = sensor.bus.world.settings
        runner = _Unattended.begin(
            sensor,
            path,
            find_plan("tumble", positions, 0),
            Settings(dwell_s=dwell_s, smpl_prd=smpl_prd, filter_m=filter_m),
            auto=True,
            gravity_mps2=world.gravity_mps2,
            fixture_sigma_deg=world.fixture_sigma_deg,
        )
        for _ in runner.run(so_far=False):
            pass
    return path
