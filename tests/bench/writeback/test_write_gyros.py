"""Zero rates of gyros written back to simulated parts: thirteen bits, apart from the accelerometers.

The estimates are the simulator's truth, so that what a fit errs by does not hide what the write errs by.
"""

import contextlib
import io
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import load_session
from adis_gonio.base.errors import AdisGonioError, SessionError, UsageError, VerifyError
from adis_gonio.bench.writeback import (
    OffsetWriter,
    WriteSettings,
)
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.cli import main
from adis_gonio.record.provenance import provenance_of
from adis_gonio.record.write_journal import describe_writes, operations
from adis_gonio.tracing.trace_calibrations import gyro_calibration_of
from bench.writeback.gyro_rig import FAULTS, GYROS, LSB, gyro_flash, gyro_numbers, known_gyros
from bench.writeback.rig import OFFSETS, flash, new_bus, numbers, record

SHORT = WriteSettings(dwell_s=2.0, gyros=True)
SAVE = WriteSettings(dwell_s=2.0, gyros=True, save=True)
ACCELEROMETERS = WriteSettings(dwell_s=0.5, save=True)
OLD = (0, 0, 0)
URL = "sim:?seed=3"


def part(**options):
    return new_bus(3, **FAULTS, **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record(tmp_path_factory.mktemp("gyros") / "part3.session", part())


@pytest.fixture
def path(recorded, tmp_path):
    return shutil.copy(recorded, tmp_path / "part3.session")


@pytest.fixture(autouse=True)
def known(monkeypatch):
    """What the session knows of its gyros; a test may put other estimates there."""
    held = {"estimates": known_gyros(part())}
    for module in ("tracing.trace_calibrations", "bench.writeback.offset_checks"):
        monkeypatch.setattr(
            f"adis_gonio.{module}.fit_gyro",
            lambda session: replace(held["estimates"], provenance=provenance_of(session)),
        )
    return held


def writer(bus, path, settings=SHORT, tell=None):
    return OffsetWriter(Adis16354(bus, bus.world.variant), path, settings, tell=tell or (lambda text: None))


def wrote(bus, path, settings=SHORT):
    made = writer(bus, path, settings)
    made.plan()
    return made.write()


def wanted(bus):
    truth = bus.world.truth()
    return tuple(-round(truth[f"gyro_bias_{axis}"] / LSB) for axis in "xyz")


def zero_rates(bus, angles=(0, 90, 180, 270)):
    """Zero rates (3,) by the mean over a turn, in which the plane's gravity cancels."""
    sensor, total = Adis16354(bus, bus.world.variant), np.zeros(3)
    for angle in angles:
        bus.stage.move_to(angle, 1)
        bus.sleep_s(3.0)
        total += sensor.read_scans(3000).gyro_dps.mean(axis=0)
    return total / len(angles)


# -- plan and write --------------------------------------------------------------------------------------


def test_the_zero_rates_fall_to_within_an_lsb_and_the_accelerometers_are_left_alone(path):
    before = zero_rates(part())
    assert (np.abs(before) > 0.3).all(), "the part is to have something to write"
    bus = part()
    outcome = wrote(bus, path)
    assert gyro_numbers(bus) == wanted(bus)
    assert numbers(bus) == OLD
    assert (np.abs(zero_rates(bus)) < LSB + 0.04).all()  # 1/f noise and the supply beside it
    assert [check.unit for check in outcome.checks] == ["dps"] * 3


def test_what_force_adds_in_the_pose_of_the_write_is_not_taken_for_a_zero_rate(path):
    """Y feels 0.24 °/s/g along X: in the pose of the write that is thirteen LSB."""
    bus = part()
    made = writer(bus, path)
    plan = made.plan()
    rest = made._planned[1]
    assert abs(rest.mean_dps[1] - FAULTS["gyro_bias_y_dps"]) > 0.15
    assert abs(plan.axes[1].bias_after) <= LSB / 2
    assert plan.axes[1].bias == pytest.approx(FAULTS["gyro_bias_y_dps"])
    made.write()


def test_the_numbers_are_thirteen_bits_of_the_same_size_at_every_range(path):
    for gyro_range, m in ((300, 2), (150, 2), (75, 4)):
        bus = part()
        sensor = Adis16354(bus, bus.world.variant)
        sensor.configure(gyro_range_dps=gyro_range, filter_m=m)
        made = OffsetWriter(sensor, path, SHORT)
        made.plan()
        made.write()
        assert gyro_numbers(bus) == wanted(bus)
        made.undo()


def test_a_plan_says_dps_and_only_the_gyros(path):
    bus = part()
    document = writer(bus, path).plan().as_dict()
    assert [axis["register"] for axis in document["axes"]] == list(GYROS)
    x = document["axes"][0]
    assert x["bias_dps"] == pytest.approx(1.21)
    assert x["new"] == -66
    assert x["new_word"] == (-66) & 0x1FFF
    assert x["bias_after_dps"] == pytest.approx(1.21 - 66 * LSB)
    assert not [key for key in x if key.endswith("_mg")]


def test_no_frame_writes_anything_but_the_gyro_offsets_and_the_flash_command(path):
    bus = part()
    made = writer(bus, path, SAVE)
    bus.arm()
    made.plan()
    assert not any(frame & 0x8000 for frame in bus.log), "a plan only reads"
    outcome = made.write()
    writes = [frame for frame in bus.log if frame & 0x8000]
    addresses = [(frame >> 8) & 0x3F for frame in writes]
    assert addresses == [0x1A, 0x1B, 0x1C, 0x1D, 0x1E, 0x1F, 0x3E]
    assert (outcome.endurance_before, outcome.endurance_after) == (0, 1)
    assert gyro_flash(bus) == wanted(bus)


def test_a_session_recorded_with_gyro_offsets_counts_from_them(tmp_path, known):
    held = {"XGYRO_OFF": 20, "ZGYRO_OFF": -7}

    def with_offsets():
        bus = part()
        for name, number in held.items():
            Adis16354(bus, bus.world.variant).write(name, number)
        return bus

    bus = with_offsets()
    path = record(tmp_path / "held.session", bus)
    # The fit sees what the part adds.
    known["estimates"] = known_gyros(part(), more={"gyro_bias_x": 20 * LSB, "gyro_bias_z": -7 * LSB})
    session = load_session(path)
    assert gyro_calibration_of(session).offsets_lsb == (20, 0, -7)
    wrote(bus, path)
    assert np.abs(np.subtract(gyro_numbers(bus), wanted(bus))).max() <= 1
    writer(bus, path).undo()
    assert gyro_numbers(bus) == (20, 0, -7)


def test_a_zero_rate_beyond_the_register_is_refused_with_what_it_holds(path, known):
    known["estimates"] = known_gyros(part(), more={"gyro_bias_y": 80.0})
    with pytest.raises(
        SessionError, match=r"YGYRO_OFF holds -4096 to 4095 \(-75.0 to 75.0 °/s\)"
    ) as caught:
        writer(part(), path).plan()
    assert "\n" not in str(caught.value)


def test_a_zero_rate_that_is_not_known_well_enough_is_doubtful(path, known):
    known["estimates"] = known_gyros(part(), u_dps=2.0)
    with pytest.raises(SessionError, match=r"gyro_bias_x is 1.2 °/s with u = 2 °/s: even its sign is open"):
        writer(part(), path).plan()


def test_another_part_s_gyros_are_seen_at_rest_and_nothing_is_written(path):
    other = new_bus(3, **{**FAULTS, "gyro_bias_z_dps": 0.9})
    with pytest.raises(SessionError, match="does not look like the part"):
        writer(other, path).plan()
    assert gyro_numbers(other) == OLD


def test_a_method_of_the_accelerometers_is_refused(path):
    with pytest.raises(UsageError, match="--method"):
        writer(part(), path, WriteSettings(gyros=True, method="ml"))


# -- undo, flash and the other half ----------------------------------------------------------------------


def test_undo_sets_back_and_saves_where_the_new_ones_were_saved(path):
    bus = part()
    wrote(bus, path, SAVE)
    outcome = writer(bus, path).undo()
    assert gyro_numbers(bus) == gyro_flash(bus) == OLD
    assert outcome.standing.registers == "old"
    assert bus.chip.memory["ENDURANCE"] == 2
    with pytest.raises(SessionError, match="nothing to undo"):
        writer(bus, path).undo()


def test_the_two_halves_are_written_and_undone_apart(path):
    bus = part()
    accelerometers = wrote(bus, path, ACCELEROMETERS)
    held = numbers(bus)
    assert held != OLD
    assert accelerometers.standing.registers == "new"
    wrote(bus, path, SAVE)
    assert (numbers(bus), gyro_numbers(bus)) == (held, wanted(bus))
    assert writer(bus, path, ACCELEROMETERS).standing().registers == "new"
    writer(bus, path).undo()
    assert (numbers(bus), gyro_numbers(bus)) == (held, OLD)
    assert writer(bus, path, ACCELEROMETERS).standing().saved is True
    writer(bus, path, ACCELEROMETERS).undo()
    assert (numbers(bus), flash(bus)) == (OLD, OLD)


def test_saving_one_half_saves_the_other_and_the_status_knows_it(path):
    """A flash update copies all registers: offsets that were written without --save are in flash then."""
    bus = part()
    wrote(bus, path)  # gyros, not saved
    assert writer(bus, path).standing().saved is False
    wrote(bus, path, ACCELEROMETERS)
    standing = writer(bus, path).standing()
    assert gyro_flash(bus) == wanted(bus)
    assert standing.saved is True
    assert "saved to flash" in standing.text
    bus.power_on()
    assert writer(bus, path).standing().registers == "new"
    writer(bus, path).undo()
    assert gyro_flash(bus) == OLD, "an undo takes what another save put into flash out again"


def test_a_power_cut_leaves_old_or_new_and_the_status_says_which(recorded, path, tmp_path):
    bus = part()
    made = writer(bus, path, SAVE)
    made.plan()
    bus.arm()
    made.write()
    frames = bus.frames
    rng = np.random.default_rng(6)
    seen = set()
    # Some cuts anywhere, and those about the flash update, which the last frames are.
    cuts = {*rng.choice(frames, 3, replace=False).tolist(), frames - 20, frames - 6}
    for cut in sorted(cuts):
        bus = part()
        copy = shutil.copy(recorded, tmp_path / f"{cut}.session")
        made = writer(bus, copy, SAVE)
        made.plan()
        bus.arm()
        bus.cut_after = cut
        with contextlib.suppress(AdisGonioError):  # the last frames come when all is done
            made.write()
        bus.power_on()
        standing = writer(bus, copy, SAVE).standing()
        assert standing.registers in ("old", "new")
        assert (gyro_numbers(bus) == wanted(bus)) == (standing.registers == "new")
        seen.add(standing.registers)
        wrote(bus, copy, SAVE)
        assert gyro_flash(bus) == wanted(bus)
    assert seen == {"old", "new"}


def test_coefficients_hold_for_the_sensor_as_it_is_and_the_session_says_so(path):
    bus = part()
    before = gyro_calibration_of(load_session(path))
    wrote(bus, path)
    session = load_session(path)
    after = gyro_calibration_of(session)
    assert after.offsets_lsb == gyro_numbers(bus)
    assert np.abs(after.bias_dps).max() <= LSB / 2 + 1e-12
    assert before.bias_dps == pytest.approx(list(FAULTS.values())[:3])
    (said,) = [note for note in session.notes if "offsets were written" in note]
    assert "XGYRO_OFF 0 → -66" in said
    assert "zero rates here" in said
    begun = session.facts["offset_writes"][:2]
    assert "was interrupted" in describe_writes(operations(begun), dict.fromkeys((*OFFSETS, *GYROS), 0))[0]


# -- the chip's own null ---------------------------------------------------------------------------------


def test_an_autonull_that_agrees_in_this_pose_is_kept_and_counted(path):
    bus, told = part(), []
    made = writer(bus, path, tell=told.append)
    made.plan()
    rest = made._planned[1]
    outcome = made.autonull()
    found = outcome.autonull
    assert found.agrees
    # Force along X goes into the chip's null of Y, and is accounted for.
    assert abs(made._part.gyro.force_part(rest.mean_mg / 1000)[1]) > 0.15
    assert np.abs(found.measured - found.expected).max() < 4 * found.u.max()
    assert (outcome.endurance_before, outcome.endurance_after) == (0, 1)
    assert gyro_numbers(bus) == gyro_flash(bus) != OLD
    assert writer(bus, path).standing().registers == "new"
    assert writer(bus, path).standing().saved is True
    assert any("by force" in line for line in told)
    writer(bus, path).undo()
    assert gyro_numbers(bus) == gyro_flash(bus) == OLD
    assert bus.chip.memory["ENDURANCE"] == 2


def test_without_the_g_sensitivity_the_same_null_would_be_refused(path, known):
    """The comparison is not blind: what force adds here is far beyond its uncertainty."""
    bus = part()
    made = writer(bus, path)
    made.plan()
    force = made._part.gyro.force_part(made._planned[1].mean_mg / 1000)
    found = made.autonull().autonull
    assert (np.abs(found.measured - found.expected + force) > 4 * found.u).any()


def test_an_autonull_of_a_part_that_turns_is_set_back_in_register_and_flash_and_says_by_how_much(path):
    bus = part()
    made = writer(bus, path, WriteSettings(dwell_s=2.0, gyros=True))
    made.plan()
    sample = bus.world.sample

    def turning(time_s):
        inputs = sample(time_s)
        return replace(inputs, gyro_dps=inputs.gyro_dps + np.array([0.0, 0.0, 4.0]))  # the bench turns

    bus.world.sample = turning
    bus.sleep_s(0.1)
    with pytest.raises(VerifyError, match=r"not kept: .* by Z \+[345]\.\d+ °/s") as caught:
        made.autonull()
    assert "\n" not in str(caught.value)
    assert gyro_numbers(bus) == gyro_flash(bus) == OLD
    assert bus.chip.memory["ENDURANCE"] == 2
    bus.world.sample = sample
    standing = writer(bus, path).standing()
    assert (standing.registers, standing.open) == ("old", False)


def test_a_power_cut_within_an_autonull_is_known_and_undone(path):
    bus = part()
    made = writer(bus, path)
    made.plan()
    bus.arm()
    exchange = bus._exchange

    def cut_after_the_command(frames):
        replies = exchange(frames)
        if 0xBE10 in frames.tolist():  # COMMAND[4]
            bus.sleep_s(0.02)
            bus.chip.hard_reset(bus.now_s())
            bus.off = True
        return replies

    bus._exchange = cut_after_the_command
    with pytest.raises(AdisGonioError):
        made.autonull()
    bus._exchange = exchange
    bus.power_on()
    again = writer(bus, path)
    assert again.standing().open
    again.undo()
    assert gyro_numbers(bus) == gyro_flash(bus) == OLD
    assert not writer(bus, path).standing().open


def test_an_autonull_needs_a_plan_of_the_gyros(path):
    with pytest.raises(UsageError, match="plan"):
        writer(part(), path).autonull()
    made = writer(part(), path, ACCELEROMETERS)
    made.plan()
    with pytest.raises(UsageError, match="plan of the gyros"):
        made.autonull()


# -- the command -----------------------------------------------------------------------------------------


@pytest.fixture
def bus(monkeypatch):
    """The part behind the URL, which lives on when a command closes its bus."""
    own = part()
    monkeypatch.setattr(own, "_close", lambda: setattr(own, "_closed", False))
    monkeypatch.setattr("adis_gonio.device.sensor.driver.open_bus", lambda url: own)
    return own


QUICK = ["--gyros", "--dwell", "2"]


def test_the_command_shows_the_plan_in_dps_writes_and_undoes(bus, path, capsys):
    assert main(["write", str(path), URL, "--yes", *QUICK]) == 0
    out, err = capsys.readouterr()
    rows = [line.split() for line in out.splitlines()]
    assert rows[1][:3] == ["XGYRO_OFF", "0", "−66"]
    assert "°/s" in out
    assert "mg" not in out
    assert "the write moved the gyros by" in err
    assert gyro_numbers(bus) == wanted(bus)
    assert main(["write", str(path), URL, "--gyros", "--status"]) == 0
    assert "new offsets" in capsys.readouterr().out
    assert main(["write", str(path), URL, "--status"]) == 0
    untouched = capsys.readouterr().out
    assert "XACCL_OFF" in untouched
    assert "XGYRO_OFF" not in untouched
    assert main(["write", str(path), URL, "--gyros", "--undo", "--yes"]) == 0
    assert gyro_numbers(bus) == OLD


def test_the_command_says_what_an_autonull_costs_before_it_asks(bus, path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    monkeypatch.setattr("adis_gonio.faces.cli.board_commands.on_terminal", lambda: True)
    assert main(["write", str(path), URL, *QUICK, "--autonull"]) == 0
    err = capsys.readouterr().err
    assert err.index("ENDURANCE goes up by one") < err.index("Let the chip null")
    assert "nothing was changed" in err
    assert bus.chip.memory["ENDURANCE"] == 0
    assert main(["write", str(path), URL, *QUICK, "--autonull", "--yes", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["autonull"]["agrees"] is True
    assert document["endurance"] == {"before": 0, "after": 1}
    assert document["autonull"]["new"] == dict(zip(GYROS, gyro_numbers(bus), strict=True))


@pytest.mark.parametrize(
    "options",
    [
        ["--autonull"],
        ["--gyros", "--autonull", "--save"],
        ["--gyros", "--autonull", "slow"],
    ],
)
def test_options_that_do_not_go_together_are_wrong_usage(path, options, capsys):
    assert main(["write", str(path), URL, "--yes", *options]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) <= 4
