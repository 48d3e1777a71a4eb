"""How long work tells a person where it is."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, Self

Progress = Callable[[int, int, str], None]
"""Called with the pieces done, the pieces in all and a few words."""


class Listener:
    """Told how a run of stages goes on; this one keeps silent. `title` is the stage's, in words."""

    def started(self, title: str, number: int, count: int) -> None:
        """Stage `number` of `count` begins."""

    def progress(self, done: int, total: int, text: str) -> None:
        """The stage at work has finished `done` of `total` pieces."""

    def finished(self, title: str, seconds: float) -> None:
        """The stage at work is done."""

    def failed(self, title: str) -> None:
        """The stage at work was interrupted or raised an error."""

    def skipped(self, title: str, number: int, count: int) -> None:
        """A stage has nothing to do."""


class Terminal(Listener):
    """Writes to standard error: a bar on a terminal, elsewhere a line now and then (every `every_s` seconds)."""

    every_s = 15.0

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._last_s = time.monotonic()
        self._bar: Any = None

    def started(self, title: str, number: int, count: int) -> None:
        self._say(f"[{number}/{count}] {title}")
        self._last_s = time.monotonic()

    def progress(self, done: int, total: int, text: str) -> None:
        if self._live:
            if self._bar is None:
                from rich.console import Console
                from rich.progress import Progress as Bar

                self._bar = Bar(console=Console(stderr=True), transient=True)
                self._bar.start()
                self._bar.add_task("")
            self._bar.update(self._bar.task_ids[0], completed=done, total=total, description=f"      {text}")
        elif time.monotonic() - self._last_s > self.every_s:
            self._last_s = time.monotonic()
            self._say(f"      {done} of {total}: {text}")

    def finished(self, title: str, seconds: float) -> None:
        self.end()
        self._say(f"      done in {seconds:.1f} s")

    def failed(self, title: str) -> None:
        self.end()

    def skipped(self, title: str, number: int, count: int) -> None:
        self._say(f"[{number}/{count}] {title}: nothing has changed")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Take the bar away."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _say(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)
