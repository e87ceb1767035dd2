"""The command `autoreg`, which is also `python -m autoreg`: a process that begins and ends quickly."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
from types import ModuleType
from typing import Any

from autoreg.errors import INTERRUPTED

# So many objects may come to be before Python looks for garbage among them. While modules are imported nearly
# all of them stay, and looking takes a tenth of the time.
GARBAGE = 200_000
# Parts of NumPy that SciPy takes hold of, with all that NumPy has a name for, and that nothing here asks of
# anything. To import them takes as long as NumPy itself.
UNASKED = ("f2py", "testing")


class _Shape:
    """Stands for every type of jaxtyping's, of whatever array and shape."""

    def __class_getitem__(cls, _of: object) -> type[_Shape]:
        return cls


class _Shapes(ModuleType):
    """Stands for jaxtyping, which takes half as long to import as NumPy.

    Its types are read by people and checked by tests; nothing in a command evaluates them.
    """

    def __getattr__(self, name: str) -> type[_Shape]:
        if name.startswith("_"):
            raise AttributeError(name)
        return _Shape


class _Unasked(ModuleType):
    """Stands for a module until something of it is asked for."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module(self.__name__), name)


def program() -> None:
    """Run the command line, and end the process with the contract's exit code."""
    gc.set_threshold(GARBAGE)
    # Alignment and calibration hold BLAS to one thread (blas_threads.py); here no others need be started.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.modules.setdefault("jaxtyping", _Shapes("jaxtyping"))
    try:
        import numpy as np

        for name in UNASKED:
            # NumPy imports them itself when they are imported by name.
            if name not in vars(np):
                setattr(np, name, _Unasked(f"numpy.{name}"))
        from autoreg.command.cli import main
    except KeyboardInterrupt:
        # Before the command has begun there is nothing to end or to tell.
        os._exit(INTERRUPTED)

    try:
        main()
    except SystemExit as end:
        if end.code is None or isinstance(end.code, int):
            _leave(end.code or 0)
        raise


def _leave(code: int) -> None:
    """End the process as Python would, but without taking every module apart, which takes long.

    It comes back where something could not be written: how that is told is left to Python.
    """
    atexit._run_exitfuncs()  # pyright: ignore[reportPrivateUsage]
    try:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
    except (OSError, ValueError):
        return
    os._exit(code)


if __name__ == "__main__":
    program()
