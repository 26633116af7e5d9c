"""A session on the screen, from its start to what stands in the terminal afterwards."""

from __future__ import annotations

import sys

from adis_gonio.base.errors import SessionError
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.faces.tui.bench import BenchApp
from adis_gonio.faces.tui.state import BenchState
from adis_gonio.record.archive import ArchiveView


class ScreenFace:
    """Runs a session on the screen.

    Parameters
    ----------
    runner : SessionRunner
        Not run yet.
    resume_by : str
        Command that goes on with the session.
    """

    def __init__(self, runner: SessionRunner, resume_by: str) -> None:
        self._runner = runner
        self._resume_by = resume_by

    def run(self) -> bool:
        """Run the session; return True where it is complete.

        Raises
        ------
        SessionError
            The screen itself failed; what was recorded is kept.
        Exception
            As the runner raises them. How to resume has then been said on standard error.
        KeyboardInterrupt
            The operator would not wait for the session's end, or a signal ended it.
        """
        app = BenchApp(self._runner, self._resume_by, remember)
        try:
            app.run(mouse=False)
        finally:
            self._runner.stop()
            if not app.abandoned:
                app.wait()
        for message in app.state.messages:
            _say(f"  {message.text}")
        return self._ended(app)

    def _ended(self, app: BenchApp) -> bool:
        """What is left to say once the terminal is as it was."""
        if app.abandoned or app.killed:
            raise KeyboardInterrupt
        if app.crash is not None:
            name = type(app.crash).__name__
            raise SessionError(
                f"the screen failed ({name}: {app.crash}); go on with {self._resume_by} --plain"
            ) from app.crash
        if app.error is not None:
            _say(f"what was recorded is kept; go on with {self._resume_by}")
            raise app.error
        finished = app.state.finished
        if finished is None or finished.complete:
            return finished is not None
        _say(f"  not complete: {finished.done} of {finished.total}; go on with {self._resume_by}")
        return False


def remember(state: BenchState) -> None:
    """Fill in what earlier runs of a session have done."""
    with ArchiveView(state.path) as view:
        done = [attempt.place for attempt in view.dwells()]
        faulty = [attempt.place for attempt in view.faulty()]
        state.remember(done, view.skipped(), faulty)


def _say(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201
