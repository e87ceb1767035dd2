"""Linear algebra on one thread: matrices here are small, and threads that wait for each other cost more."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


class _Holders:
    """How many hold BLAS to one thread, and how to give its own number back."""

    def __init__(self) -> None:
        self.lock, self.count = threading.Lock(), 0
        self.give_back: Callable[[], None] = lambda: None


_HOLDERS = _Holders()


@contextmanager
def one_blas_thread() -> Generator[None]:
    """Hold BLAS to one thread in the whole process, until the last who asked for it has left.

    OpenBLAS's threads spin while they wait, which costs most where other programs keep the processor busy.
    """
    with _HOLDERS.lock:
        if _HOLDERS.count == 0:
            _release_control()
            _HOLDERS.give_back = _libraries().limit(limits=1).restore_original_limits
        _HOLDERS.count += 1
    try:
        yield
    finally:
        with _HOLDERS.lock:
            _HOLDERS.count -= 1
            if _HOLDERS.count == 0:
                _release_control()
                _HOLDERS.give_back()
                _release_control()


def _release_control() -> None:
    """Let whoever sets a number next be heard: threadpoolctl listens to one thread only, from 3.8 on."""
    for library in _libraries().lib_controllers:
        leave = getattr(library, "clear_controlling_thread", None)
        if leave is not None:
            leave(force=True)


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController().select(user_api="blas")
