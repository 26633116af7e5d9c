"""Every row of the register table is walked: a row that is wrong or incomplete fails by its name."""

import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import (
    BY_NAME,
    GYRO_LSB_DPS,
    LEAST_M,
    RANGE_CODE,
    REGISTERS,
    VARIANTS,
    Kind,
    Register,
    changed_settings,
    register,
    variant,
)

# Typed in from the data sheet's tables, independently of the table under test:
# name: (address, bits, signed, access, default, in flash)
DATA_SHEET = {
    "ENDURANCE": (0x00, 16, False, "r", 0, False),
    "SUPPLY_OUT": (0x02, 12, False, "r", 0, False),
    "XGYRO_OUT": (0x04, 14, True, "r", 0, False),
    "YGYRO_OUT": (0x06, 14, True, "r", 0, False),
    "ZGYRO_OUT": (0x08, 14, True, "r", 0, False),
    "XACCL_OUT": (0x0A, 14, True, "r", 0, False),
    "YACCL_OUT": (0x0C, 14, True, "r", 0, False),
    "ZACCL_OUT": (0x0E, 14, True, "r", 0, False),
    "XTEMP_OUT": (0x10, 12, True, "r", 0, False),
    "YTEMP_OUT": (0x12, 12, True, "r", 0, False),
    "ZTEMP_OUT": (0x14, 12, True, "r", 0, False),
    "AUX_ADC": (0x16, 12, False, "r", 0, False),
    "XGYRO_OFF": (0x1A, 13, True, "rw", 0, True),
    "YGYRO_OFF": (0x1C, 13, True, "rw", 0, True),
    "ZGYRO_OFF": (0x1E, 13, True, "rw", 0, True),
    "XACCL_OFF": (0x20, 12, True, "rw", 0, True),
    "YACCL_OFF": (0x22, 12, True, "rw", 0, True),
    "ZACCL_OFF": (0x24, 12, True, "rw", 0, True),
    "ALM_MAG1": (0x26, 16, False, "rw", 0, True),
    "ALM_MAG2": (0x28, 16, False, "rw", 0, True),
    "ALM_SMPL1": (0x2A, 16, False, "rw", 0, True),
    "ALM_SMPL2": (0x2C, 16, False, "rw", 0, True),
    "ALM_CTRL": (0x2E, 16, False, "rw", 0, True),
    "AUX_DAC": (0x30, 12, False, "rw", 0, False),
    "GPIO_CTRL": (0x32, 16, False, "rw", 0, False),
    "MSC_CTRL": (0x34, 16, False, "rw", 0, True),
    "SMPL_PRD": (0x36, 16, False, "rw", 0x0001, True),
    "SENS_AVG": (0x38, 16, False, "rw", 0x0402, True),
    "SLP_CNT": (0x3A, 16, False, "rw", 0, False),
    "STATUS": (0x3C, 16, False, "r", 0, False),
    "COMMAND": (0x3E, 16, False, "w", 0, False),
}

# name: bits that a write changes, bits with a copy in flash
MASKS = {
    **dict.fromkeys(("XGYRO_OFF", "YGYRO_OFF", "ZGYRO_OFF"), (0x1FFF, 0x1FFF)),
    **dict.fromkeys(("XACCL_OFF", "YACCL_OFF", "ZACCL_OFF"), (0x0FFF, 0x0FFF)),
    **dict.fromkeys(("ALM_MAG1", "ALM_MAG2"), (0xBFFF, 0xBFFF)),
    **dict.fromkeys(("ALM_SMPL1", "ALM_SMPL2"), (0x00FF, 0x00FF)),
    "ALM_CTRL": (0xFFD7, 0xFFD7),
    "AUX_DAC": (0x0FFF, 0),
    "GPIO_CTRL": (0x0303, 0),
    "MSC_CTRL": (0x07C7, 0x00C7),  # a self-test is not kept
    "SMPL_PRD": (0x00FF, 0x00FF),
    "SENS_AVG": (0x0707, 0x0707),
    "SLP_CNT": (0x00FF, 0),
    "COMMAND": (0x009F, 0),
}

# Typical values of the data sheet's table of specifications. Accelerometers: mg/LSB, range in g, noise,
# in-run stability and initial bias in mg, error of the sensitivity, alignment in degrees, mg/°C, ppm/°C.
ACCELEROMETERS = {
    "adis16350": (2.522, 10, 35, 0.7, 40, 0.01, 0.25, 4, 100),
    "adis16355": (2.522, 10, 35, 0.7, 40, 0.01, 0.25, 0.5, 40),
}
# Gyros: noise in °/s, °/s/g, °/s/V, in-run stability in °/s.
GYROS = (0.6, 0.05, 0.25, 0.015)

each_register = pytest.mark.parametrize("row", REGISTERS, ids=lambda row: row.name)


def test_the_table_holds_the_registers_of_the_data_sheet_and_no_other():
    assert list(BY_NAME) == list(DATA_SHEET)


@each_register
def test_a_row_agrees_with_the_data_sheet(row: Register):
    address, bits, signed, access, default, in_flash = DATA_SHEET[row.name]
    assert (row.address, row.bits, row.signed) == (address, bits, signed)
    assert (row.access, row.default, bool(row.flash_mask)) == (access, default, in_flash)


@each_register
def test_a_write_changes_the_bits_of_the_data_sheet_and_no_other(row: Register):
    assert (row.write_mask, row.flash_mask) == MASKS.get(row.name, (0, 0))


@pytest.mark.parametrize("name", ACCELEROMETERS)
def test_a_variant_has_the_specifications_of_its_data_sheet(name: str):
    part = variant(name)
    p = part.performance
    assert ACCELEROMETERS[name] == (
        part.accel_mg_per_lsb, part.accel_range_g, p.noise_mg, p.bias_instability_mg, p.initial_bias_mg,
        p.scale_error_typical, p.non_orthogonality_deg, p.bias_tempco_mg_per_c, p.scale_tempco_ppm_per_c,
    )  # fmt: skip
    assert p.noise == pytest.approx([35, 35, 35, 0.6, 0.6, 0.6])
    assert p.floor == pytest.approx([0.7, 0.7, 0.7, 0.015, 0.015, 0.015])
    own = (p.gyro_g_sensitivity_dps_per_g, p.gyro_supply_sensitivity_dps_per_v)
    assert (p.gyro_noise_dps, *own, p.gyro_instability_dps) == GYROS
    # Uniform within ± 0.25°.
    assert p.skew_u_rad == pytest.approx(0.0025192, rel=1e-4)


@pytest.mark.parametrize(
    ("range_dps", "code", "least_m"), [(300, 0b100, 0), (150, 0b010, 2), (75, 0b001, 4)]
)
def test_a_gyro_range_has_its_code_its_least_filter_and_4095_steps(range_dps, code, least_m):
    assert RANGE_CODE[range_dps] == code
    assert LEAST_M[range_dps] == least_m
    scale, zero, unit = variant("adis16354").lsb(Kind.GYRO, range_dps)
    assert scale == GYRO_LSB_DPS[range_dps] == pytest.approx(range_dps / 4095, abs=5e-6)
    assert (zero, unit) == (0.0, "°/s")


def test_settings_have_changed_if_a_bit_that_moves_a_reading_has():
    then = {"SMPL_PRD": 0x01, "SENS_AVG": 0x0402, "MSC_CTRL": 0x00C0, "XACCL_OFF": 0, "YGYRO_OFF": 7}
    same = {**then, "MSC_CTRL": 0x00C7, "SENS_AVG": 0x8402, "ALM_CTRL": 0x1234, "ZACCL_OFF": 5}
    assert changed_settings(then, same) == {}
    now = {"SMPL_PRD": 0x81, "SENS_AVG": 0x0404, "MSC_CTRL": 0x0240, "XACCL_OFF": 0xFFF, "YGYRO_OFF": 7}
    assert changed_settings(then, now) == {
        "SMPL_PRD": (0x01, 0x81),
        "SENS_AVG": (0x0402, 0x0404),
        "MSC_CTRL": (0x00C0, 0x0240),
        "XACCL_OFF": (0, 0xFFF),
    }


@each_register
def test_a_row_says_meaning_source_and_confidence(row: Register):
    assert row.meaning
    assert row.source
    assert row.confidence in "ABCD"


@each_register
def test_fields_do_not_overlap_and_lie_inside_the_register(row: Register):
    seen = 0
    for field in row.fields:
        assert field.low <= field.high <= 15
        assert not field.mask & seen
        assert field.meaning
        seen |= field.mask
    if row.writable and row.fields:
        assert seen == row.write_mask


@each_register
def test_every_number_of_the_range_survives_the_round_trip(row: Register):
    low, high = row.range
    for number in {low, low + 1, -1 if row.signed else 1, 0, 1, high - 1, high}:
        assert row.number(row.word(number)) == number
        # flags and unused bits, whatever they hold, are not part of the number
        assert row.number(row.word(number) | (0xFFFF & ~row.data_mask)) == number
    with pytest.raises(UsageError, match=row.name):
        row.word(high + 1)


@each_register
@pytest.mark.parametrize("part", VARIANTS.values(), ids=lambda part: part.name)
def test_every_register_has_a_scale_and_a_unit_in_every_variant(row: Register, part):
    lsb, zero, unit = part.lsb(row.kind)
    assert lsb > 0
    assert bool(unit) == (row.kind not in (Kind.COUNT, Kind.FIELDS))
    assert zero == (25.0 if row.kind is Kind.TEMPERATURE else 0.0)


def test_only_the_data_sheets_one_g_words_come_out():
    accel = BY_NAME["XACCL_OUT"]
    part = variant("adis16354")
    assert accel.number(0x085C) * part.accel_mg_per_lsb == pytest.approx(1000, abs=0.25)
    assert accel.number(0x37A4) * part.accel_mg_per_lsb == pytest.approx(-1000, abs=0.25)
    assert round(variant("adis16350").one_g_lsb) == 397


def test_gyro_offsets_have_13_bits_and_accelerometer_offsets_12():
    assert BY_NAME["XGYRO_OFF"].number(0x1000) == -4096
    assert BY_NAME["XGYRO_OFF"].number(0x0FFF) == 4095
    assert BY_NAME["XACCL_OFF"].number(0x0800) == -2048
    assert BY_NAME["XACCL_OFF"].number(0x07FF) == 2047


def test_names_are_found_in_either_case_and_an_unknown_one_names_the_nearest():
    assert register("sens/avg") is BY_NAME["SENS_AVG"]
    assert register("xaccl_out") is BY_NAME["XACCL_OUT"]
    with pytest.raises(UsageError, match="XACCL_OFF"):
        register("XACCL_OF")


def test_an_unknown_variant_lists_the_known_ones():
    assert variant("16355").name == "adis16355"
    with pytest.raises(UsageError, match="adis16350"):
        variant("adis16448")
