"""Progress of tests and trainings, shown on standard error."""

from __future__ import annotations

import sys
import time

# Interval between two progress lines on a terminal and in a log, s. On a terminal each line replaces the last one.
_TERMINAL_INTERVAL, _LOG_INTERVAL = 0.2, 5.0


class Progress:
    """Shows on standard error how many episodes of a test or a training are done.

    Args:
        show: whether to show progress. None shows it on a terminal only.
    """

    def __init__(self, show: bool | None) -> None:
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self._shown = self._terminal if show is None else show
        self._next = 0.0
        self._written = False

    def update(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` episodes are done. `what` names the test or training."""
        now = time.monotonic()
        if not self._shown or (now < self._next and done < total):
            return
        self._next = now + (_TERMINAL_INTERVAL if self._terminal else _LOG_INTERVAL)
        line = f"{what}: {done} of {total} episodes"
        self._write(f"\r\x1b[K{line}" if self._terminal else f"{line}\n")
        self._written = True

    def finish(self) -> None:
        """Remove the progress line from the terminal."""
        if self._written and self._terminal:
            self._write("\r\x1b[K")
        self._written = False

    def _write(self, text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()
