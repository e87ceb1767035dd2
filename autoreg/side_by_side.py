"""Several things at once: NumPy, SciPy and OpenCV let other threads run while they compute."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


@cache
def _beside() -> ThreadPoolExecutor:
    """The other thread: to start one takes as long as many a thing that it is given."""
    return ThreadPoolExecutor(1, thread_name_prefix="beside")


# A forked process has the pool but not its thread.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_beside.cache_clear)


def side_by_side(done: Callable[[T], R], things: Sequence[T]) -> list[R]:
    """What becomes of all things, in their order; every other one is worked on beside the caller.

    None of them may do things side by side itself: it would wait for its own thread.
    """
    theirs = [_beside().submit(done, thing) for thing in things[1::2]]
    mine = [done(thing) for thing in things[::2]]
    results = [*mine, *(future.result() for future in theirs)]
    results[::2], results[1::2] = mine, results[len(mine) :]
    return results
