"""How often the verification accuses a sound part or misses a wrong one, and whether its u is one.

scripts/writeback_statistics.py states the rates of many parts.
"""

import numpy as np

from adis_gonio import load_session
from adis_gonio.bench.writeback import OffsetWriter, WriteSettings
from adis_gonio.bench.writeback.offset_checks import SIGMAS, Accelerometers, compare_effect
from adis_gonio.device.sensor import Adis16354
from adis_gonio.record.archive import ArchiveView
from bench.writeback.rig import new_bus, numbers, record

PARTS = 12
LSB = 0.4672


def test_sound_parts_are_written_and_what_is_left_is_within_an_lsb(tmp_path):
    """None of 12 sound parts is accused (a rate above 22 % would show so with 95 %), and u holds."""
    effects, angles, left = [], [], []
    for seed in range(100, 100 + PARTS):
        bus = new_bus(seed)
        path = record(tmp_path / f"{seed}.session", bus)
        made = OffsetWriter(Adis16354(bus), path, WriteSettings(dwell_s=0.5, save=True, angle_deg=90.0))
        made.plan()
        outcome = made.write()
        assert outcome.endurance_after == 1
        before, moved, after = outcome.checks
        effects += moved.off.tolist()
        angles += [*before.off, *after.off]
        now = bus.now_s()
        truth = bus.world.truth(np.linspace(now - 1.0, now, 16))
        left += [truth[f"bias_{axis}"] + LSB * n for axis, n in zip("xy", numbers(bus)[:2], strict=True)]
    # Flicker (0.1 mg) and the fit's own u stand beside the half LSB of rounding.
    assert np.abs(left).max() < LSB + 0.5
    assert np.sqrt(np.mean(np.square(left))) < LSB
    for off in (effects, angles):
        assert np.abs(off).max() < SIGMAS
        # Conservative (flicker's floor, a fixture that nobody stated), but no wider than three times.
        assert 0.2 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_write_that_did_nothing_or_went_the_wrong_way_never_passes(tmp_path):
    """The effect that was planned is some 10 mg: neither zero nor its negative is within four u of it."""
    missed = 0
    for seed in range(100, 106):
        bus = new_bus(seed)
        path = record(tmp_path / f"{seed}.session", bus)
        made = OffsetWriter(Adis16354(bus), path, WriteSettings(dwell_s=0.5))
        plan = made.plan()
        if max(abs(axis.effect) for axis in plan.axes) < 2.0:
            continue
        from adis_gonio.bench.writeback.offset_checks import measure

        nothing = measure(made.sensor, 0.5, 60.0)
        missed += compare_effect(made._part, plan, made._planned[1], nothing).agrees
        for axis in plan.axes:  # the sign that doubles the bias
            made.sensor.write(axis.register, -axis.new)
        doubled = measure(made.sensor, 0.5, 60.0)
        missed += compare_effect(made._part, plan, made._planned[1], doubled).agrees
        session = load_session(path)
        with ArchiveView(path) as view:
            angle = view.plan().positions[0].angle_deg
        missed += Accelerometers(session, None, angle).expected(plan.carried_out, doubled).agrees
    assert missed == 0
