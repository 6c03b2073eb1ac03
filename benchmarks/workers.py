"""Jobs in processes of one native thread each."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import TypeVar

from tbmfg import workers

Job = TypeVar("Job")
Done = TypeVar("Done")


def run_all(function: Callable[[Job], Done], jobs: list[Job], processes: int, title: str) -> list[Done]:
    """``function`` of every job, in the order of the jobs; a bar on a terminal and nothing in a pipe. The first job
    that raises ends it."""
    done: dict[int, Done] = {}
    with (
        workers.processes(min(processes, len(jobs))) as pool,
        closing(workers.run(partial(_of_numbered, function), enumerate(jobs), pool)) as ended,
        bar(title, len(jobs)) as step,
    ):
        for (number, _), future in ended:
            done[number] = future.result()
            step()
    return [done[number] for number in range(len(jobs))]


def _of_numbered(function: Callable[[Job], Done], job: tuple[int, Job]) -> Done:
    return function(job[1])


@contextmanager
def bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """What to call after each of ``total`` steps: a bar on a terminal, nothing in a pipe."""
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)
