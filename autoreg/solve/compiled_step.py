"""The solver's step, compiled once for a process, or fetched where an earlier one left it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from autoreg.solve.machine_code import fingerprint, keep_code, read_code
from autoreg.solve.step_state import Step, example_arguments

# What the step's code is made of, and how it is kept.
_NAMES = ("joint_data", "residuals", "step_state", "lm_step", "bare_code", "jax_code")
SOURCES = tuple(Path(__file__).with_name(f"{name}.py") for name in _NAMES)
PACKAGES = ("jax", "jaxlib", "jaxopt")

_COMPILING = threading.Lock()
_STEP: list[Step] = []


def compiled_step(folder: Path | None = None) -> Step:
    """The step, compiled once for this process.

    Args:
        folder: where an earlier process may have left its machine code, and where else it is left.
    """
    # Whoever comes while another thread compiles (beside the reading of a photo) waits for it.
    with _COMPILING:
        if not _STEP:
            _STEP.append(_compiled() if folder is None else _kept(folder))
        return _STEP[0]


def _compiled() -> Step:
    from autoreg.solve.jax_code import on_arrays
    from autoreg.solve.lm_step import compiled_with_jax

    return on_arrays(compiled_with_jax())


def _kept(folder: Path) -> Step:
    """The step from the folder, else compiled and left there.

    It is kept in two forms. One needs nothing but jaxlib; where that fails or jax is there anyway, jax's own
    is fetched.
    """
    name = fingerprint(*SOURCES, packages=PACKAGES)
    bare, own = folder / f"step-{name}.bare", folder / f"step-{name}.jax"
    step = None if "jax" in sys.modules else _fetched(bare, _run_bare)
    return step or _fetched(own, _run_with_jax) or _compiled_and_kept(bare, own)


def _fetched(path: Path, made_of: Callable[[bytes], Step]) -> Step | None:
    """The step that a file holds, once it has been carried out where an error can still be helped."""
    code = read_code(path)
    # Whatever is wrong with what was kept, or with this jaxlib, there is another way.
    with suppress(Exception):
        if code is not None:
            step = made_of(code)
            step(*example_arguments())
            return step
    return None


def _run_bare(code: bytes) -> Step:
    from autoreg.solve.bare_code import from_bare_form

    return from_bare_form(code, example_arguments(), example_arguments()[:2])


def _run_with_jax(code: bytes) -> Step:
    from autoreg.solve.jax_code import from_jax_form

    return from_jax_form(code, example_arguments(), example_arguments()[:2])


def _compiled_and_kept(bare: Path, own: Path) -> Step:
    from autoreg.solve.bare_code import bare_form
    from autoreg.solve.jax_code import jax_form, on_arrays
    from autoreg.solve.lm_step import compiled_with_jax

    compiled = compiled_with_jax()
    # A step that has no such form is compiled by every process.
    with suppress(Exception):
        keep_code(own, jax_form(compiled))
        keep_code(bare, bare_form(compiled, example_arguments()))
    return on_arrays(compiled)
