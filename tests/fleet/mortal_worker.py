"""A computation that a file kills whose name says `deadly`, as one that takes all memory would."""

import os
import signal

from adis_gonio.fleet.session_record import work


def work_or_die(path, *asked):
    if "deadly" in path:
        os.kill(os.getpid(), signal.SIGKILL)
    return work(path, *asked)
