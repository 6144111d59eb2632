"""Progress of long work on standard error: a bar on a terminal, a plain line now and then elsewhere.

Usually nothing is shown of work that takes less than two seconds; nothing ever is after `silence()` (option --quiet).
"""

from __future__ import annotations

import sys
import time

_silent = False


def silence() -> None:
    """Show no progress in this process any more, nor that the plant is being compiled."""
    import logging

    global _silent
    _silent = True
    logging.getLogger("plant").setLevel(logging.ERROR)


class Progress:
    """Shows how much of some work is done; a context manager, so that the bar is removed at the end.

    with Progress("rows") as progress:
        progress(done, size)
    """

    first_after_s = 2.0
    line_every_s = 10.0

    def __init__(self, what: str, unit: str = "", *, at_once: bool = False) -> None:
        """Name the work, and the unit of its amounts, e.g. "s"; at_once: show it from the first call on."""
        self._what = what
        self._unit = f" {unit}" if unit else ""
        self._began_s = time.monotonic()
        self._next_s = self._began_s + (0.0 if at_once else self.first_after_s)
        self._first: float | None = None
        self._shown = ""

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        if self._shown:
            print("\r" + " " * len(self._shown), end="\r", file=sys.stderr, flush=True)

    def __call__(self, done: float, size: float, note: str = "") -> None:
        """Show that `done` of `size` is done, and a note, if it is time to."""
        now_s = time.monotonic()
        if self._first is None:  # of continued work some is done already
            self._first, self._began_s = done, now_s
        if now_s < self._next_s or _silent or sys.stderr is None:
            return
        share = min(1.0, done / size) if size > 0 else 1.0
        text = f"{self._what}: {100 * share:.0f} % ({done:.6g} of {size:.6g}{self._unit})"
        if done > self._first:
            rate = (done - self._first) / (now_s - self._began_s)
            text += f", {rate:.3g}{self._unit}/s, {(size - done) / rate:.0f} s left"
        text += f"; {note}" if note else ""
        if sys.stderr.isatty():
            self._next_s = now_s + 0.1
            bar = f"[{'#' * round(30 * share):.<30}] {text}"
            print("\r" + bar.ljust(len(self._shown)), end="", file=sys.stderr, flush=True)
            self._shown = bar
        else:
            self._next_s = now_s + self.line_every_s
            print(text, file=sys.stderr, flush=True)
