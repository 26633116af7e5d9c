"""Sources of samples for a session (the chip behind its driver, or any other sensor) and their settings.

Settings are the dwell length, settling, and the sensor's configuration. A session knows its sensor only as
a `SampleSource`. `ChipSource` is the source for the driver; a package adds other sources by an entry point
in the group `adis_gonio.source`: scheme = "module:opener".
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Protocol, TypeVar

from adis_gonio.base import Closing
from adis_gonio.base.errors import ChipError, SessionError, UsageError
from adis_gonio.base.jsonable import OPTIONAL, JsonRecord
from adis_gonio.device.bus.opening import SOURCE_GROUP, BusUrl
from adis_gonio.device.sensor import settings as chip_settings
from adis_gonio.device.sensor.driver import DEFAULT_SCAN, MARK, STIMULUS, Adis16354, open_sensor
from adis_gonio.device.sensor.registers import ACCEL_OUT, BY_NAME, READING_BITS, REGISTERS
from adis_gonio.device.sensor.scanning import MASK as DATA_READY_BITS, DataReadyLoan
from adis_gonio.record.blocks import Block

LEAST_SAMPLES = 16
"""Least number of samples in a dwell, so that its noise can be estimated."""

TURN_S = 10.0
"""Estimated duration in s of a turn by hand, until the first turn has been timed."""


def require_samples(dwell_s: float, period_s: float) -> None:
    """Raise `UsageError` if a dwell has fewer than `LEAST_SAMPLES` samples with this period, both in s."""
    if dwell_s < LEAST_SAMPLES * period_s:
        raise UsageError(
            f"dwell_s is {dwell_s:g}: at {1 / period_s:.4g} samples a second"
            f" take {LEAST_SAMPLES * period_s:.3g} s or more"
        )


def expected_each_s(settle_s: float, dwell_s: float) -> float:
    """Return the expected duration of one position in s: turning by hand, settling and dwell."""
    return TURN_S + settle_s + dwell_s


class Settings(JsonRecord):
    """Settings of a session, stored in its archive and used again when the session is resumed.

    Attributes
    ----------
    dwell_s : float
        Length of a dwell in s.
    settle_s : float
        Wait between stillness and the dwell in s, at least the filter's settling time.
    still_timeout_s : float
        Time to wait for stillness in s before the operator is asked; without an operator the session ends.
    smpl_prd : int
        Number in the register SMPL_PRD; 1 is the fastest, 819.2 samples a second.
    filter_m : int
        Exponent M of the Bartlett filter's length, 0 to 6.
    gyro_range_dps : int
        Range of the gyros in °/s: 300, 150 or 75.
    data_ready : bool or None
        Use of data-ready pulses: None uses them if the bus supports it and the line is wired, True requires
        them, False polls.
    registers : tuple of str
        Registers of a scan; the three accelerometer outputs are required.
    turns : bool
        True to archive also the scans of the last minutes before each dwell, in which the sensor turned.

    Raises
    ------
    UsageError
        The sensor does not support a value, or the dwell is too short for its rate.
    """

    dwell_s: float = 10.0
    settle_s: float = 0.5
    still_timeout_s: float = 60.0
    smpl_prd: int = 1
    filter_m: int = 2
    gyro_range_dps: int = 300
    data_ready: bool | None = None
    registers: tuple[str, ...] = DEFAULT_SCAN
    turns: bool = field(default=False, metadata=OPTIONAL)

    def __post_init__(self) -> None:
        for name in ("dwell_s", "still_timeout_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name} is {value}: take a time above 0 s")
        if not (math.isfinite(self.settle_s) and self.settle_s >= 0):
            raise UsageError(f"settle_s is {self.settle_s}: take 0 s or more")
        missing = [name for name in ACCEL_OUT if name not in self.registers]
        chip_settings.sens_avg_word(self.gyro_range_dps, self.filter_m)
        if not 1 <= self.smpl_prd <= 0xFF:
            raise UsageError(f"smpl_prd is {self.smpl_prd}: take 1 (819.2 samples a second) to 255")
        require_samples(self.dwell_s, chip_settings.sample_period_s(self.smpl_prd))
        if missing:
            raise UsageError(f"a session needs {', '.join(ACCEL_OUT)}; the scan lacks {', '.join(missing)}")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Settings:
        """Create settings from their JSON form; missing settings have their defaults.

        Raises
        ------
        UsageError
            A value is not supported, or a setting is unknown to this program.
        """
        unknown = sorted(data.keys() - cls.__dataclass_fields__.keys())
        if unknown:
            raise UsageError(
                f"the session has a setting {unknown[0]!r:.40}: update adis-gonio to resume it"
            )
        return cls(**{**data, "registers": tuple(data.get("registers", DEFAULT_SCAN))})


T = TypeVar("T")


class Measuring(Protocol):
    """Interface of a sensor's configuration: the sample rate and settling time that a session needs."""

    @property
    def sample_rate_hz(self) -> float:
        """Number of samples a second."""

    @property
    def sample_period_s(self) -> float:
        """Time between two samples in s."""

    @property
    def settling_s(self) -> float:
        """Settling time of the sensor's filter in s; 0 if no filter is known."""

    def as_dict(self) -> dict[str, Any]:
        """Return the configuration in JSON form, as the archive stores it."""


class SampleStream(Iterator[Block], AbstractContextManager[Any], Protocol):
    """Iterator of blocks of samples, until it is closed; it raises `BusError` if the sensor fails.

    Attributes
    ----------
    how : str
        Way in which the samples are read (polled or by data-ready), as text.
    """

    how: str

    @property
    def caveat(self) -> str:
        """A known limitation of these samples, as text for the user; empty if there is none."""

    def close(self) -> None:
        """Stop the stream and undo the changes made for it; may be called twice."""


@dataclass(frozen=True)
class KnownPart:
    """Properties of a sensor that are known before it is measured.

    Attributes
    ----------
    name : str
        Variant of the sensor as the archive stores it: a chip of the family, or `generic`.
    initial_bias_mg : float
        Typical bias of an axis in mg.
    step_mg : float
        Step of the converter in mg; 0 if it is not known.
    """

    name: str
    initial_bias_mg: float
    step_mg: float


class SampleSource(Closing):
    """Base class of the sensors that a session can use; a context manager.

    Its methods raise only errors of `adis_gonio.base.errors`. The methods about registers have defaults for
    a sensor without registers.

    Attributes
    ----------
    url : str
        URL by which the sensor was opened.
    part : KnownPart
        Properties of the sensor that are known before it is measured.
    stage, world : object or None
        Stage that moves the sensor (see `session_bench.MovableStage`), and simulated world; None without
        them.
    kept : tuple of str
        Names of the fields of `Settings` that apply to the sensor; the archive keeps these.
    why_polled : str
        Reason why samples are polled instead of started by data-ready; empty if they are not polled. Known
        after `configure`.
    """

    url: str
    part: KnownPart
    stage: Any = None
    world: Any = None
    kept: tuple[str, ...]
    why_polled: str = ""

    @abstractmethod
    def now_s(self) -> float:
        """Return the present time in s on the sensor's monotonic clock, which also times the samples."""

    @abstractmethod
    def sleep_s(self, seconds: float) -> None:
        """Wait for `seconds` on the sensor's clock, which may be virtual."""

    @abstractmethod
    def configure(self, settings: Settings) -> Measuring:
        """Apply those settings that the sensor has, and return its configuration.

        The data-ready line is reserved until `give_back`.
        """

    def witness(self, name: str, observe: Callable[[], T]) -> T:
        """Return `observe()`, a JSON value from outside the sensor, such as an answer of the operator.

        A source whose calls are recorded in a file stores the value by `name`; a replay returns the stored
        value.
        """
        return observe()

    def give_back(self) -> None:
        """Undo the temporary changes that `configure` and `mark_restart` made; may be called twice."""

    def mark_restart(self) -> None:
        """Write a number to an unused register, if any, that a restart of the sensor would erase."""

    def settings_held(self, *, checked: bool = False) -> dict[str, int]:
        """Return the contents of registers that shift or scale a sample, and the mark of `mark_restart`.

        The contents are numbers by register name; empty if the sensor has no registers. With `checked`
        raise `ChipError` if the replies cannot be the sensor's.
        """
        return {}

    def registers(self) -> dict[str, int]:
        """Return the contents of all readable registers by name; empty if the sensor has no registers."""
        return {}

    @abstractmethod
    def identity(self, registers: Mapping[str, Any], measuring: Mapping[str, Any]) -> dict[str, Any]:
        """Return facts about the sensor that must be unchanged when a session is resumed.

        `registers` has the contents of its registers by name, `measuring` its configuration in JSON form.
        """

    @abstractmethod
    def expected_noise_mg(self, measuring: Measuring) -> float:
        """Return an estimate of a sample's noise at rest in mg; ten times as much counts as motion."""

    @abstractmethod
    def samples(self, settings: Settings, block_samples: int) -> SampleStream:
        """Start a stream of blocks of `block_samples` samples, after `configure` with these settings."""

    def status(self) -> chip_settings.Status | None:
        """Read and clear the errors and alarms that the sensor reports; None if it cannot report any."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Close the sensor; may be called twice."""


HOLDING_SETTINGS = tuple(
    row.name
    for row in REGISTERS
    if row.readable and row.writable and row.name not in ("GPIO_CTRL", "SLP_CNT")
)
"""Names of the control registers that must be unchanged when a session is resumed.

GPIO_CTRL and SLP_CNT are left out, because they contain levels of lines and a counter, not settings.
"""


class ChipSource(SampleSource):
    """Source of samples from a chip of the ADIS16354's family, by its driver.

    Attributes
    ----------
    sensor : Adis16354
        The driver.
    """

    kept = tuple(Settings.__dataclass_fields__)

    def __init__(self, sensor: Adis16354) -> None:
        self.sensor = sensor
        self.url = sensor.bus.url
        variant = sensor.variant
        self.part = KnownPart(variant.name, variant.performance.initial_bias_mg, variant.accel_mg_per_lsb)
        self.stage = getattr(sensor.bus, "stage", None)
        self.world = getattr(sensor.bus, "world", None)
        self._loan: DataReadyLoan | None = None
        self._marked: tuple[str, int] | None = None

    def now_s(self) -> float:
        """Return the present time in s on the bus's clock."""
        return self.sensor.bus.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait for `seconds` on the bus's clock."""
        self.sensor.bus.sleep_s(seconds)

    def witness(self, name: str, observe: Callable[[], T]) -> T:
        """Return `observe()` by way of the bus, which may record the value, or replay it, by `name`."""
        return self.sensor.bus.witness(name, observe)

    def configure(self, settings: Settings) -> chip_settings.Configuration:
        """Configure the chip, and enable data-ready if it is wired and the settings do not forbid it.

        Raises
        ------
        SessionError
            The settings require data-ready, and it cannot be used.
        ChipError
            The manual self-test is on, or the chip has lost its settings.
        """
        self.sensor.forget_mark()  # a killed session may have left it in an alarm level
        asked = (settings.smpl_prd, settings.filter_m, settings.gyro_range_dps)
        self.sensor.configure(smpl_prd=asked[0], filter_m=asked[1], gyro_range_dps=asked[2])
        self._borrow_data_ready(settings)
        self.refuse_self_test()
        now = self.sensor.configuration()
        if (now.smpl_prd, now.filter_m, now.gyro_range_dps) != asked:
            self.give_back()
            raise ChipError(
                f"{self.url}: SMPL_PRD or SENS_AVG changed while the session began: the sensor restarted,"
                " or somebody wrote to it; check the supply and go on with --resume"
            )
        return now

    def refuse_self_test(self) -> None:
        """Raise `ChipError` if the manual self-test is on, because its stimulus shifts all readings."""
        control = BY_NAME["MSC_CTRL"]
        word = self.sensor.read(control)
        if word & STIMULUS and not word & ~control.write_mask:  # other bits mean a dead line
            self.give_back()
            self.sensor.refuse_stimulus(self.sensor.read(control))

    def _borrow_data_ready(self, settings: Settings) -> None:
        self.give_back()
        self.why_polled = ""
        if settings.data_ready is False:
            self.why_polled = "data-ready is switched off for this session"
            return
        loan = self.sensor.lend_data_ready(settings.registers)
        if loan is None:
            self.why_polled = "this bus cannot use data-ready"
        elif not loan.wired:
            self.why_polled = "no data-ready edge arrives: is DIO1 wired to the bridge?"
        else:
            self._loan = loan
        if self.why_polled and settings.data_ready:
            raise SessionError(f"{self.url}: {self.why_polled} (the session asks for it)")

    def give_back(self) -> None:
        """Restore the data-ready bits and the alarm level used as a mark; may be called twice."""
        try:
            if self._loan is not None:
                self._loan.give_back()
                self._loan = None
        finally:
            if self._marked is not None and self.sensor.read(self._marked[0]) == MARK:
                self.sensor.write(*self._marked)
            self._marked = None

    def mark_restart(self) -> None:
        """Write the number `MARK` to the level of an unused alarm; a restart of the chip erases it.

        ALM_MAG1 and ALM_MAG2 have no effect while their source in ALM_CTRL is 0 (data sheet, B). If both
        alarms are in use, nothing is marked, and a restart shows only in registers that differ from their
        flash copies: offsets and rate may be equal before and after a restart.
        """
        control = BY_NAME["ALM_CTRL"]
        word = self.sensor.read_words([control])[0]
        for number in (2, 1):
            if not word & control.field(f"source{number}").mask:
                name = f"ALM_MAG{number}"
                self._marked = (name, self.sensor.read(name))
                self.sensor.write(name, MARK)
                return

    def settings_held(self, *, checked: bool = False) -> dict[str, int]:
        """Return the contents of registers that shift or scale a sample, and of the marked alarm level.

        The contents are numbers by register name; of each register only the bits that change a sample
        (`READING_BITS`) are included. If both alarms are in use, so that no level is marked, ALM_CTRL is
        included instead: a restart ends alarms set in RAM. With `checked` raise `ChipError` if the replies
        cannot be the sensor's.
        """
        names = [*READING_BITS, self._marked[0] if self._marked else "ALM_CTRL"]
        words = self.sensor.read_checked(names) if checked else self.sensor.read_words(names)
        numbers = {name: BY_NAME[name].number(word) for name, word in zip(names, words, strict=True)}
        return {name: number & READING_BITS.get(name, -1) for name, number in numbers.items()}

    def registers(self) -> dict[str, int]:
        """Return the contents of all readable registers by name."""
        return self.sensor.read_all()

    def identity(self, registers: Mapping[str, Any], measuring: Mapping[str, Any]) -> dict[str, Any]:
        """Return the contents of the control registers by name, without the data-ready bits.

        Data-ready depends on the wiring, which may change. `registers` has the contents of all registers by
        name.
        """
        held = {name: registers.get(name) for name in HOLDING_SETTINGS}
        if held["MSC_CTRL"] is not None:
            held["MSC_CTRL"] &= ~DATA_READY_BITS
        return held

    def expected_noise_mg(self, measuring: Measuring) -> float:
        """Return the noise of a sample in mg by the data of the variant, behind the present filter."""
        filter_m = measuring.filter_m if isinstance(measuring, chip_settings.Configuration) else 0
        return self.sensor.variant.performance.noise_mg * chip_settings.white_noise_gain(filter_m)

    def samples(self, settings: Settings, block_samples: int) -> SampleStream:
        """Start a stream of blocks of `block_samples` scans of the registers that the settings name."""
        # The session has set the registers, and the archive has recorded them: the stream leaves them.
        return self.sensor.stream(
            settings.registers,
            block_scans=block_samples,
            leave_registers=True,
            data_ready=self._loan is not None,
        )

    def status(self) -> chip_settings.Status:
        """Return the content of STATUS; reading it clears its bits."""
        return self.sensor.status()

    def close(self) -> None:
        """Close the driver and its bus."""
        self.sensor.close()


def has_frames(url: str) -> bool:
    """Return True if the URL names an SPI bus with a chip, False for another source of samples."""
    return BusUrl.parse(url).scheme not in {point.name for point in entry_points(group=SOURCE_GROUP)}


def open_source(url: str, *, variant: str = "adis16354", check: bool = True) -> SampleSource:
    """Open a source of samples by its URL: a bus with the chip, or another sensor (`iio:`).

    Parameters
    ----------
    variant : str
        Variant of the chip; another sensor ignores it.
    check : bool
        True to check that the chip replies, as `open_sensor` does; another sensor ignores it.

    Raises
    ------
    UsageError, CannotOpenError
        The URL is wrong, or its device cannot be opened.
    """
    parsed = BusUrl.parse(url)
    for point in entry_points(group=SOURCE_GROUP):
        if point.name == parsed.scheme:
            source: SampleSource = point.load()(parsed)
            return source
    return ChipSource(open_sensor(url, variant=variant, check=check))


def refuse_chip_options(url: str, given: Mapping[str, object]) -> None:
    """Raise `UsageError` if options that only the chip has are given for another sensor.

    `given` has the values of these options by name; an empty value counts as not given.
    """
    names = [name for name, value in given.items() if value]
    if names and not has_frames(url):
        raise UsageError(f"{', '.join(names)}: for the ADIS16354 only; set up {url} by its own means")
