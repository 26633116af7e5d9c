"""The driver: registers, configuration, scans and commands of an ADIS16354 over any bus.

Rules that the driver keeps
    * Only methods that write send frames with the write bit; `stream` may enable data-ready while it runs,
    unless `leave_registers` is set.
    * Every write is read back, and a flash update is proved by the endurance counter.
    * The bus's clock follows SMPL_PRD, and is slow if the mode is not known.
    * After a reset, restore, self-test or flash update nothing is sent until the sensor has recovered.
    * A silent chip, a wrong variant, and a flash update that failed according to STATUS raise errors.

`Undo` restores changed registers and verifies them, also after an error or an interruption. A letter after
DS (data sheet) is the confidence that the figure is valid for this sensor, see `registers.CONFIDENCES`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base import Closing
from adis_gonio.base.budget import current
from adis_gonio.base.errors import (
    AdisGonioError,
    ChipError,
    SilentChipError,
    StatusError,
    UsageError,
    VariantError,
    VerifyError,
)
from adis_gonio.base.numbers import format_duration, use_minus
from adis_gonio.device.bus import Capability, SpiBus, open_bus
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    BY_NAME,
    GYRO_OFF,
    GYRO_OUT,
    IDLE,
    NORMAL,
    REGISTERS,
    VARIANTS,
    Register,
    Variant,
    read_frames,
    register,
    registers,
    timing_for,
    variant,
    write_frames,
)
from adis_gonio.device.sensor.scanning import (
    LONGEST_EXCHANGE_S,
    USED_BY,
    DataReadyLoan,
    PolledScans,
    ScanLayout,
    ScanStream,
    StreamedScans,
)
from adis_gonio.device.sensor.settings import (
    ALARM_SOURCES,
    Alarm,
    Configuration,
    Offsets,
    ScanBlock,
    Status,
    join,
    scales,
    sens_avg_word,
    smpl_prd_for,
)

DEFAULT_SCAN = (*ACCEL_OUT, *GYRO_OUT, "XTEMP_OUT", "SUPPLY_OUT")
"""Registers of a scan by default: accelerometers, gyros, one temperature, supply."""

MARK = 0x2A5A
"""Number written to the level of an unused alarm during a session; a restart of the chip erases it."""

START_UP_S = 0.3
"""Wait in s after power-on and after a reset.

Start-up takes 150 ms typically (DS, B); the data sheet gives no time for a reset.
"""
FLASH_UPDATE_S = 0.15
"""Wait in s after starting a flash update; it takes about 100 ms (DS, A)."""
SELF_TEST_S = 0.06
"""Wait in s after starting the self-test; it takes 35 ms (DS, A)."""
PRECISION_AUTONULL_S = 35.0
"""Wait in s for the precision autonull; it takes about 30 s (DS, B)."""
WAKE_S = 0.005
"""Wait in s for the recovery from sleep; it takes 3 ms (DS, B)."""
FLASH_LIFE = 10_000
"""Number of flash writes that the chip is made for (DS, A)."""

STIMULUS = BY_NAME["MSC_CTRL"].field("positive").mask | BY_NAME["MSC_CTRL"].field("negative").mask
"""Bits of MSC_CTRL of the manual self-test, which shifts the readings."""

MOST_READINGS = 4
"""Largest number of times that `read_checked` reads the registers until two successive readings agree."""

_LEVELS = ("ALM_MAG1", "ALM_MAG2")
_STUCK_WORDS = frozenset({0x0000, 0xFFFF})
"""Replies that show a stuck data line: all zeros or all ones."""

PLAUSIBLE = 0.15
"""Tolerance of the acceleration at rest, relative to 1 g, for a declared variant.

It allows ±2 % of scale and a bias of tens of mg; the next variant differs by a factor of 5.4.
"""
CHECK_SCANS = 32
CHECK_S = 4.0
"""Time in s in which the check reads its `CHECK_SCANS` scans; at a slow sample rate it reads fewer.

A longer wait is reported when it begins.
"""


@dataclass(frozen=True)
class Quantity:
    """Content of a register, as an integer (`number`) and as a value with unit."""

    register: Register
    number: int
    value: float
    unit: str

    def __str__(self) -> str:
        return use_minus(f"{self.value:.6g} {self.unit}" if self.unit else f"{self.number}")


def open_sensor(url: str, *, variant: str = "adis16354", check: bool = True) -> Adis16354:
    """Open the sensor behind a bus URL; use it as a context manager.

    The check reads a few samples and, just after power-on, waits until the filter has settled: 5 minutes at
    the slowest rate with the longest filter. The time limit of `base.budget.within` reports this wait.

    Parameters
    ----------
    url : str
        URL of the bus, such as `sim:?seed=1` (see `open_bus`).
    variant : str
        Sensor type: `adis16354`, `adis16350` or `adis16355`.
    check : bool
        True checks on opening that the chip answers and that the acceleration at rest is 1 g for this
        variant. No other check exists, because the chip has no identification register.

    Raises
    ------
    UsageError, NotInstalledError, CannotOpenError
        The bus cannot be opened, see `open_bus`.
    SilentChipError, VariantError
        The check failed.
    ChipError
        The manual self-test is on, so that the check cannot judge the readings.
    """
    bus = open_bus(url)
    with bus.closed_on_error():
        return Adis16354(bus, variant, check=check)


class Adis16354(Closing):
    """Driver of an ADIS16354 (or ADIS16350/16355) on a bus.

    Parameters
    ----------
    bus : SpiBus
        Bus of the sensor; `close` also closes it.
    variant : str or Variant
        Sensor type, see `registers.VARIANTS`.
    check : bool
        True checks on opening that the chip answers, that its manual self-test is off, and that it measures
        1 g at rest for this variant.
    """

    def __init__(self, bus: SpiBus, variant_: str | Variant = "adis16354", *, check: bool = True) -> None:
        self.bus = bus
        self.variant: Variant = variant(variant_)
        self._gyro_range: int | None = None
        bus.sleep_s(START_UP_S)
        bus.configure(NORMAL)
        found = self._follow()
        if check:
            self._check_variant(found)

    # -- closing ----------------------------------------------------------------------------------

    def close(self) -> None:
        """Close the bus; may be called twice."""
        self.bus.close()

    # -- registers --------------------------------------------------------------------------------

    def read_words(self, names: Sequence[str | Register]) -> list[int]:
        """Read k registers as raw 16-bit words with their flags, in the given order (k + 1 SPI frames)."""
        frames = np.append(read_frames(registers(names)), np.uint16(IDLE))
        return [int(word) for word in self.bus.exchange_array(frames)[1:]]

    def read(self, name: str | Register) -> int:
        """Read a register as an integer: flags and unused bits removed, sign extended."""
        row = register(name)
        return row.number(self.read_words([row])[0])

    def read_all(self) -> dict[str, int]:
        """Read all readable registers; return the integers by register name. The read clears STATUS."""
        rows = [row for row in REGISTERS if row.readable]
        return {row.name: row.number(word) for row, word in zip(rows, self.read_words(rows), strict=True)}

    def quantity(self, name: str | Register) -> Quantity:
        """Read a register as an integer and as a value with unit."""
        row = register(name)
        number = self.read(row)
        lsb, zero, units = scales([row], self.variant, self._gyro_range)
        return Quantity(row, number, float(zero[0] + lsb[0] * number), units[0])

    def write(self, name: str | Register, number: int) -> None:
        """Write an integer to a register and read it back.

        Parameters
        ----------
        number : int
            Integer to write, signed if the register is signed.

        Raises
        ------
        UsageError
            The register is read-only, is COMMAND (use the methods), or cannot hold the number.
        VerifyError
            The register reads back another value.
        """
        row = register(name)
        if not row.readable:
            raise UsageError(f"{row.name} starts actions: use reset(), save_to_flash() and their like")
        if row.name == "SLP_CNT":
            raise UsageError("SLP_CNT puts the part to sleep: use sleep(seconds)")
        if row.name == "SENS_AVG":
            asked = Configuration.from_words(0, number, 0)
            if asked.gyro_range_dps is None:
                raise UsageError(f"SENS_AVG range code {row.field('range').of(number)} is none of 4, 2, 1")
            sens_avg_word(asked.gyro_range_dps, asked.filter_m)
        if row.name == "SMPL_PRD":
            if number & 0xFF == 0:
                raise UsageError("SMPL_PRD 0 is not allowed: 1 is the least (819.2 samples a second)")
            self.bus.configure(NORMAL)  # safe in both modes while the mode changes
        word = row.word(number)
        self.bus.exchange_array(write_frames(row, word))
        back = self.read_words([row])[0]
        if (back ^ word) & row.write_mask:
            raise VerifyError(f"{row.name}: wrote 0x{word:04X}, read back 0x{back & row.data_mask:04X}")
        if row.name in ("SMPL_PRD", "SENS_AVG"):
            self._follow()

    def write_fields(self, name: str | Register, **fields: int) -> None:
        """Change the given bit fields of a register to the given values; its other bits are unchanged.

        Raises `UsageError` if a value does not fit its field.
        """
        row = register(name)
        word = self.read(row) & row.write_mask
        for field_name, value in fields.items():
            field = row.field(field_name)
            if not 0 <= value <= field.mask >> field.low:
                raise UsageError(
                    f"{row.name}.{field_name} takes 0 to {field.mask >> field.low}, not {value}"
                )
            word = word & ~field.mask | value << field.low
        self.write(row, word)

    # -- configuration ----------------------------------------------------------------------------

    def configuration(self) -> Configuration:
        """Read the sample rate, filter, range and compensations that the sensor uses now.

        Raises
        ------
        SilentChipError
            The data line is stuck, so that it gives no values.
        """
        smpl_prd, sens_avg, msc_ctrl = self.read_checked(["SMPL_PRD", "SENS_AVG", "MSC_CTRL"])
        found = Configuration.from_words(smpl_prd, sens_avg, msc_ctrl)
        self._gyro_range = found.gyro_range_dps
        self._msc_ctrl, self._found = msc_ctrl, found
        return found

    def read_checked(self, names: Sequence[str | Register]) -> list[int]:
        """Read registers repeatedly until two successive readings agree; return one raw word for each.

        Each reading also reads SENS_AVG before and after the registers, and SMPL_PRD if all words are zeros
        or ones: SMPL_PRD is neither, so such replies come from a stuck line. SENS_AVG alone may have a
        content that is not allowed. Use this method for registers that a program relies on, such as
        SMPL_PRD and ENDURANCE.

        Raises
        ------
        SilentChipError
            All words are zeros or all are ones, so the data line is stuck.
        VerifyError
            No two successive readings agree.
        """
        guard, period = BY_NAME["SENS_AVG"], BY_NAME["SMPL_PRD"]
        rows = [guard, *registers(names), guard]
        before: list[int] = []
        for _ in range(MOST_READINGS):
            words = self.read_words(rows)
            stuck = words[0] in _STUCK_WORDS and len({*words}) == 1
            if words == before and words[0] == words[-1] and not stuck:
                return words[1 : 1 + len(names)]
            if stuck and period not in rows:
                rows.insert(-1, period)
            before = words
        if stuck:
            level, side = ("ones", "high") if words[0] else ("zeros", "low")
            raise SilentChipError(
                f"{self.bus.url}: nothing answers, replies are {level}: the data line (MISO) is stuck"
                f" {side}; check supply, chip select and wires"
            )
        raise VerifyError(
            f"{self.bus.url}: the registers read differently each time; check supply and wires"
        )

    def endurance(self) -> int:
        """Read ENDURANCE, the count of flash updates (0 to 32767).

        Raises `SilentChipError` or `VerifyError` if the reading is not reliable, see `read_checked`.
        """
        return BY_NAME["ENDURANCE"].number(self.read_checked(["ENDURANCE"])[0])

    def configure(
        self,
        *,
        sample_rate_hz: float | None = None,
        smpl_prd: int | None = None,
        filter_m: int | None = None,
        gyro_range_dps: int | None = None,
        data_ready: bool | None = None,
        linear_g: bool | None = None,
        origin: bool | None = None,
    ) -> Configuration:
        """Change the given settings of the chip and wait until the filter has settled.

        A setting that is None is unchanged. Returns the configuration as read back.

        Parameters
        ----------
        sample_rate_hz : float
            Sample rate, 0.413 to 819.2; the nearest possible rate is taken.
        smpl_prd : int
            Content of SMPL_PRD, as an alternative to the rate.
        filter_m : int
            Filter size M, 0 to 6: two boxcars of 2^M taps.
        gyro_range_dps : int
            Full scale of the gyros: 300, 150 (needs M >= 2) or 75 (needs M >= 4).
        data_ready, linear_g, origin : bool
            Data-ready output (MSC_CTRL[2]), compensation of the gyros for acceleration (MSC_CTRL[7]), and
            compensation of the accelerometers for their positions (MSC_CTRL[6]): True on, False off.

        Raises
        ------
        UsageError
            A value that the sensor does not support, or both rate and `smpl_prd`.
        VerifyError
            A register reads back another value.
        """
        if sample_rate_hz is not None:
            if smpl_prd is not None:
                raise UsageError("give sample_rate_hz or smpl_prd, not both")
            smpl_prd = smpl_prd_for(sample_rate_hz)
        if filter_m is not None or gyro_range_dps is not None:
            now = self.configuration()
            dps = gyro_range_dps if gyro_range_dps is not None else now.gyro_range_dps
            taps = filter_m if filter_m is not None else now.filter_m
            self.write("SENS_AVG", sens_avg_word(dps if dps is not None else 300, taps))
        if smpl_prd is not None:
            self.write("SMPL_PRD", smpl_prd)
        flags = {"data_ready": data_ready, "linear_g": linear_g, "origin": origin}
        if wanted := {name: int(value) for name, value in flags.items() if value is not None}:
            self.write_fields("MSC_CTRL", **wanted)
        return self._settle(self.configuration())

    # -- scans ------------------------------------------------------------------------------------

    def stream(
        self,
        names: Sequence[str | Register] = DEFAULT_SCAN,
        *,
        block_scans: int = 256,
        leave_registers: bool = False,
        data_ready: bool | None = None,
    ) -> ScanStream:
        """Return an iterator of new scans, by the best method of the bus (see `sensor.scanning`).

        A bus with streams makes a scan at each data-ready edge; otherwise scans are polled, and missed
        updates are counted by the event counter of the bus, or by time without one.

        If the bus can use data-ready and the chip's register MSC_CTRL does not enable it, this method
        enables it on pin DIO1 and restores the register when the stream is closed. If no edge arrives, for
        example because the line is not connected, scans are polled.

        Parameters
        ----------
        names : sequence of str or Register
            Registers of a scan, of which at least one is an output register.
        block_scans : int
            Number of scans in a block.
        leave_registers : bool
            True writes no register: data-ready is used only if it is already enabled.
        data_ready : bool or None
            True uses data-ready without a check for edges, which a `DataReadyLoan` has already done. False
            polls. Neither True nor False writes a register. None checks for edges and uses data-ready if
            edges arrive.

        Raises
        ------
        UsageError
            No output register among the names, or no room for a scan in a block.
        BusError
            The bus failed.
        ChipError
            Edges arrive on the data-ready line that are not the chip's updates.
        """
        table = registers(names)
        if not any(row.flags for row in table):
            raise UsageError(
                "a scan needs an output register, such as XACCL_OUT, because only these mark new data"
            )
        if block_scans < 1:
            raise UsageError(f"block_scans is {block_scans}: take 1 or more")
        configuration = self.configuration()
        period_s = configuration.sample_period_s
        usable = bool(USED_BY & self.bus.capabilities)
        looks = data_ready is None and usable and (configuration.data_ready or not leave_registers)
        loan = DataReadyLoan(self, table, period_s, writes=not leave_registers) if looks else None
        ready = bool(data_ready) if loan is None else loan.wired
        with contextlib.ExitStack() as failed:
            at_end = failed.callback(loan.give_back) if loan is not None else (lambda: None)
            layout = ScanLayout(table, self.variant.name, self._gyro_range, period_s, at_end)
            if ready and Capability.STREAM in self.bus.capabilities:
                frames = [int(frame) for frame in read_frames(table)]
                scans = max(1, min(block_scans, int(LONGEST_EXCHANGE_S / period_s)))
                stream: ScanStream = StreamedScans(self.bus.stream(frames, block_scans=scans), layout)
            else:
                counts = ready and Capability.EVENT_COUNTER in self.bus.capabilities
                stream = PolledScans(self.bus, layout, block_scans, counts_edges=counts)
                if looks and not ready:
                    stream.how = f"no data-ready edge arrives: {stream.how}"
            failed.pop_all()
        return stream

    def lend_data_ready(self, names: Sequence[str | Register] = DEFAULT_SCAN) -> DataReadyLoan | None:
        """Enable the chip's data-ready output for streams of the registers `names`.

        Returns a loan, whose method `give_back` restores the old setting, or None if the bus cannot use
        data-ready. Raises the errors of `DataReadyLoan`.
        """
        if not USED_BY & self.bus.capabilities:
            return None
        return DataReadyLoan(self, registers(names), self.configuration().sample_period_s)

    def read_scans(
        self,
        count: int,
        names: Sequence[str | Register] = DEFAULT_SCAN,
        *,
        data_ready: bool | None = None,
        block_scans: int = 256,
    ) -> ScanBlock:
        """Read `count` scans of new data from the named registers, without writing a register.

        `data_ready` is True to use data-ready without a check, False to poll, None to check for edges
        first; `block_scans` is the number of scans that are read at a time.
        """
        if count < 1:
            raise UsageError(f"count is {count}: take 1 or more")
        size = min(count, block_scans)
        with self.stream(names, block_scans=size, leave_registers=True, data_ready=data_ready) as stream:
            return _take(stream, count)

    def scan(self, names: Sequence[str | Register] = DEFAULT_SCAN) -> dict[str, float]:
        """Read one scan of new data, as values by register name in mg, °/s, °C and V."""
        block = self.read_scans(1, names)
        return dict(zip(block.registers, (float(value) for value in block.values()[0]), strict=True))

    # -- health -----------------------------------------------------------------------------------

    def status(self) -> Status:
        """Read STATUS, which clears it; the bit of a lasting condition is set again at the next update."""
        return Status(self.read("STATUS"))

    def self_test(self) -> Status:
        """Run the internal self-test (35 ms, outputs unavailable meanwhile) and read STATUS.

        The test has passed if the attribute `self_test_failures` of the result is empty.

        Raises
        ------
        ChipError
            The self-test did not end, or the chip does not allow the last `configuration` that was read:
            shifted or inverted replies would give a STATUS without failures too.
        SilentChipError, VerifyError
            The reading is not reliable: zeros from a data line that is stuck low are not a passed test.
        """
        if not self._found.allowed:
            raise ChipError(
                f"{self.bus.url}: the self-test cannot be relied on: SMPL_PRD 0x{self._found.smpl_prd:02X},"
                f" gyro range {self._found.gyro_range_dps} and filter M = {self._found.filter_m} are not"
                " allowed by the chip, so that the replies may be wrong; check the link with 'adis-gonio"
                " bringup URL'; if it is good, write SMPL_PRD=1 and SENS_AVG=0x0402"
            )
        row = BY_NAME["MSC_CTRL"]
        busy = row.field("self_test").mask
        # Only the high byte: the low byte has settings that a self-test must not change.
        self.bus.exchange_array(write_frames(row, busy, byte_mask=0xFF00))
        self.bus.sleep_s(SELF_TEST_S)
        if self.read_checked([row])[0] & busy:
            raise ChipError("the self-test did not end in 60 ms: reset the part and check its supply")
        return self.status()

    def refuse_stimulus(self, msc_ctrl: int) -> None:
        """Raise `ChipError` if the manual self-test is on in `msc_ctrl`, the content of MSC_CTRL."""
        if msc_ctrl & STIMULUS:
            raise ChipError(
                f"{self.bus.url}: the manual self-test (MSC_CTRL[9:8]) is on and shifts every reading; end"
                f" it with 'adis-gonio registers URL MSC_CTRL=0x{msc_ctrl & ~STIMULUS:X} --no-check'"
            )

    # -- offsets and flash --------------------------------------------------------------------------

    def offsets(self) -> Offsets:
        """Read the six offset registers, converted to mg and °/s."""
        rows = registers([*GYRO_OFF, *ACCEL_OFF])
        numbers = [row.number(word) for row, word in zip(rows, self.read_words(rows), strict=True)]
        values = (scales(rows, self.variant, self._gyro_range)[0] * numbers).tolist()
        return Offsets((values[0], values[1], values[2]), (values[3], values[4], values[5]))

    def save_to_flash(self) -> int:
        """Save the registers that have a flash copy to flash; return the count of flash updates afterwards.

        Raises
        ------
        ChipError
            The flash is worn (10 000 writes); nothing was written.
        VerifyError
            The endurance counter did not go up by one.
        StatusError
            STATUS reports a failed flash update.
        """
        return self._flash_command("flash_update", FLASH_UPDATE_S)

    def autonull(self) -> Offsets:
        """Let the chip set its gyro offsets so that the present gyro outputs become 0; return the offsets.

        The sensor must be at rest.

        The autonull ends in a flash update, so `ChipError` is raised if the flash is worn (10 000 updates).
        The maker does not give its duration: the method waits until filter and flash update must have
        ended.
        """
        self._flash_command("autonull", self.configuration().settling_s + START_UP_S + FLASH_UPDATE_S)
        return self.offsets()

    def precision_autonull(self) -> Offsets:
        """Let the chip average its gyros for 30 s at rest and cancel their biases; return the new offsets.

        The precision autonull ends in a flash update. It raises `ChipError` if the flash is worn
        (10 000 updates). Only a reset of the chip stops the autonull.
        """
        self._flash_command("precision_autonull", PRECISION_AUTONULL_S)
        return self.offsets()

    def restore_factory(self) -> Offsets:
        """Set the six offset registers to zero by the factory restore; return them as read back.

        The restore ends in a flash update.

        Raises
        ------
        ChipError
            The flash is worn (10 000 updates); nothing was written.
        VerifyError
            An offset is not zero afterwards, or the endurance counter did not go up.
        """
        self._flash_command("restore", START_UP_S)
        left = self.offsets()
        if any((*left.gyro_dps, *left.accel_mg)):
            raise VerifyError(f"after the factory restore offsets are not zero: {left}")
        return left

    def reset(self) -> None:
        """Reset the chip by a command: unsaved settings are lost and the flash copies return."""
        self._command("reset")
        self.bus.configure(NORMAL)
        self.bus.sleep_s(START_UP_S)
        self._follow()

    def forget_mark(self) -> None:
        """Set the level of each alarm to 0 if it contains the number `MARK`.

        A session writes this number to notice a restart of the chip, which erases it; an interrupted
        session may leave it there. Every method that updates the flash first calls this one, because a
        number saved in flash would survive a restart.
        """
        for name, word in zip(_LEVELS, self.read_words(_LEVELS), strict=True):
            if word == MARK:
                self.write(name, 0)

    # -- alarms, output, sleep ----------------------------------------------------------------------

    def set_alarm(self, number: int, alarm: Alarm) -> None:
        """Set alarm 1 or 2 of the chip.

        When the alarm triggers, its bit in the register STATUS and bit 14 (EA) of the output registers are
        set. Source: the data sheet's tables of ALM_*, confidence B.

        Raises
        ------
        UsageError
            The alarm or its source is unknown; a threshold is outside the source's range; or a threshold
            for a change is less than half an LSB a sample.
        """
        if number not in (1, 2):
            raise UsageError(f"alarm {number} does not exist: 1 or 2")
        source = register(alarm.source)
        if source.name not in ALARM_SOURCES:
            raise UsageError(f"{source.name} cannot raise an alarm: {', '.join(ALARM_SOURCES)}")
        if not 0 <= alarm.rate_samples <= 255:
            raise UsageError(f"rate_samples is {alarm.rate_samples}: 0 (level) to 255")
        lsb, zero, unit = scales([source], self.variant, self._gyro_range)
        level = alarm.threshold if alarm.rate_samples else alarm.threshold - zero[0]
        threshold = round(float(level / lsb[0]))
        low, high = source.range
        if not low <= threshold <= high:
            raise UsageError(
                f"threshold {alarm.threshold:g} {unit[0]} is outside the range of {source.name}"
            )
        if alarm.rate_samples and alarm.threshold and not threshold:
            raise UsageError(
                f"threshold {alarm.threshold:g} {unit[0]} a sample is too small for {source.name}:"
                f" the least is {lsb[0]:.4g} {unit[0]} a sample, for any rate_samples"
            )
        self.write(f"ALM_MAG{number}", int(alarm.above) << 15 | threshold & source.data_mask)
        self.write(f"ALM_SMPL{number}", alarm.rate_samples)
        fields = {
            f"source{number}": ALARM_SOURCES[source.name],
            f"rate{number}": int(alarm.rate_samples > 0),
        }
        self.write_fields("ALM_CTRL", filtered=int(alarm.filtered), **fields)

    def clear_alarm(self, number: int) -> None:
        """Switch alarm 1 or 2 off."""
        if number not in (1, 2):
            raise UsageError(f"alarm {number} does not exist: 1 or 2")
        self.write_fields("ALM_CTRL", **{f"source{number}": 0, f"rate{number}": 0})

    def sleep(self, seconds: float) -> None:
        """Put the chip to sleep for 0.5 to 127.5 s; any frame wakes it, so send none meanwhile."""
        if not 0.5 <= seconds <= 127.5:
            raise UsageError(f"the part sleeps 0.5 to 127.5 s, not {seconds:g}")
        # Not read back: the read would wake it.
        self.bus.exchange_array(write_frames(BY_NAME["SLP_CNT"], round(seconds * 2)))

    def wake(self) -> None:
        """Wake the chip by a pulse of chip select and wait until it has recovered."""
        self.bus.exchange_array(np.array([IDLE], np.uint16))
        self.bus.sleep_s(WAKE_S)

    # -- inside -----------------------------------------------------------------------------------

    def _command(self, field: str) -> None:
        row = BY_NAME["COMMAND"]
        self.bus.exchange_array(write_frames(row, row.field(field).mask, byte_mask=0x00FF))

    def _flash_command(self, field: str, wait_s: float) -> int:
        before, what = self.endurance(), f"the {field.replace('_', ' ')}"
        if before >= FLASH_LIFE:
            raise ChipError(f"ENDURANCE is {before}: no update, since the flash lasts {FLASH_LIFE} updates")
        self.forget_mark()
        self._command(field)
        self.bus.sleep_s(wait_s)
        after = self.endurance()
        if after != before + 1:
            raise VerifyError(
                f"{what} was not done: ENDURANCE was {before} and is {after} (expected one more);"
                " check the supply and try again"
            )
        status = self.status()
        if status.flags["flash"]:
            raise StatusError(f"STATUS after {what}: {status}")
        return after

    def _follow(self) -> Configuration:
        """Read the configuration of the chip again, and adapt the SPI timing and the gyro scale to it."""
        found = self.configuration()
        self.bus.configure(timing_for(found.smpl_prd))
        return found

    def _settle(self, found: Configuration) -> Configuration:
        """Wait until the filter of the configuration `found` has settled, and return `found`."""
        _report_wait("waits until the filter has settled", found.settling_s)
        self.bus.sleep_s(found.settling_s)
        return found

    def _check_variant(self, found: Configuration) -> None:
        """Raise `VariantError` if the length of the reading at rest is not 1 g of the declared variant."""
        self.refuse_stimulus(self._msc_ctrl)
        # Polled: a line that is wrong must not keep the sensor from being opened.
        scans = min(CHECK_SCANS, max(3, int(CHECK_S * found.sample_rate_hz)))
        _report_wait(f"reads {scans} samples", scans * found.sample_period_s)
        settled_s = self.bus.now_s() + found.settling_s
        # One stream: the replay of a recording that did not wait here reads on in its scans.
        with self.stream(ACCEL_OUT, block_scans=scans, leave_registers=True, data_ready=False) as stream:
            while True:
                begin_s = self.bus.now_s()
                norms = np.linalg.norm(_take(stream, scans).numbers(), axis=1)
                if norms[-1] <= (1 + PLAUSIBLE) * norms[0] or begin_s >= settled_s:
                    break
                self._settle(found)  # after power-on the filter still fills
        norm_lsb = float(np.median(norms))
        if abs(norm_lsb / self.variant.one_g_lsb - 1) <= PLAUSIBLE:
            return
        if fits := [v.name for v in VARIANTS.values() if abs(norm_lsb / v.one_g_lsb - 1) <= PLAUSIBLE]:
            raise VariantError(
                f"|a| at rest is {norm_lsb:.0f} LSB, so this is an {' or '.join(f.upper() for f in fits)},"
                f" not an {self.variant.name.upper()} ({self.variant.one_g_lsb:.0f}): open it as variant"
                f" '{fits[0]}'"
            )
        raise VariantError(
            f"|a| is {norm_lsb / self.variant.one_g_lsb:.2f} g for an {self.variant.name.upper()}"
            f" ({norm_lsb:.0f} LSB, no known variant): keep the part still while opening, or open it"
            " without the check"
        )


def _report_wait(what: str, seconds: float) -> None:
    """Report a wait of more than `CHECK_S`; the time limit of `base.budget.within` has the callback."""
    if seconds > CHECK_S:
        current().tell(f"{what}, {format_duration(seconds)}")


def _take(stream: ScanStream, count: int) -> ScanBlock:
    """Read blocks from a stream until there are `count` scans, and return these scans."""
    blocks: list[ScanBlock] = []
    have = 0
    while have < count:
        blocks.append(next(stream))
        have += len(blocks[-1])
    return join(blocks).first(count)


_TRIES = 4
"""Number of attempts to restore registers, so that one Ctrl-C or bus failure does not prevent it."""


class Undo:
    """Restores the registers of a sensor after they were changed.

    It records their contents; `put_back` writes changed contents back and verifies them.

    Parameters
    ----------
    sensor : Adis16354
        The open sensor.
    rows : sequence of Register
        Writable registers to record.
    before : mapping of str to int or None
        Words by register name to restore; None records the present words.

    Attributes
    ----------
    before : dict of str to int
        Words to restore, limited to the writable bits.
    unrestored : tuple of str
        Names of the registers that `put_back` could not restore.
    """

    def __init__(
        self, sensor: Adis16354, rows: Sequence[Register], before: Mapping[str, int] | None = None
    ) -> None:
        self._sensor = sensor
        self.rows = tuple(rows)
        kept = self._read() if before is None else before
        self.before = {row.name: kept[row.name] & row.write_mask for row in rows}
        self.unrestored: tuple[str, ...] = ()

    def put_back(self) -> None:
        """Restore all changed registers; `unrestored` gets the names of registers that stay changed.

        Raises
        ------
        KeyboardInterrupt
            The operator pressed Ctrl-C during the restoration. The error is raised when all attempts are
            done.
        """
        interrupted = False
        self.unrestored = tuple(row.name for row in self.rows)
        for _ in range(_TRIES):
            try:
                self.unrestored = tuple(row.name for row in self._restore())
                if not self.unrestored:
                    break
            except KeyboardInterrupt:
                interrupted = True
            except AdisGonioError:
                continue
        if interrupted:
            raise KeyboardInterrupt

    def _restore(self) -> list[Register]:
        """Write back the changed registers once; return the registers that still differ."""
        self._sensor.bus.configure(NORMAL)  # keeps the limits of both modes
        now = self._read()
        for row in self.rows:
            if now[row.name] != self.before[row.name]:
                self._sensor.bus.exchange_array(write_frames(row, self.before[row.name]))
        now = self._read()
        self._sensor._follow()
        return [row for row in self.rows if now[row.name] != self.before[row.name]]

    def _read(self) -> dict[str, int]:
        words = self._sensor.read_words(self.rows)
        return {row.name: word & row.write_mask for row, word in zip(self.rows, words, strict=True)}
