"""Opens the URLs of its arguments and reads a word from each; what became of it as a line of JSON a URL.

A program of its own, so that a test can run it as another user.
"""

from __future__ import annotations

import json
import sys

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.device.bus import open_bus

READ_SUPPLY = 0x0200


def outcome(url: str) -> dict[str, object]:
    """The word, or the error's class and message."""
    try:
        with open_bus(url) as bus:
            return {"url": url, "supply": bus.exchange([READ_SUPPLY, 0])[1] & 0xFFF}
    except AdisGonioError as error:
        return {"url": url, "error": type(error).__name__, "message": str(error)}


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        sys.stdout.write(json.dumps(outcome(argument)) + "\n")
