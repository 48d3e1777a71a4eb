"""One function over many jobs, in processes of this machine or on a Ray cluster; results as they come.

A job is worth seconds and writes its own files: what comes back is small, what a killed command has done stays, and a
job may be done again. One that takes its process down with it, for want of memory or by a crash, has the result None.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import cv2

from .errors import UserError

AHEAD = 2  # jobs handed out a worker: one at work, one waiting, so that an interruption ends soon
AGAIN = 1  # times that Ray repeats a job whose process or machine was lost: it may have died of another's greed
STARTS = 3  # of a Ray of our own: parts of it wait only so long for each other, which a busy machine can exceed
STORE_BYTES = 80 * 1024**2  # of memory that a Ray started here shares; results are small, less it does not take


def in_processes[Job, Found](
    work: Callable[[Job], Found], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[Job, Found | None]]:
    """(job, result) of every job; with one worker in this process, in order."""
    if workers <= 1 or len(jobs) <= 1:
        yield from ((job, work(job)) for job in jobs)
        return
    left = list(jobs)
    while left:
        try:
            for job, found in _in_pool(work, tuple(left), workers):
                left.remove(job)
                yield job, found
        except BrokenProcessPool:
            # A process died and took the pool with it. Of those handed out any may be to blame: each alone, then on.
            suspects, left = left[: AHEAD * workers], left[AHEAD * workers :]
            for job in suspects:
                try:
                    yield from _in_pool(work, (job,), 1)
                except BrokenProcessPool:
                    yield job, None


def on_cluster[Job, Found](
    work: Callable[[Job], Found], jobs: Sequence[Job], workers: int, gpus: float = 0.0
) -> Iterator[tuple[Job, Found | None]]:
    """(job, result) of every job, by Ray tasks of one CPU and `gpus` GPUs each, on all of `ray_cluster`.

    Raises UserError as that does, and when there are too few GPUs.
    """
    with ray_cluster(workers) as ray:
        there = ray.cluster_resources()
        if there.get("GPU", 0.0) < gpus:
            raise UserError(f"--gpus {gpus:g} is more than the {there.get('GPU', 0.0):g} that Ray has; give less")
        task = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=AGAIN)(_alone)

        def result(reference: Any) -> Any:
            try:
                return ray.get(reference)
            except ray.exceptions.RayTaskError:
                raise
            except ray.exceptions.RayError:  # its process or machine was lost again and again
                return None

        most = AHEAD * int(there.get("CPU", 1))
        yield from _as_they_come(jobs, most, lambda job: task.remote(work, job), lambda w: ray.wait(list(w))[0], result)


@contextmanager
def ray_cluster(workers: int) -> Iterator[Any]:
    """Ray, connected to the cluster that RAY_ADDRESS names, or else to one of `workers` CPUs on this machine.

    What was connected before stays so; else the connection ends with the block, and with it a cluster started here.
    Raises UserError without Ray and when the cluster cannot be reached.
    """
    # Read when Ray is loaded: the usual times are too short for a start on a busy machine.
    os.environ.setdefault("RAY_raylet_start_wait_time_s", "90")
    os.environ.setdefault("RAY_agent_register_timeout_ms", "90000")
    try:
        import ray as installed
    except ImportError as error:
        raise UserError("--ray needs Ray; `pip install 'vid2demo[cluster]'`") from error
    ray: Any = installed
    if ray.is_initialized():
        yield ray
        return
    _connect(ray, os.environ.get("RAY_ADDRESS"), max(workers, 1))
    try:
        yield ray
    finally:
        ray.shutdown()


def _connect(ray: Any, address: str | None, workers: int) -> None:
    own = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": STORE_BYTES}
    for tries_left in reversed(range(1 if address else STARTS)):
        try:
            ray.init(address=address or "local", log_to_driver=False, **({} if address else own))
            return
        except Exception as error:  # Ray raises all kinds, the bare one too
            ray.shutdown()
            if not tries_left:
                where = f"at {address}" if address else "on this machine"
                raise UserError(f"the Ray cluster {where} cannot be reached: {error}") from error


def _in_pool[Job, Found](
    work: Callable[[Job], Found], jobs: Sequence[Job], workers: int
) -> Iterator[tuple[Job, Found | None]]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context, initializer=_begin) as pool:
        yield from _as_they_come(
            jobs,
            AHEAD * workers,
            lambda job: pool.submit(work, job),
            lambda waiting: wait_for(waiting, return_when=FIRST_COMPLETED).done,
            lambda future: future.result(),
        )


def _as_they_come[Job](
    jobs: Iterable[Job],
    most: int,
    submit: Callable[[Job], Any],
    some_done: Callable[[Iterable[Any]], Iterable[Any]],
    result: Callable[[Any], Any],
) -> Iterator[tuple[Job, Any]]:
    """Keep at most `most` jobs handed out, in their order."""
    waiting: dict[Any, Job] = {}
    rest = iter(jobs)
    while True:
        while len(waiting) < most and (job := next(rest, None)) is not None:
            waiting[submit(job)] = job
        if not waiting:
            return
        for ticket in some_done(waiting):
            yield waiting.pop(ticket), result(ticket)


def _alone[Job, Found](work: Callable[[Job], Found], job: Job) -> Found:
    """Many workers, one thread each."""
    cv2.setNumThreads(1)
    return work(job)


def _begin() -> None:
    """One thread in a worker here too; and none outlives the command, however it ends."""
    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
