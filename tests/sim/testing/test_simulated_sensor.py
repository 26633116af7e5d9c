"""The fixture `simulated_sensor`: open, reproducible by its seed, on a stage that moves."""

import numpy as np
import pytest

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.sim.testing import Faults, open_simulated

STEADY = "&".join(f"bias_tempco_{axis}_mg_per_c=0&scale_tempco_{axis}_ppm_per_c=0" for axis in "xyz")
QUIET = f"noise_mg=0&bias_instability_mg=0&fixture_sigma_deg=0&{STEADY}"
PERFECT = f"sim:?seed=1&{QUIET}&delta_k=0&scale_y=1&delta_phi_deg=0&alpha_deg=0&bias_x_mg=0&bias_y_mg=0"
HALF_LSB_MG = 0.4672 / 2
"""Half of the data sheet's 0.4672 mg."""


def mean_mg(sensor):
    return sensor.read_scans(64).accel_mg.mean(axis=0)


def test_it_is_open_and_answers(simulated_sensor):
    assert simulated_sensor.read("SMPL_PRD") == 1
    assert not simulated_sensor.bus.closed


@pytest.mark.adis_gonio(url="sim:?seed=3&delta_k=0.0123&variant=adis16355")
def test_the_mark_says_what_is_simulated(simulated_sensor):
    assert simulated_sensor.truth()["delta_k"] == 0.0123
    assert simulated_sensor.variant.name == "adis16355"


@pytest.mark.adis_gonio(url=PERFECT)
@pytest.mark.parametrize("angle_deg", [0, 30, 90, -135])
def test_the_stage_turns_the_part_in_the_plane(simulated_sensor, angle_deg):
    before = simulated_sensor.bus.now_s()
    simulated_sensor.stage.move_to(angle_deg)
    assert simulated_sensor.bus.now_s() > before or angle_deg == 0
    simulated_sensor.bus.sleep_s(20 * 0.3)  # the part rings after a move, with 0.3 s
    gravity = simulated_sensor.world.gravity_mg
    # The convention of docs/design.md with no angle of the zero: x = G cos(-theta), y = G sin(-theta).
    expected = gravity * np.array([np.cos(np.radians(angle_deg)), -np.sin(np.radians(angle_deg))])
    assert mean_mg(simulated_sensor)[:2] == pytest.approx(expected, abs=HALF_LSB_MG + 0.01)


@pytest.mark.adis_gonio(url=PERFECT + "&scale_z=1&skew_xz_deg=0&skew_yz_deg=0&bias_z_mg=0")
@pytest.mark.parametrize("vector", [(0, 0, -1), (1, 0, 0), (1, 1, 1)])
def test_the_stage_turns_the_part_in_space(simulated_sensor, vector):
    simulated_sensor.stage.orient(vector)
    simulated_sensor.bus.sleep_s(20 * 0.3)  # the part rings after a move, with 0.3 s
    expected = simulated_sensor.world.gravity_mg * np.array(vector) / np.linalg.norm(vector)
    assert mean_mg(simulated_sensor) == pytest.approx(expected, abs=HALF_LSB_MG + 0.01)


def test_the_seed_gives_the_same_words_again_and_another_seed_others():
    def words(seed):
        with open_simulated(f"sim:?seed={seed}") as sensor:
            sensor.stage.move_to(45)
            return sensor.read_scans(50).words

    assert (words(5) == words(5)).all()
    assert (words(5) != words(6)).any()


@pytest.mark.adis_gonio(faults=Faults(seed=1, busy=1.0))
def test_faults_begin_when_the_sensor_is_open(simulated_sensor):
    with pytest.raises(AdisGonioError, match="by seed"):
        simulated_sensor.read("SMPL_PRD")
    assert simulated_sensor.faulty.faults.seen["busy"] == 1
    simulated_sensor.faulty.faults = Faults()
    assert simulated_sensor.read("SMPL_PRD") == 1


@pytest.mark.adis_gonio(url="sim:?seed=9")
class TestMarks:
    def test_of_the_class_hold(self, simulated_sensor):
        assert simulated_sensor.world.seed == 9

    @pytest.mark.adis_gonio(url="sim:?seed=10")
    def test_of_the_test_go_before_those_of_the_class(self, simulated_sensor):
        assert simulated_sensor.world.seed == 10


def test_a_calibration_session_runs_on_it(simulated_sensor, tmp_path):
    from adis_gonio import fit, load_session
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.record.plans import plan
    from adis_gonio.record.source import Settings

    path = tmp_path / "s.session"
    runner = SessionRunner.begin(
        simulated_sensor,
        path,
        plan("four-position"),
        Settings(dwell_s=2),
        auto=True,
        fixture_sigma_deg=0.02,
    )
    for _ in runner.run(so_far=False):
        pass
    found = fit(load_session(path)).as_dict()["parameters"]["delta_k"]
    assert abs(found["value"] - simulated_sensor.truth()["delta_k"]) < 5 * found["u"]
