"""Machine code of a compiled function in jax's own form, and functions of jax called with plain arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable


def jax_form(compiled: jax.stages.Compiled) -> bytes:
    """A compiled function as bytes.

    Raises:
        ValueError: this kind has no such form.
    """
    return serialize_executable.serialize(compiled)[0]


def from_jax_form(code: bytes, arguments: Any, returned: Any) -> Callable[..., Any]:
    """The function that `jax_form` made bytes of.

    Args:
        code: those bytes.
        arguments: a tuple of what the function takes, for its structure.
        returned: the structure of what it returns.
    """
    given, returned = jax.tree.structure((arguments, {})), jax.tree.structure(returned)
    _look_up_lapack()
    return on_arrays(serialize_executable.deserialize_and_load(code, given, returned, backend="cpu"))


def on_arrays(compiled: Any) -> Callable[..., Any]:
    """A compiled function of 64-bit numbers that returns NumPy's arrays, whatever mode jax is in."""

    def call(*arguments: Any) -> Any:
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, compiled(*arguments))

    return call


def _look_up_lapack() -> None:
    """Tell jaxlib where LAPACK is, which jax does when it lowers an operation that needs it."""
    try:
        from jaxlib.lapack import prepare_lapack_call

        prepare_lapack_call("potrf_ffi", np.dtype(np.float64))
    except (ImportError, AttributeError, TypeError):
        # A longer way to the same, in which nothing has a name that a later jaxlib may drop.
        with jax.enable_x64(True):
            jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float64))
