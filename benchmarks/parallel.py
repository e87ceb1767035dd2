"""Photos measured side by side, in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


def measured(work: Callable[[Item], Outcome], items: Sequence[Item], jobs: int) -> list[Outcome]:
    """What `work` makes of each item, in their order; the same figures by any number of processes.

    Args:
        work: a function of a module, or a `functools.partial` of one, so that a process can find it.
        items: what it is called with, one by one; they and what comes of them are pickled.
        jobs: so many processes; one is this one.
    """
    if jobs == 1:
        return [work(item) for item in items]
    # Processes that are started anew read this: each has a processor to itself, and no more.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(work, items))
