"""A few threads that do jobs side by side; what they return does not depend on how many they are."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

MOST_THREADS = 4  # that do jobs side by side: every one of them waits for Python's lock now and then


def usable_cpus() -> int:
    """How many processors this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def side_by_side[Job, Found](work: Callable[[Job], Found], jobs: Sequence[Job]) -> list[Found]:
    """work(job) of every job, in their order, on as many threads as there are processors, MOST_THREADS at most."""
    crew = Crew(max(1, min(usable_cpus(), MOST_THREADS, len(jobs))))
    try:
        return crew.run(lambda k: work(jobs[k]), range(len(jobs)))
    finally:
        crew.close()


class Crew:
    """`threads` threads, the caller's among them."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads - 1, "vid2demo") if threads > 1 else None

    def run[T](self, job: Callable[[int], T], numbers: Sequence[int]) -> list[T]:
        """job(n) for every number, in the order of the numbers.

        All jobs are done before the first error in that order, if there is one, is raised.
        """
        waiting = deque(enumerate(numbers))
        done: list[T | None] = [None] * len(numbers)
        errors: list[tuple[int, Exception]] = []

        def work() -> None:
            while True:
                try:
                    place, number = waiting.popleft()
                except IndexError:
                    return
                try:
                    done[place] = job(number)
                except Exception as error:
                    errors.append((place, error))

        helpers = [self._pool.submit(work) for _ in range(min(self.threads, len(numbers)) - 1)] if self._pool else []
        work()
        for helper in helpers:
            helper.result()
        if errors:
            raise min(errors, key=lambda found: found[0])[1]
        return done  # type: ignore[return-value]

    def stream[T, U](self, job: Callable[[int], T], then: Callable[[int, T], U], numbers: Sequence[int]) -> list[U]:
        """then(n, job(n)) for every number, `then` in the caller's thread and in order, beside the jobs to come."""
        if self._pool is None:
            return [then(number, job(number)) for number in numbers]
        jobs = [self._pool.submit(job, number) for number in numbers]
        try:
            # A job that nobody has begun is done here.
            return [
                then(number, job(number) if waiting.cancel() else waiting.result())
                for number, waiting in zip(numbers, jobs, strict=True)
            ]
        finally:
            for waiting in jobs:
                waiting.cancel()
            wait(jobs)

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
