"""Several things at once: NumPy, SciPy and OpenCV let other threads run while they compute."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def side_by_side(done: Callable[[T], R], things: Sequence[T]) -> list[R]:
    """What becomes of all things, in their order; two are worked on at a time."""
    if len(things) < 2:
        return [done(thing) for thing in things]
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(done, things))
