"""Errors, drawn as a tree by who has to act.

Every message is one line: it names the file, row, register, option or port, and says what to do.
`exit_code` is what the command line returns: 1 where the job failed, 2 where the call was wrong.

=====================  =================================================================
error                  who acts
=====================  =================================================================
`UsageError`           the caller: an option, a URL, an argument
`DataError`            whoever made the file
`NotInstalledError`    whoever installed the package: an extra is missing
`CannotOpenError`      whoever set up the machine: permissions, cables, a busy device
`ProtocolError`        the bridge: corrupted or short answers
`BusTimeoutError`      the bridge or the cable: no answer
`BusClosedError`       the caller: use after close
`CapabilityError`      the caller: this bus cannot do that
`ChipError` and below  the sensor, its wiring or its supply
`FitError` and below   the plan of the session: the data do not determine what was asked
`SessionError`         the operator or the archive
`OutputError`          whoever owns the disk: a file cannot be written
`FleetError`           whoever runs the machine or the cluster: no worker, no scheduler
=====================  =================================================================
"""

from __future__ import annotations


def one_line(text: str) -> str:
    """Return the words of a text with one space between them and `?` for each unprintable letter.

    Text of a file or a device must not steer a terminal. Bytes of a file's name that are no text stay.
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
    """Base of what can go wrong between the host and the chip's pins."""


class CannotOpenError(BusError):
    """The device is not there, is busy, or permission is missing."""


class ProtocolError(BusError):
    """The bridge answered, but not what its protocol allows."""


class BusTimeoutError(BusError, TimeoutError):
    """The bridge did not answer in its time."""


class BusClosedError(BusError):
    """The bus was used after it had been closed."""


class CapabilityError(BusError):
    """The bus has not the optional capability that was asked for."""


class ChipError(AdisGonioError):
    """Base of what the sensor itself reports or does."""


class SilentChipError(ChipError):
    """Nothing drives the data line: all replies are zeros or ones."""


class VariantError(ChipError):
    """The sensor's readings do not fit the variant that was opened."""


class VerifyError(ChipError):
    """A value read back is not the value written."""


class StatusError(ChipError):
    """STATUS reports a fault; the message carries its bits in words."""


class FitError(AdisGonioError):
    """The fit cannot give what was asked for."""


class SingularError(FitError):
    """The session does not determine a parameter; the message names the direction and by how much."""


class SessionError(AdisGonioError):
    """A session cannot go on, or its archive cannot be read or written."""


class OutputError(AdisGonioError):
    """A file that was asked for cannot be written; what was there before is as it was."""


class FleetError(AdisGonioError):
    """Nobody is there to work on a fleet: no process can be started, no scheduler answers."""
