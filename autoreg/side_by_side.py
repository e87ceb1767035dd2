"""Several things at once: NumPy, SciPy and OpenCV let other threads run while they compute."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def side_by_side(done: Callable[[T], R], things: Sequence[T]) -> list[R]:
    """What becomes of all things, in their order; every other one is worked on beside the caller."""
    if len(things) < 2:
        return [done(thing) for thing in things]
    with ThreadPoolExecutor(1) as beside:
        theirs = beside.map(done, things[1::2])
        found = dict(zip(range(0, len(things), 2), map(done, things[::2]), strict=True))
        found |= zip(range(1, len(things), 2), theirs, strict=True)
    return [found[k] for k in range(len(things))]
