"""Jobs in processes of one native thread each."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from typing import TypeVar

Job = TypeVar("Job")
Done = TypeVar("Done")

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def run_all(function: Callable[[Job], Done], jobs: list[Job], processes: int, title: str) -> list[Done]:
    """``function`` of every job, in the order of the jobs; a bar on a terminal and nothing in a pipe.

    The processes are started afresh, so that the thread limits are read by whatever they load.
    """
    pool = ProcessPoolExecutor(min(processes, len(jobs)), mp_context=multiprocessing.get_context("spawn"))
    with _one_thread(), _bar(title, len(jobs)) as step:
        try:
            futures = [pool.submit(function, job) for job in jobs]
            for future in as_completed(futures):
                future.result()
                step()
        finally:
            pool.shutdown(cancel_futures=True)
    return [future.result() for future in futures]


@contextmanager
def _one_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)
