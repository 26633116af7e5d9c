"""A process that opens URLs as the users that it is asked for, and reads a word from each."""

from __future__ import annotations

import os
from collections.abc import Sequence
from multiprocessing.connection import Connection

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.device.bus import open_bus

READ_SUPPLY = 0x0200


def serve(connection: Connection) -> None:
    """Answer requests `(urls, user, groups)` until None is received, each in a forked process of that user.

    The answer is the list of outcomes, one for each URL, or `{"error": message}`.
    """
    while (request := connection.recv()) is not None:
        urls, user, groups = request
        process = os.fork()
        if process == 0:
            answer: object = {"error": "the process ended early"}
            try:
                become(user, groups)
                answer = [outcome(url) for url in urls]
            except Exception as error:  # the test that asked shall show it
                answer = {"error": f"{type(error).__name__}: {error}"}
            finally:
                connection.send(answer)
                os._exit(0)
        os.waitpid(process, 0)


def become(user: int, groups: Sequence[int]) -> None:
    """Give up root for an ordinary user, for good."""
    os.setgroups(groups)
    os.setgid(user)
    os.setuid(user)


def outcome(url: str) -> dict[str, object]:
    """Return the word that was read, or the error's class and message."""
    try:
        with open_bus(url) as bus:
            return {"url": url, "supply": bus.exchange([READ_SUPPLY, 0])[1] & 0xFFF}
    except AdisGonioError as error:
        return {"url": url, "error": type(error).__name__, "message": str(error)}
