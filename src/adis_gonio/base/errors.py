"""All error classes of the package, grouped by the person who has to act.

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

import re
from collections.abc import Iterable


def one_line(text: str) -> str:
    """Convert a text to one printable line: single spaces, and `?` for each unprintable character.

    Text of a file or a device must not control a terminal. Undecodable bytes of a file name are kept.
    """
    words = " ".join(text.split())
    return "".join(c if c.isprintable() or "\udc80" <= c <= "\udcff" else "?" for c in words)


class AdisGonioError(Exception):
    """Base class of all errors that this package raises on purpose; the text is one printable line."""

    exit_code = 1

    def __str__(self) -> str:
        # A message about a device begins with its URL and a colon, and a bare URL (`serial:`) ends in one.
        return re.sub(r"^([\w-]+:): ", r"\1 ", one_line(super().__str__()))


class UsageError(AdisGonioError, ValueError):
    """The user made a mistake in a call: an option, an argument or a URL is wrong."""

    exit_code = 2


class DataError(AdisGonioError, ValueError):
    """A file's content cannot be used; the message names the file and the row."""


class NotInstalledError(AdisGonioError):
    """An optional library is not installed; the message names the extra of adis-gonio that installs it."""


class BusError(AdisGonioError):
    """Base class of errors in the communication between the host and the sensor chip."""


def install_extra(extra: str) -> str:
    """Return the advice with the command that installs an extra of this package from its clone."""
    return f"run pip install '.[{extra}]' in the folder of adis-gonio"


class CannotOpenError(BusError):
    """The device cannot be opened: it is missing, in use, or access to it is not permitted."""


class ProtocolError(BusError):
    """The bridge sent an answer that violates its protocol."""


class BusTimeoutError(BusError, TimeoutError):
    """The bridge did not answer within the time limit."""


class BusClosedError(BusError):
    """The bus was used after it was closed."""


class CapabilityError(BusError):
    """The bus does not have the requested capability, such as a GPIO line."""


class ChipError(AdisGonioError):
    """Base class of errors that the sensor chip itself causes or reports."""


class SilentChipError(ChipError):
    """The chip does not answer: all replies consist of zeros or of ones."""


class VariantError(ChipError):
    """The sensor's readings do not agree with the chip variant that the user named."""


class VerifyError(ChipError):
    """A register has another value after a write than the written value."""


class StatusError(ChipError):
    """The chip's STATUS register reports an error; the message describes its bits in words."""


class FitError(AdisGonioError):
    """No fit can give the requested result from the data of this session."""


class SingularError(FitError):
    """The session does not determine a parameter; the message names the undetermined combination."""


class SessionError(AdisGonioError):
    """A session cannot continue, or its archive cannot be read or written."""


class OutputError(AdisGonioError):
    """An output file cannot be written; an existing file is unchanged."""


class FleetError(AdisGonioError):
    """A group of worker processes (fleet) has no worker: no process starts, or no scheduler answers."""


def suggest(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return the end of a message about an unknown word: the most similar known word.

    If none is similar, it is the text `otherwise`, or the list of all known words if that is empty.
    """
    import difflib

    words = list(known)
    near = difflib.get_close_matches(word, words, n=1)
    return f"did you mean '{near[0]}'?" if near else otherwise or f"known: {', '.join(words) or 'none'}"
