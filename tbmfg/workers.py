"""Independent jobs in many processes, here or on a cluster. A job whose worker died runs once more."""

from __future__ import annotations

import multiprocessing
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from tbmfg.errors import TbmfgError

Job = TypeVar("Job")

# Every worker computes with one native thread: N of them do not fight for cores, and sums are taken in the same
# order however many there are. Read when the libraries are loaded, so set before a worker starts.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "TBB_NUM_THREADS")
CONNECT_S = 10


@dataclass(frozen=True, slots=True)
class Workers:
    """``start`` gives a fresh executor, which has ``width`` jobs at a time; None: all of them."""

    start: Callable[[], Executor]
    width: int | None


@contextmanager
def processes(count: int) -> Iterator[Workers]:
    """Processes of this machine, started afresh: a fork would share loaded libraries and their threads."""
    spawn = multiprocessing.get_context("spawn")
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield Workers(lambda: ProcessPoolExecutor(count, mp_context=spawn), count)
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def cluster(address: str) -> Iterator[Workers]:
    """Workers of the Dask scheduler at ``address``, such as tcp://host:8786. Raises TbmfgError where none answers.

    Dask itself gives the jobs of a lost worker to another one.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise TbmfgError(f"{address}: a scheduler wants Dask ({error}); pip install 'tbmfg[cluster]'") from error
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = f"no Dask scheduler answers in {CONNECT_S} s ({error})"
        raise TbmfgError(f"{address}: {reason}; start one with: dask scheduler") from error
    with client:
        yield Workers(lambda: client.get_executor(pure=False), None)


def run(function: Callable[[Job], Any], jobs: Iterable[Job], workers: Workers) -> Iterator[tuple[Job, Future]]:
    """``function`` of every job; (job, done future) in the order in which they end.

    Where a worker dies, all that run beside it are lost as well, and nobody can tell which of them did it. Each runs
    again, alone: whose worker then dies for the second time is to blame, and its future holds a BrokenExecutor.
    """
    waiting, again, tried = deque(jobs), deque[Job](), list[Job]()
    running: dict[Future, Job] = {}
    pool = workers.start()
    try:
        while waiting or again or running:
            alone = bool(again or any(job in tried for job in running.values()))
            queue, width = (again, 1) if alone else (waiting, workers.width or len(waiting))
            while queue and len(running) < width:
                try:
                    running[pool.submit(function, queue[0])] = queue[0]
                except BrokenExecutor:  # a worker died while it had nothing to do
                    pool = workers.start()
                    continue
                if alone:
                    tried.append(queue[0])
                queue.popleft()
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            if any(isinstance(future.exception(), BrokenExecutor) for future in done):
                done, _ = wait(running)
                pool.shutdown(wait=False)
                pool = workers.start()
            for future in done:
                job = running.pop(future)
                if isinstance(future.exception(), BrokenExecutor) and job not in tried:
                    again.append(job)
                else:
                    yield job, future
    finally:
        pool.shutdown(wait=not running)
