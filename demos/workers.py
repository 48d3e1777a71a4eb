"""Attempts in several processes, results in order of their index.

Not `concurrent.futures`: its workers outlive a killed parent. Here a worker waits on a pipe that only the parent
holds, so it ends when the parent does, however that was.
"""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable, Generator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from ..extract.errors import UserError
from .attempt import AttemptRunner, AttemptSettings, finished_attempt

Result = dict[str, Any]


def attempts_in_order(
    settings: AttemptSettings, folder: Path, limit: int, workers: int, here: Callable[[], AttemptRunner]
) -> Generator[Result]:
    """Results of attempts 0, 1, ... `limit` - 1; those that are on the disk already are not made again.

    here: gives the runner of this process, used when `workers` is 1. Closing the iterator stops the workers.
    """
    if workers == 1:
        for index in range(limit):
            yield finished_attempt(folder, index) or here().run(index)
        return
    with _Pool(settings, folder, workers) as pool:
        ready: dict[int, Result] = {}
        ahead = 0
        for index in range(limit):
            while index not in ready:
                # No further ahead than the workers can be at work on: what is not needed is wasted.
                while ahead < limit and pool.has_idle():
                    if (done := finished_attempt(folder, ahead)) is not None:
                        ready[ahead] = done
                    else:
                        pool.start(ahead)
                    ahead += 1
                if index not in ready:
                    ready.update(pool.collect())
            yield ready.pop(index)


class _Pool:
    def __init__(self, settings: AttemptSettings, folder: Path, workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        self._processes: dict[Connection, Any] = {}
        self._at_work: dict[Connection, int] = {}
        for _ in range(workers):
            ours, theirs = context.Pipe()
            process = context.Process(target=_work, args=(theirs, settings, folder), daemon=True)
            process.start()
            theirs.close()
            self._processes[ours] = process

    def __enter__(self) -> _Pool:
        return self

    def __exit__(self, *_: object) -> None:
        for connection, process in self._processes.items():
            connection.close()
            process.terminate()
        for process in self._processes.values():
            process.join()

    def has_idle(self) -> bool:
        return len(self._at_work) < len(self._processes)

    def start(self, index: int) -> None:
        connection = next(c for c in self._processes if c not in self._at_work)
        self._at_work[connection] = index
        try:
            connection.send(index)
        except OSError as error:
            raise self._died(connection) from error

    def collect(self) -> dict[int, Result]:
        """Wait for at least one result."""
        results = {}
        for connection in wait(list(self._at_work)):
            assert isinstance(connection, Connection)
            try:
                kind, value = connection.recv()
            except (EOFError, OSError) as error:
                raise self._died(connection) from error
            index = self._at_work.pop(connection)
            if kind == "user error":
                raise UserError(value)
            if kind == "error":
                raise RuntimeError(f"attempt {index} failed in its process:\n{value}")
            results[index] = value
        return results

    def _died(self, connection: Connection) -> UserError:
        process = self._processes[connection]
        process.join(timeout=5)
        return UserError(
            f"the process of attempt {self._at_work[connection]} died (exit code {process.exitcode}), perhaps for want "
            "of memory; run again with fewer --workers, finished attempts are kept"
        )


def _work(connection: Connection, settings: AttemptSettings, folder: Path) -> None:
    # Ctrl-C reaches the whole group; the parent alone answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    runner: AttemptRunner | None = None
    try:
        while True:
            index = connection.recv()
            try:
                runner = runner or AttemptRunner(settings, folder)
                connection.send(("result", runner.run(index)))
            except UserError as error:
                connection.send(("user error", str(error)))
            except Exception:
                connection.send(("error", traceback.format_exc()))
    except (EOFError, OSError):
        return
