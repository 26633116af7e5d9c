"""Opening a bus by URL: `scheme:place?option=value`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from urllib.parse import parse_qsl

from adis_gonio.base import errors
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.device.bus.contract import SpiBus

ENTRY_POINT_GROUP = "adis_gonio.bus"
SOURCE_GROUP = "adis_gonio.source"
"""Entry-point group of sources that deliver samples without SPI frames (see `adis_gonio.record.source`)."""


@dataclass(frozen=True)
class BusUrl:
    """A bus URL split into scheme, place and options.

    Attributes
    ----------
    scheme : str
        Kind of bridge: `sim`, `serial`, …
    place : str
        Device of that kind: a port, a serial number; may be empty.
    options : mapping of str to str
        Options behind the question mark.
    """

    text: str
    scheme: str
    place: str = ""
    options: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> BusUrl:
        """Parse a URL; `UsageError` explains a mistake in it."""
        scheme, colon, rest = text.partition(":")
        if not colon or not scheme:
            raise errors.UsageError(f"'{text}' is no bus URL: write scheme:place, such as sim:?seed=1")
        place, _, query = rest.partition("?")
        try:
            pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
        except ValueError:
            raise errors.UsageError(f"'{text}': options are written ?name=value&name=value") from None
        options: dict[str, str] = {}
        for name, value in pairs:
            if name in options:
                raise errors.UsageError(f"'{text}': option '{name}' is given twice")
            options[name] = value
        return cls(text, scheme.lower(), place, options)


def bus_schemes() -> tuple[str, ...]:
    """Return the URL schemes of all installed buses, from the entry points of group `adis_gonio.bus`."""
    return tuple(sorted({point.name for point in entry_points(group=ENTRY_POINT_GROUP)}))


def open_bus(url: str) -> SpiBus:
    """Open a bus by URL; use it as a context manager.

    Parameters
    ----------
    url : str
        URL of the bus, for instance `sim:?seed=1`. `bus_schemes()` lists the schemes that are installed.

    Raises
    ------
    UsageError
        The URL is malformed, its scheme or an option unknown.
    NotInstalledError
        The bridge needs an extra that is not installed; the message names it.
    CannotOpenError
        The device is missing, busy or not permitted.
    """
    parsed = BusUrl.parse(url)
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == parsed.scheme:
            try:
                opener: Callable[[BusUrl], SpiBus] = point.load()
            except ImportError as error:
                raise errors.NotInstalledError(
                    f"'{url}': the bus '{parsed.scheme}' needs {error.name or error}:"
                    f" {errors.install_extra(parsed.scheme)}"
                ) from error
            return opener(parsed)
    sources = {point.name for point in entry_points(group=SOURCE_GROUP)}
    if parsed.scheme in sources:
        raise errors.UsageError(
            f"'{url}': gives samples, but carries no frames to a chip: stream and calibrate take it"
        )
    hint = errors.suggest(
        f"{parsed.scheme}:", [f"{scheme}:" for scheme in sorted({*bus_schemes(), *sources})]
    )
    raise errors.UsageError(f"'{url}': no bus is called '{parsed.scheme}'; {hint}")


DEVICE_GROUP = "adis_gonio.devices"


class Device(JsonRecord):
    """A device that can be opened as a bus: its URL and a description, each one printable line."""

    url: str
    description: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "url", errors.one_line(self.url))
        object.__setattr__(self, "description", errors.one_line(self.description))


def find_devices() -> list[Device]:
    """List the devices of all installed buses (entry points of group `adis_gonio.devices`).

    A bus without its library is listed with the extra that it needs, and a failed finder function with its
    name, so that a mistake in one package does not hide the devices of the others.
    """
    devices: list[Device] = []
    for point in sorted(entry_points(group=DEVICE_GROUP), key=lambda point: point.name):
        try:
            devices += _found(point)
        except ImportError as error:
            need = f"not usable: {error.name or error} is missing; {errors.install_extra(point.name)}"
            devices.append(Device(f"{point.name}:", need))
        except (errors.BusError, errors.NotInstalledError) as error:
            devices.append(Device(f"{point.name}:", f"not usable: {error}"))
        except Exception as error:  # another package may raise anything
            package = f" of package '{point.dist.name}'" if point.dist is not None else ""
            what = ": ".join([type(error).__name__, *filter(None, [" ".join(str(error).split())])])
            devices.append(Device(f"{point.name}:", f"not usable: {point.value}{package} failed: {what}"))
    return devices


def _found(point: EntryPoint) -> list[Device]:
    finder: Callable[[], list[Device]] = point.load()
    devices = list(finder())
    for device in devices:
        if not isinstance(device, Device):
            raise TypeError(f"it returned {device!r}, which is no adis_gonio.device.bus.Device")
    return devices
