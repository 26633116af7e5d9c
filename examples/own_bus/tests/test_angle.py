"""The goniometer's host code on a part whose errors are known, on a stage that moves."""

import pytest
from tilt_bench.angle import Coefficients, Goniometer, NotLevelError

from adis_gonio.testing import Faults

FLAWED = "sim:?seed=3&delta_k=0.02&delta_phi_deg=0.5&alpha_deg=0&fixture_sigma_deg=0&vibration_mg=0"
ANGLES = (0.0, 45.0, 90.0, 135.0, -60.0)
LIMIT_DEG = 0.1


def errors_deg(sensor, coefficients):
    """Measured angle minus true one: psi = alpha - theta, and alpha is 0 here."""
    goniometer = Goniometer(sensor, coefficients)
    found = []
    for theta in ANGLES:
        sensor.stage.move_to(theta)
        sensor.bus.sleep_s(1.0)
        found.append((goniometer.angle_deg() + theta + 180) % 360 - 180)
    return found


def known(sensor):
    """The coefficients that a perfect calibration would find."""
    truth = sensor.truth()
    # The host code leaves the common gain out: an angle does not depend on it.
    scale = truth["scale_y"]
    assert scale > 0
    return Coefficients(truth["delta_k"], truth["delta_phi"], truth["bias_x"], truth["bias_y"])


@pytest.mark.adis_gonio(url=FLAWED)
def test_with_its_coefficients_the_angle_is_right_all_around(simulated_sensor):
    assert max(map(abs, errors_deg(simulated_sensor, known(simulated_sensor)))) < LIMIT_DEG


@pytest.mark.adis_gonio(url=FLAWED)
def test_without_them_it_is_not(simulated_sensor):
    assert max(map(abs, errors_deg(simulated_sensor, Coefficients()))) > 3 * LIMIT_DEG


@pytest.mark.adis_gonio(url=FLAWED, faults=Faults(seed=7, flip=0.016))
def test_turned_bits_on_the_wire_do_not_move_the_angle(simulated_sensor):
    assert max(map(abs, errors_deg(simulated_sensor, known(simulated_sensor)))) < LIMIT_DEG
    assert simulated_sensor.faulty.faults.seen["flip"] > 10


@pytest.mark.adis_gonio(url=FLAWED)
def test_a_part_whose_axis_stands_upright_has_no_angle(simulated_sensor):
    simulated_sensor.stage.orient((0.1, 0.0, -1.0))
    with pytest.raises(NotLevelError):
        Goniometer(simulated_sensor, known(simulated_sensor)).angle_deg()
