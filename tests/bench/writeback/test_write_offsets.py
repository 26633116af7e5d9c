"""Offsets written back to simulated parts: sign, flash count, every refusal, undo, Ctrl-C, a kill."""

import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import fit, load_session
from adis_gonio.base.errors import (
    AdisGonioError,
    ChipError,
    FitError,
    SessionError,
    UsageError,
    VerifyError,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.bench.writeback import (
    OffsetWriter,
    WriteSettings,
    plan_offsets,
)
from adis_gonio.bench.writeback.offset_plan import recorded_offsets
from adis_gonio.calibrate import Calibration
from adis_gonio.device.sensor import Adis16354
from adis_gonio.handover.session_export import ExportSource
from adis_gonio.record.write_journal import describe_writes, operations
from bench.writeback.rig import OFFSETS, flash, new_bus, numbers, record
from fakes.boards import Board

SHORT = WriteSettings(dwell_s=0.5)
SAVE = WriteSettings(dwell_s=0.5, save=True)
OLD, NEW = (0, 0, 0), (-32, -34, 0)
LSB = 0.4672


def writer(bus, path, settings=SHORT, tell=None):
    return OffsetWriter(Adis16354(bus, bus.world.variant), path, settings, tell=tell or (lambda text: None))


def wrote(bus, path, settings=SHORT):
    made = writer(bus, path, settings)
    made.plan()
    return made.write()


def shown_bias(bus, scans=2000):
    """Bias (2,) by half the sum of opposite positions, whatever a fit thinks: x(θ) + x(θ + 180°) = 2b."""
    sensor = Adis16354(bus, bus.world.variant)
    total = np.zeros(2)
    for angle in (0, 90, 180, 270):
        bus.stage.move_to(angle, 1)
        bus.sleep_s(3.0)
        total += sensor.read_scans(scans).accel_mg.mean(axis=0)[:2]
    return total / 4


# -- the plan --------------------------------------------------------------------------------------------


def test_the_plan_takes_the_bias_off_to_half_an_lsb_and_leaves_z_alone(recorded):
    session = load_session(recorded)
    result = fit(session)
    plan = plan_offsets(session, result, recorded_offsets(session))
    assert [axis.register for axis in plan.axes] == ["XACCL_OFF", "YACCL_OFF"]
    for axis in plan.axes:
        bias = result[f"bias_{axis.axis}"].value
        assert axis.new == -round(bias / LSB)
        assert abs(bias + axis.effect) <= LSB / 2 + 1e-9
        assert axis.bias_after == pytest.approx(bias + axis.effect)
        assert not axis.clipped


def test_what_the_part_shows_falls_from_its_bias_to_within_an_lsb(path):
    before = shown_bias(new_bus(3))
    assert (np.abs(before) > 10).all(), "the part is to have something to write"
    bus = new_bus(3)
    wrote(bus, path)
    assert (np.abs(shown_bias(bus)) < LSB + 0.25).all()


def test_a_session_recorded_with_offsets_counts_from_them_and_ends_at_the_same_registers(tmp_path):
    held = {"XACCL_OFF": 20, "YACCL_OFF": -7}
    path = record(tmp_path / "held.session", new_bus(3, flash=held))
    bus = new_bus(3, flash=held)
    outcome = wrote(bus, path, SAVE)
    assert np.abs(np.subtract(numbers(bus), NEW)).max() <= 1
    assert outcome.standing.registers == "new"
    undone = writer(bus, path)
    undone.undo()
    assert numbers(bus) == flash(bus) == (20, -7, 0)


def test_a_bias_beyond_the_register_is_clipped_and_said(recorded):
    session = load_session(recorded)
    held = session.facts["registers"]["configured"] | {"XACCL_OFF": -2030}
    far = replace(session, facts=session.facts | {"registers": {"configured": held}})
    result = fit(session)
    x, y = plan_offsets(far, result, recorded_offsets(far)).axes
    assert (x.new, x.clipped, y.clipped) == (-2048, True, False)
    assert x.bias_after == pytest.approx(result["bias_x"].value - 18 * LSB)


def test_three_axes_of_a_session_in_space(tmp_path):
    path = record(tmp_path / "poses.session", new_bus(5), "poses")
    bus = new_bus(5)
    truth = bus.world.truth()
    outcome = wrote(bus, path, SAVE)
    for axis, number in zip("xyz", numbers(bus), strict=True):
        assert abs(truth[f"bias_{axis}"] + number * LSB) < LSB + 1.0  # flicker and warmth beside it
    assert outcome.endurance_after == 1


@pytest.mark.parametrize("part", ["adis16350", "adis16355"])
def test_the_siblings_with_their_own_lsb(tmp_path, part):
    path = record(tmp_path / "sibling.session", new_bus(2, part), dwell_s=3.0, fixture_sigma_deg=0.05)
    bus = new_bus(2, part)
    truth = bus.world.truth()
    outcome = wrote(bus, path, WriteSettings(dwell_s=3.0, save=True, doubtful=True))
    assert outcome.standing.registers == "new"
    for k, axis in enumerate("xy"):
        assert abs(truth[f"bias_{axis}"] + numbers(bus)[k] * 2.522) < 2 * 2.522 + 4


# -- what is sent, and the flash -------------------------------------------------------------------------


def test_no_frame_writes_anything_but_the_two_offsets_and_the_flash_command(path):
    bus = new_bus(3)
    made = writer(bus, path, SAVE)
    bus.arm()
    made.plan()
    assert not any(frame & 0x8000 for frame in bus.log), "a plan only reads"
    outcome = made.write()
    writes = [frame for frame in bus.log if frame & 0x8000]
    assert writes == [0xA000 | 0xE0, 0xA100 | 0x0F, 0xA200 | 0xDE, 0xA300 | 0x0F, 0xBE08]
    assert (outcome.endurance_before, outcome.endurance_after) == (0, 1)
    assert bus.chip.memory["ENDURANCE"] == 1
    assert numbers(bus) == flash(bus) == NEW


def test_a_flash_with_fewer_writes_than_the_save_left_is_not_said_to_hold_it(path):
    assert wrote(new_bus(3), path, SAVE).standing.saved is True
    other = new_bus(3)  # as a simulated part without a file for its flash starts again
    held = writer(other, path, SAVE).standing()
    assert (held.registers, held.saved) == ("old", None)
    assert {"ENDURANCE", "0", "1"} <= set(held.text.replace(":", "").split())
    assert "power-on" not in held.text


def test_without_save_the_flash_is_left_and_the_next_start_says_that_the_power_was_off(path):
    bus = new_bus(3)
    outcome = wrote(bus, path)
    assert numbers(bus) == NEW
    assert flash(bus) == OLD
    assert bus.chip.memory["ENDURANCE"] == 0
    assert outcome.standing.saved is False
    assert "lost with the power" in outcome.standing.text
    bus.power_on()
    standing = writer(bus, path).standing()
    assert standing.registers == "old"
    assert "power was off" in standing.text


def test_writing_twice_writes_once_and_saving_later_writes_the_flash_alone(path):
    bus = new_bus(3)
    wrote(bus, path)
    again = writer(bus, path)
    assert not again.plan().changes
    bus.arm()
    again.write()
    assert not any(frame & 0x8000 for frame in bus.log)
    later = writer(bus, path, SAVE)
    later.plan()
    bus.arm()
    assert later.write().standing.saved
    assert [frame for frame in bus.log if frame & 0x8000] == [0xBE08]
    assert flash(bus) == NEW
    wrote(bus, path, SAVE)
    assert bus.chip.memory["ENDURANCE"] == 1


def test_the_last_write_that_the_flash_is_made_for_is_done(path):
    bus = new_bus(3, endurance=9_999)
    assert wrote(bus, path, SAVE).endurance_after == 10_000


def test_a_new_plan_must_precede_each_write(path):
    made = writer(new_bus(3), path)
    with pytest.raises(UsageError, match="plan"):
        made.write()


# -- refusals --------------------------------------------------------------------------------------------


def refused(bus, path, error, match, settings=SAVE):
    """The refusal is one line, and nothing was written: neither to the part nor to the file."""
    before = path.read_bytes()

    def planned():
        made = writer(bus, path, settings)
        bus.arm()
        made.plan()

    with pytest.raises(error, match=match) as caught:
        planned()
    assert "\n" not in str(caught.value)
    assert not any(frame & 0x8000 for frame in bus.log)
    assert path.read_bytes() == before


def test_another_part_behind_the_same_url_is_seen_at_rest(tmp_path, path):
    other = new_bus(4)
    other.url = "sim:?seed=3"
    refused(other, tmp_path / "part3.session", SessionError, "another part")


def test_another_part_is_seen_by_the_length_of_gravity_where_no_angle_is_known(tmp_path, path):
    # Angle 45 degrees is known to nobody; 30 mg on X and Y change the length by their sum along gravity.
    other = new_bus(3, bias_x_mg=-30.0, bias_y_mg=-30.0)
    other.stage.move_to(-45.0)
    stage = other.stage
    other.stage = None
    refused(other, tmp_path / "part3.session", SessionError, r"\|g\|.*another part")
    same = new_bus(3)
    same.stage.move_to(-45.0)
    same.stage = None
    assert writer(same, path).plan().changes
    other.stage = stage


def test_another_simulated_sensor_and_another_variant_are_refused(tmp_path, path):
    refused(new_bus(4), tmp_path / "part3.session", SessionError, "open that one")
    other = new_bus(3, "adis16350")
    refused(other, tmp_path / "part3.session", SessionError, "ADIS16354")


def test_offsets_that_somebody_else_changed_are_refused(tmp_path, path):
    bus = new_bus(3, flash={"YACCL_OFF": 5})
    refused(bus, tmp_path / "part3.session", SessionError, "YACCL_OFF was 0 .* and is 5")
    bus = new_bus(3, flash={"ZACCL_OFF": 5})
    refused(bus, tmp_path / "part3.session", SessionError, "ZACCL_OFF")


@pytest.mark.parametrize("supply_v", [4.6, 5.4])
def test_a_supply_out_of_range_is_refused(tmp_path, path, supply_v):
    refused(new_bus(3, supply_v=supply_v), tmp_path / "part3.session", ChipError, "the supply is")


def test_a_worn_flash_is_refused_where_it_would_be_written(tmp_path, path):
    refused(new_bus(3, endurance=10_000), tmp_path / "part3.session", ChipError, "made for 10000")
    assert writer(new_bus(3, endurance=10_000), path, SHORT).plan().changes


def test_a_part_that_lies_flat_or_moves_is_refused(tmp_path, path):
    bus = new_bus(3)
    bus.stage.orient((0.0, 0.0, -1.0))
    bus.sleep_s(3)
    bus.stage = None
    refused(bus, tmp_path / "part3.session", FitError, "set the part up")
    shaken = new_bus(3, table_vibration_mg=300.0)
    patient = WriteSettings(dwell_s=0.5, patience_s=2.0)
    refused(shaken, tmp_path / "part3.session", SessionError, "does not come to rest", patient)


def test_two_positions_a_csv_and_an_open_end_are_refused(tmp_path):
    two = record(tmp_path / "two.session", new_bus(3), "two-position")
    refused(new_bus(3), two, SessionError, "gives no bias")
    csv = tmp_path / "a.csv"
    csv.write_text("# sensor: adis16354\ntime_s,ax,ay\n0,1,2\n")
    refused(new_bus(3), csv, SessionError, "is no session file")


def test_a_model_that_lacks_something_is_refused_unless_told(tmp_path):
    from adis_gonio.model.effects import parse_effect
    from adis_gonio.sim import World, WorldSettings
    from bench.writeback.rig import PowerBus

    def bent():
        effects = [parse_effect("quadratic:k2_x=15")]
        world = World(WorldSettings(), seed=3, effects=effects)
        return PowerBus(world=world, url="sim:?seed=3")

    path = record(tmp_path / "bent.session", bent(), "tumble", fixture_sigma_deg=0.02)
    refused(bent(), path, SessionError, "not reliable enough .*chi2")
    told = WriteSettings(dwell_s=0.5, doubtful=True)
    plan = writer(bent(), path, told).plan()
    assert plan.changes
    assert plan.doubts


def test_a_bias_smaller_than_its_uncertainty_is_a_doubt(recorded):
    session = load_session(recorded)
    result = fit(session)
    vague = result.parameters | {"bias_y": replace(result["bias_y"], u=30.0)}
    plan = plan_offsets(session, replace(result, parameters=vague), recorded_offsets(session))
    assert len(plan.doubts) == 1
    assert "bias_y" in plan.doubts[0]
    assert "even its sign is open" in plan.doubts[0]


# -- what the part does not do as planned -----------------------------------------------------------------


def test_a_part_whose_register_has_another_lsb_is_set_back(path):
    """The register's LSB on the ADIS16354 is known from code alone: the dwell after the write proves it."""
    bus = Board(offset_lsb=2).open(3)
    bus.url = "sim:?seed=3"
    made = OffsetWriter(Adis16354(bus), path, WriteSettings(dwell_s=0.5, save=True))
    made._angle_deg = made._part.angle_deg = None  # a board of this fake has no stage that moves it
    plan = made._part.plan(dict.fromkeys(("XACCL_OFF", "YACCL_OFF", "ZACCL_OFF"), 0))
    from adis_gonio.bench.writeback.offset_checks import measure

    made._planned = plan, measure(made.sensor, 0.5, 60.0)
    with pytest.raises(VerifyError, match=r"not as planned.*the old offsets") as caught:
        made.write()
    assert "\n" not in str(caught.value)
    assert numbers(bus) == OLD
    assert bus.chip.memory["ENDURANCE"] == 0
    assert made.standing().registers == "old"
    assert not made.standing().open


def test_a_register_that_does_not_take_its_number_is_told_and_the_other_set_back(path):
    bus = new_bus(3)
    made = writer(bus, path, SAVE)
    made.plan()
    exchange = bus._exchange
    bus._exchange = lambda frames: exchange(
        np.where(frames & 0xFE00 == 0xA200, 0, frames).astype(np.uint16)
    )
    with pytest.raises(VerifyError, match=r"YACCL_OFF: wrote .*holds the old offsets"):
        made.write()
    assert numbers(bus) == OLD


def test_a_supply_that_falls_after_the_write_is_seen_before_the_flash_is_written(path):
    bus = new_bus(3)
    made = writer(bus, path, SAVE)
    made.plan()
    bus.world.bring_to(bus.now_s() + 1.0, supply_v=4.5)
    with pytest.raises(ChipError, match=r"4.50 V.*holds the old offsets"):
        made.write()
    assert numbers(bus) == flash(bus) == OLD
    assert bus.chip.memory["ENDURANCE"] == 0


def test_a_part_that_is_knocked_during_the_dwell_after_is_set_back(path):
    bus = new_bus(3)
    made = writer(bus, path, SAVE, tell=lambda text: "after" in text and bus.stage.move_to(3.0))
    made.plan()
    with pytest.raises(AdisGonioError, match="holds the old offsets"):
        made.write()
    assert numbers(bus) == OLD


# -- undo ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("save", [False, True])
def test_undo_sets_back_and_saves_what_was_saved(path, save):
    bus = new_bus(3)
    wrote(bus, path, SAVE if save else SHORT)
    outcome = writer(bus, path).undo()
    assert numbers(bus) == flash(bus) == OLD
    assert bus.chip.memory["ENDURANCE"] == (2 if save else 0)
    assert outcome.standing.registers == "old"
    assert not outcome.standing.open
    with pytest.raises(SessionError, match="nothing to undo"):
        writer(bus, path).undo()
    wrote(bus, path, SAVE)
    assert numbers(bus) == flash(bus) == NEW


def test_undo_refuses_registers_that_are_somebody_elses(path):
    bus = new_bus(3)
    wrote(bus, path)
    Adis16354(bus).write("XACCL_OFF", 77)
    with pytest.raises(SessionError, match="neither the old nor the new"):
        writer(bus, path).undo()
    assert numbers(bus)[0] == 77
    with pytest.raises(SessionError, match="XACCL_OFF was 0"):
        writer(bus, path).plan()


def test_undo_without_a_write_is_refused(path):
    with pytest.raises(SessionError, match="nothing to undo"):
        writer(new_bus(3), path).undo()


def test_other_offsets_of_the_same_session_are_refused_until_the_first_are_undone(path):
    bus = new_bus(3)
    wrote(bus, path)
    other = writer(bus, path)
    result = other._part.result
    more = {"bias_x": replace(result["bias_x"], value=result["bias_x"].value + 5.0)}
    other._part.result = replace(result, parameters=result.parameters | more)
    with pytest.raises(SessionError, match="--undo them first"):
        other.plan()
    assert numbers(bus) == NEW


def test_a_save_that_fails_leaves_what_the_write_before_had_left(path):
    bus = new_bus(3)
    wrote(bus, path)
    made = writer(bus, path, SAVE)
    made.plan()
    exchange = bus._exchange
    bus._exchange = lambda frames: exchange(np.where(frames == 0xBE08, 0, frames).astype(np.uint16))
    with pytest.raises(VerifyError, match=r"ENDURANCE was 0 and is 0.*new offsets, not saved"):
        made.write()
    bus._exchange = exchange
    assert (numbers(bus), flash(bus)) == (NEW, OLD)
    assert fit(load_session(path)).calibration().provenance.offsets_lsb == tuple(NEW)
    assert writer(bus, path).undo().standing.registers == "old"
    assert (numbers(bus), bus.chip.memory["ENDURANCE"]) == (OLD, 0)


# -- Ctrl-C and a kill -------------------------------------------------------------------------------------


def test_a_ctrl_c_at_any_exchange_of_the_write_leaves_old_or_new_and_says_which(recorded, tmp_path):
    ended = Counter()
    for at in [*range(24), *range(24, 4000, 97)]:
        path = shutil.copy(recorded, tmp_path / "c.session")
        bus, told = new_bus(3), []
        made = writer(bus, path, SAVE, tell=told.append)
        made.plan()
        exchange, count = bus._exchange, [0]

        def stopped(frames, at=at, exchange=exchange, count=count):
            count[0] += 1
            if count[0] == at + 1:
                half = len(frames) // 2
                if half:
                    exchange(frames[:half])
                raise KeyboardInterrupt
            return exchange(frames)

        bus._exchange = stopped
        try:
            made.write()
        except KeyboardInterrupt:
            standing = writer(bus, path).standing()
            assert not standing.open or standing.registers in ("old", "new"), (at, standing)
            assert numbers(bus) == (NEW if standing.registers == "new" else OLD), at
            if standing.registers != "untouched":
                assert told[-1] == standing.text, at
            ended[standing.registers] += 1
        else:
            break
    assert ended["old"] > 10


@pytest.mark.parametrize("frames", [0, 1, 2, 3, 4])
def test_a_kill_between_the_bytes_is_named_half_and_finished_or_set_back(path, frames, tmp_path):
    """The program is gone and the power stays: nobody sets anything back."""
    bus = new_bus(3)
    made = writer(bus, path, SAVE)
    made.plan()
    exchange, count = bus._exchange, [0]

    def killed(batch):
        for k, frame in enumerate(batch.tolist()):
            if frame & 0x8000:
                count[0] += 1
                if count[0] > frames:
                    if k:
                        exchange(batch[:k])
                    bus._exchange = dead
                    raise KeyboardInterrupt
        if count[0] >= frames == 4 and not any(batch & 0x8000):
            bus._exchange = dead
            raise KeyboardInterrupt
        return exchange(batch)

    def dead(batch):
        raise KeyboardInterrupt

    bus._exchange = killed
    with pytest.raises(KeyboardInterrupt):
        made.write()
    bus._exchange = exchange
    standing = writer(bus, path).standing()
    assert standing.open
    assert standing.registers == ["old", "half", "half", "half", "new"][frames]
    assert "broke off after 'planned'" in standing.text
    with pytest.raises(SessionError, match="interrupted"):
        fit(load_session(path)).calibration()
    other = shutil.copy(path, tmp_path / "other.session")
    finished = wrote(bus, path, SAVE)
    assert numbers(bus) == flash(bus) == NEW
    assert finished.standing.saved
    writer(bus, path).undo()
    assert numbers(bus) == flash(bus) == OLD
    writer(bus, other).undo()
    assert numbers(bus) == OLD


# -- what coefficients still have to correct ---------------------------------------------------------------


def remaining(result):
    """The biases that the calibration of a fit states for the sensor as it is now."""
    calibration = result.calibration()
    return {name: calibration[name].value for name in ("bias_x", "bias_y")}


def test_calibrating_again_finds_the_bias_that_the_first_session_says_is_left(path, tmp_path):
    bus = new_bus(3)
    first = load_session(path)
    found = fit(first)
    assert remaining(found) == {n: found[n].value for n in ("bias_x", "bias_y")}
    made = OffsetWriter(Adis16354(bus), path, SAVE)
    plan = made.plan()
    made.write()
    after = fit(load_session(path))
    assert after.calibration().provenance.offsets_lsb == tuple(NEW)
    left = remaining(after)
    again = load_session(record(tmp_path / "again.session", bus, "tumble", fixture_sigma_deg=0.02))
    second = fit(again)
    assert tuple(again.facts["registers"]["configured"][name] for name in OFFSETS) == tuple(NEW)
    for axis in plan.axes:
        name = f"bias_{axis.axis}"
        u = np.hypot(found[name].u, second[name].u)
        assert abs(second[name].value) < LSB + 2.5 * second[name].u + 0.3  # flicker between the sessions
        assert abs(second[name].value - left[name]) < 3 * np.hypot(u, 0.2)
        assert abs(second[name].value - found[name].value) > 10, "corrected once, and by the chip"
    # Coefficients of the first session with the bias that is left show the angle as those of the second.
    x, y = second["bias_x"].value, second["bias_y"].value
    worst = {}
    for label, bx, by in (
        ("left", left["bias_x"], left["bias_y"]),
        ("twice", found["bias_x"].value, found["bias_y"].value),
    ):
        psi = np.radians(np.arange(0, 360, 15))
        gx, gy = 1000 * np.cos(psi) + x - bx, 1000 * np.sin(psi) + y - by
        worst[label] = np.degrees(np.abs(np.angle(np.exp(1j * (np.arctan2(gy, gx) - psi))))).max()
    assert worst["left"] < 0.06
    assert worst["twice"] > 0.8
    writer(bus, path).undo()
    assert remaining(fit(load_session(path))) == {n: found[n].value for n in ("bias_x", "bias_y")}


def test_a_resumed_session_refuses_a_part_with_other_offsets(path):
    from adis_gonio.bench.runner import SessionRunner

    bus = new_bus(3)
    wrote(bus, path)
    with Adis16354(bus) as sensor, pytest.raises(SessionError, match="XACCL_OFF was 0 and is -32"):
        list(SessionRunner.resume(sensor, path, auto=True).run(so_far=False))


def test_an_unfinished_session_goes_on_as_if_nothing_had_been_once_it_is_undone(tmp_path):
    from adis_gonio.bench.events import DwellDone
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.record.plans import plan
    from adis_gonio.record.source import Settings

    whole = record(tmp_path / "whole.session", new_bus(3))
    path = tmp_path / "part.session"
    settings = Settings(dwell_s=1.0, settle_s=0.1)
    runner = SessionRunner.begin(Adis16354(new_bus(3)), path, plan("four-position"), settings, auto=True)
    done = 0
    for event in runner.run(so_far=False):
        done += isinstance(event, DwellDone)
        if done == 3:
            runner.stop()
    bus = new_bus(3)
    wrote(bus, path, WriteSettings(dwell_s=0.5, doubtful=True))
    writer(bus, path).undo()
    list(SessionRunner.resume(Adis16354(new_bus(3)), path, auto=True).run(so_far=False))
    for a, b in zip(load_session(whole).dwells, load_session(path).dwells, strict=True):
        assert np.array_equal(a.accel, b.accel)
        assert np.array_equal(a.time_s, b.time_s)


def test_coefficients_do_not_correct_again_what_the_chip_corrects(recorded, path):
    then = fit(load_session(recorded))
    bus = new_bus()
    wrote(bus, path)
    session = load_session(path)
    now = fit(session)
    assert now["bias_x"].value == then["bias_x"].value  # the fit speaks of the recording
    calibration = now.calibration()
    for name, held in zip(("bias_x", "bias_y"), numbers(bus), strict=False):
        assert calibration[name].value == pytest.approx(now[name].value + held * LSB)
        assert abs(calibration[name].value) <= LSB / 2
    assert calibration.provenance.offsets_lsb == numbers(bus)
    loaded = Calibration.load(path)
    assert loaded.gyro is not None
    assert replace(loaded, gyro=None) == calibration
    assert any("offsets were written to the sensor" in line for line in now.warnings)
    writer(bus, path).undo()
    back = fit(load_session(path))
    assert back.calibration()["bias_x"].value == then["bias_x"].value
    assert not any("offsets were written" in line for line in back.warnings)


def test_an_export_after_an_unsaved_write_names_the_offsets_that_a_power_cycle_brings_back(path):
    bus = new_bus()
    for save, end in (
        (False, "not saved to flash: a power cycle brings back XACCL_OFF 0 and YACCL_OFF 0"),
        (True, "saved to flash"),
    ):
        wrote(bus, path, replace(SHORT, save=save))
        for kind in ("json", "c-header"):
            (remark,) = ExportSource(path).write(kind, path.with_suffix(f".{kind}"))
            assert f"hold only while the part holds the offsets written; they are {end}" in remark
    # A later write that is not saved: the flash has the numbers of the write before it.
    session = load_session(path)
    saved = session.facts["offset_writes"]
    other = [
        {**entry, "number": 9} | ({"new": dict.fromkeys(entry["new"], 7)} if "new" in entry else {})
        for entry in saved
        if entry["step"] != "saved"
    ]
    (text,) = describe_writes(operations([*saved, *other]), dict.fromkeys(OFFSETS, 0))
    assert f"brings back XACCL_OFF {numbers(bus)[0]}" in text
    writer(bus, path).undo()
    assert not ExportSource(path).write("c-header", path.with_suffix(".h"))


def test_after_an_interrupted_write_there_are_no_coefficients(path):
    wrote(new_bus(), path)
    whole = load_session(path)
    begun = whole.facts["offset_writes"][:2]
    session = replace(whole, facts={**whole.facts, "offset_writes": begun})
    assert "was interrupted" in describe_writes(operations(begun), dict.fromkeys(OFFSETS, 0))[0]
    with pytest.raises(SessionError, match="--status"):
        fit(session).calibration()


def test_a_session_that_was_written_back_names_the_undo_when_it_is_resumed(tmp_path):
    bus = new_bus(bias_x_mg=15.0, bias_y_mg=16.0)
    path = record(tmp_path / "a.session", bus)
    wrote(bus, path)
    again = SessionRunner.resume(Adis16354(bus), path, auto=True)
    with pytest.raises(SessionError, match=r"by adis-gonio write .*a\.session .* --undo, or begin"):
        list(again.run(so_far=False))
