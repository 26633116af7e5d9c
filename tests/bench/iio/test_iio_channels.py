"""Units of IIO channels, and what a session takes of a device."""

import numpy as np
import pytest

from adis_gonio.base.errors import CannotOpenError
from adis_gonio.bench.iio_source import IioChannel, choose_channels


def test_units_are_those_of_a_session():
    x = IioChannel("accel_x", scale=0.0098, offset=10)
    assert x.values(np.array([90])) == pytest.approx([100 * 0.0098 / 9.80665 * 1000])
    assert IioChannel("anglvel_z", scale=np.pi / 180).values(np.array([3])) == pytest.approx([3])
    assert IioChannel("temp", scale=100, offset=20).values(np.array([230])) == pytest.approx([25])


def test_a_session_takes_three_axes_and_one_column_of_each_kind():
    accel = [IioChannel(f"accel_{axis}") for axis in "xyz"]
    names = [
        c.id
        for c in choose_channels(
            [*accel, IioChannel("temp_x"), IioChannel("temp0"), IioChannel("light")], ""
        )
    ]
    assert names == ["accel_x", "accel_y", "accel_z", "temp0"]
    assert [c.id for c in choose_channels([*accel, IioChannel("anglvel_x")], "")] == names[
        :3
    ]  # one gyro is no use
    with pytest.raises(CannotOpenError, match=r"accel_y, accel_z missing"):
        choose_channels(accel[:1], "iio:device0")
