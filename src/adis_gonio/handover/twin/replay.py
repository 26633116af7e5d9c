"""Measure the twin as the session was measured: same positions, same times, same settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import solvable
from adis_gonio.base.errors import AdisGonioError, DataError
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, GYRO_OUT
from adis_gonio.device.sensor.settings import sample_period_s
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.handover.twin.world import LikeWorld, noise_of
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim.bus import SimBus
from adis_gonio.tracing.trace_calibrations import gyros_as_recorded

_OPENING_S = 5.0
"""Time of the world at which the session begins: the driver has opened the sensor by then."""
_REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


@solvable
def simulate_like(session: Session, traced: Fit, *, seed: int = 0) -> Session:
    """Session from the simulator whose world is a traced model, gyros and all where these are calibrated.

    The sensor is read through the driver, frame by frame. Where the session gives no time for a move, the
    twin is that much later.

    Parameters
    ----------
    session : Session
        The measured one.
    traced : Fit
        Final model of its trace; dwells for checking stand where they fit it best.
    seed : int
        Of noise and fixture errors.

    Raises
    ------
    DataError
        A dwell is too short to have a noise, or the session is one pose.
    """
    if len(session.dwells) < 2:
        raise DataError("a twin needs a session of several positions")
    data = readings_of(session)
    fit = traced.on(data)
    noise = noise_of(session, data.unit)
    gyro = _gyros_of(session)
    names = _REGISTERS if gyro is None else (*_REGISTERS, *GYRO_OUT)
    world = LikeWorld(fit, noise, sensor=session.sensor, seed=seed, offset_s=_OPENING_S, gyro=gyro)
    bus = SimBus(world=world, stream=True)
    begin_s = float(session.dwells[0].time_s[0])
    period_s = sample_period_s(noise.smpl_prd)
    dwells: list[Dwell] = []
    with Adis16354(bus, world.variant, check=False) as sensor:
        sensor.configure(smpl_prd=noise.smpl_prd, filter_m=noise.filter_m, data_ready=True)
        for k, dwell in enumerate(session.dwells):
            if dwell.angle_deg is not None and data.planar:
                bus.stage.move_to(dwell.angle_deg, dwell.approach)
            else:
                bus.stage.orient(_attitude(fit, k))
            start_s = float(dwell.time_s[0]) - begin_s + _OPENING_S
            settle_s = sensor.configuration().settling_s
            bus.sleep_s(max(start_s - bus.now_s(), settle_s, 0.5))
            length_s = float(dwell.time_s[-1] - dwell.time_s[0])
            count = max(2, round(length_s / period_s) + 1)
            block = sensor.read_scans(count, names)
            dwells.append(
                replace(
                    dwell,
                    time_s=block.time_s - _OPENING_S + begin_s,
                    accel=block.numbers()[:, : dwell.accel.shape[1]].astype(np.float64),
                    gyro=None if gyro is None else block.gyro_dps,
                    temperature_c=block.temperature_c if dwell.temperature_c is not None else None,
                    supply_v=block.supply_v if dwell.supply_v is not None else None,
                    first_row=None,
                )
            )
    return replace(
        session,
        dwells=tuple(dwells),
        sensor=world.variant.name,
        accel_unit="lsb",
        gyro_unit="dps",
        title=f"twin of {session.title or session.source}",
        source="",
        notes=(),
        facts={"configuration": {"smpl_prd": noise.smpl_prd, "filter_m": noise.filter_m}},
    )


def _gyros_of(session: Session) -> GyroCalibration | None:
    """Faults of the gyros; None where the session has none or does not calibrate them."""
    try:
        return gyros_as_recorded(session)
    except AdisGonioError:
        return None


def _attitude(fit: Fit, k: int) -> list[float]:
    """What an ideal sensor reads in dwell k, as a direction."""
    if fit.data.planar:
        psi = float(fit.values.base[0] + fit.values.attitude[k])
        return [float(np.cos(psi)), float(np.sin(psi)), 0.0]
    return [float(value) for value in fit.values.attitude[k]]
