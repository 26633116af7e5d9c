"""A worker process of one machine: jobs come in as lines of JSON, records go out as lines of JSON.

    python -P -m adis_gonio.fleet.worker

It ends when its standard input does, also in the midst of a session: whoever started it has gone.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
from typing import Any

from adis_gonio.base import __version__
from adis_gonio.fleet.work import work


def main() -> None:
    """Answer each line until there are no more."""
    # What a library prints must not stand among the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    jobs: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(jobs,), daemon=True).start()
    document: dict[str, Any] = {"ready": __version__}
    while True:
        answers.write(json.dumps(document) + "\n")
        answers.flush()
        document = work(**jobs.get()).as_dict()


def _read(jobs: queue.SimpleQueue[dict[str, Any]]) -> None:
    for line in sys.stdin:
        jobs.put(json.loads(line))
    os._exit(0)


if __name__ == "__main__":
    main()
