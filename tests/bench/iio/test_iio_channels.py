"""Units of IIO channels, and what a session takes of a device."""

import numpy as np
import pytest

from adis_gonio.base.errors import CannotOpenError
from adis_gonio.bench.iio_source import IioChannel, choose_channels, parse_number


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


def test_a_channel_without_a_column_is_not_recorded():
    assert (IioChannel("light").column, IioChannel("accel_y").column) == ("", "ay")


def test_three_gyros_are_recorded_with_a_supply_in_volts():
    names = [f"{kind}_{axis}" for kind in ("accel", "anglvel") for axis in "xyz"]
    device = [IioChannel("voltage0_supply", scale=1.8315), *(IioChannel(name) for name in names)]
    chosen = choose_channels(device, "")
    assert [channel.id for channel in chosen] == [*names, "voltage0_supply"]
    assert chosen[-1].values(np.array([2730])) == pytest.approx([5.0], abs=1e-3)


def test_an_attribute_is_a_finite_number_or_its_default():
    assert parse_number(None, "scale", 1.5, "iio:device0") == 1.5
    assert parse_number(" 0.25\n", "scale", 1.0, "iio:device0") == 0.25
    for text in ("much", "nan", "inf", ""):
        with pytest.raises(CannotOpenError, match=f"device0: scale is '{text}', which is no finite number"):
            parse_number(text, "scale", 1.0, "iio:device0")
