"""Machine code run by jaxlib alone: to import jax takes longer than everything that it would do here.

What jaxlib offers to jax may change with every release, so only those are used that this was tried with.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

# Releases of jaxlib whose insides are known.
KNOWN_RELEASES = ("0.8.", "0.9.", "0.10.", "0.11.", "0.12.")
_LENGTH_BYTES = 8


class UnknownReleaseError(Exception):
    """This release of jaxlib is not known."""


class _Shape(NamedTuple):
    """What jaxlib asks of an array's description."""

    shape: tuple[int, ...]
    dtype: np.dtype
    weak_type: bool = False


def bare_form(compiled: Any, arguments: Any) -> bytes:
    """A function that jax compiled for the processor, as bytes.

    Args:
        compiled: the function, all of whose arguments are used or kept.
        arguments: a tuple of what it takes: 64-bit numbers in tuples.

    Raises:
        ValueError: it was compiled for something else.
    """
    import jax
    import jax.numpy as jnp

    shapes = [leaf.shape for leaf in _leaves(arguments)]
    step = compiled.runtime_executable()
    if step.client.platform != "cpu":
        raise ValueError(f"compiled: must be for cpu, is for {step.client.platform}")
    with jax.enable_x64(True), jax.default_device(step.local_devices()[0]):
        blanks = jax.jit(lambda: [jnp.zeros(shape) for shape in shapes]).lower().compile()
    codes = [step.client.serialize_executable(part) for part in (blanks.runtime_executable(), step)]
    return len(codes[0]).to_bytes(_LENGTH_BYTES, "little") + b"".join(codes)


def from_bare_form(code: bytes, arguments: Any, returned: Any) -> Callable[..., Any]:
    """The function that `bare_form` made bytes of, from NumPy's arrays to NumPy's arrays.

    Args:
        code: those bytes.
        arguments: a tuple of what the function takes: tuples of arrays.
        returned: the like of what it returns.

    Raises:
        UnknownReleaseError: this jaxlib was not tried.
        Exception: whatever jaxlib raises where it is not as it was.
    """
    # Else jaxlib writes what it does to stderr; jax sets the same.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "1")
    from jaxlib import xla_client
    from jaxlib.version import __version__ as release

    if not release.startswith(KNOWN_RELEASES):
        raise UnknownReleaseError(release)
    _register_lapack()
    client = xla_client.make_cpu_client(asynchronous=False)
    device = client.devices()[0]
    length, devices = int.from_bytes(code[:_LENGTH_BYTES], "little"), xla_client.DeviceList((device,))
    parts = code[_LENGTH_BYTES : _LENGTH_BYTES + length], code[_LENGTH_BYTES + length :]
    blanks, run = (client.deserialize_executable(part, executable_devices=devices) for part in parts)
    take_in, hand_out = _handlers(arguments, device), _handlers(returned, device)

    # jaxlib's own ways to take numbers in fix tables that jax, if it is imported later, wants to fill first.
    # So a second program hands out fresh buffers of the right shapes, and the numbers are put there.
    def call(*given: Any) -> Any:
        buffers = blanks.execute_sharded([]).consume_with_handlers(take_in)
        for buffer, values in zip(buffers, _leaves(given), strict=True):
            _put(np.asarray(values, np.float64), buffer)
        done = run.execute_sharded(buffers).consume_with_handlers(hand_out)
        return _like(returned, (np.asarray(memoryview(buffer)) for buffer in done))

    return call


def _handlers(arrays: Any, device: Any) -> list[Any]:
    """What makes arrays of jaxlib's results."""
    from jaxlib.xla_client import SingleDeviceSharding, array_result_handler

    there = SingleDeviceSharding(device)
    shapes = [_Shape(leaf.shape, np.dtype(np.float64)) for leaf in _leaves(arrays)]
    return [array_result_handler(shape, there, committed=True, _skip_checks=True) for shape in shapes]


def _put(values: np.ndarray, buffer: Any) -> None:
    place = np.asarray(memoryview(buffer))
    if (place.shape, place.dtype) != (values.shape, values.dtype):
        raise ValueError(f"values: must be {place.dtype} of shape {place.shape}, got {values.shape}")
    values = np.ascontiguousarray(values)
    # The view is read-only, because nobody but us could know that the buffer is not in use.
    ctypes.memmove(place.__array_interface__["data"][0], values.__array_interface__["data"][0], values.nbytes)


def _register_lapack() -> None:
    """Tell XLA of LAPACK's functions, and jaxlib where LAPACK is: without, such code runs into nothing."""
    from jaxlib import lapack, xla_client

    for platform, targets in lapack.registrations().items():
        for name, function, version in targets:
            xla_client.register_custom_call_target(name, function, platform=platform, api_version=version)
    lapack.prepare_lapack_call("potrf_ffi", np.dtype(np.float64))


def _leaves(tree: Any) -> Iterator[Any]:
    """The arrays in tuples of tuples, in jax's order."""
    if isinstance(tree, tuple):
        for part in tree:
            yield from _leaves(part)
    else:
        yield tree


def _like(tree: Any, leaves: Iterator[Any]) -> Any:
    """The arrays in tuples as those of `tree` are."""
    if not isinstance(tree, tuple):
        return next(leaves)
    parts = [_like(part, leaves) for part in tree]
    return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
