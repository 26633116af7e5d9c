"""The tree of errors, ordered by the person who has to act.

Every message is one line: it names the file, row, register, option or port, and the action to take.
`exit_code` is the exit status of the command line: 1 if the job failed, 2 if the call was wrong.

=====================  ================================================================
error                  who acts
=====================  ================================================================
`UsageError`           the caller: an option, a URL, an argument
`DataError`            the author of the file
`NotInstalledError`    the administrator: an extra of the package is missing
`CannotOpenError`      the administrator: permissions, cables, a busy device
`ProtocolError`        the bridge: corrupted or short answers
`BusTimeoutError`      the bridge or the cable: no answer
`BusClosedError`       the caller: use after close
`CapabilityError`      the caller: this bus cannot do that
`ChipError` and below  the sensor, its wiring or its supply
`FitError` and below   the planner of the session: the data do not determine the result
`SessionError`         the operator or the archive
`OutputError`          the owner of the disk: a file cannot be written
`FleetError`           the operator of the machine or cluster: no worker, no scheduler
=====================  ================================================================
"""

from __future__ import annotations


def one_line(text: str) -> str:
    """Return the words of a text with one space between them and `?` for each unprintable letter.

    Text of a file or a device must not control a terminal. Undecodable bytes of a file name are kept.
    """
    words = " ".join(text.split())
    return "".join(c if c.isprintable() or "\udc80" <= c <= "\udcff" else "?" for c in words)


class AdisGonioError(Exception):
    """Base of every error that this package raises on purpose; its text is one printable line."""

    exit_code = 1

    def __str__(self) -> str:
        return one_line(super().__str__())


class UsageError(AdisGonioError, ValueError):
    """The call was wrong: an option, an argument, a URL."""

    exit_code = 2


class DataError(AdisGonioError, ValueError):
    """A file's content cannot be used; the message names the file and the row."""


class NotInstalledError(AdisGonioError):
    """A library of an extra is missing; the message names the extra to install."""


class BusError(AdisGonioError):
    """Base class of failures between the host and the chip's pins."""


class CannotOpenError(BusError):
    """The device is not there, is busy, or permission is missing."""


class ProtocolError(BusError):
    """The answer of the bridge violates its protocol."""


class BusTimeoutError(BusError, TimeoutError):
    """The bridge did not answer in its time."""


class BusClosedError(BusError):
    """The bus was used after it had been closed."""


class CapabilityError(BusError):
    """The bus lacks the requested capability."""


class ChipError(AdisGonioError):
    """Base class of errors of the sensor itself."""


class SilentChipError(ChipError):
    """Nothing drives the data line: all replies are zeros or ones."""


class VariantError(ChipError):
    """The sensor's readings do not fit the variant that was opened."""


class VerifyError(ChipError):
    """A value read back is not the value written."""


class StatusError(ChipError):
    """STATUS reports a fault; the message carries its bits in words."""


class FitError(AdisGonioError):
    """The fit cannot give the requested result."""


class SingularError(FitError):
    """The session does not determine a parameter; the message names the direction and by how much."""


class SessionError(AdisGonioError):
    """A session cannot go on, or its archive cannot be read or written."""


class OutputError(AdisGonioError):
    """An output file cannot be written; an existing file is unchanged."""


class FleetError(AdisGonioError):
    """No worker for a fleet: no process can be started, or no scheduler answers."""
