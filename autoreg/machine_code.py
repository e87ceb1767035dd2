"""Functions that jax compiled, kept in a folder for later processes as machine code.

jax's own cache of compilations wants a function traced and lowered before it is found there, which takes
longer than everything else about it.
"""

from __future__ import annotations

import hashlib
import os
import platform
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

_DIGEST = hashlib.sha256().digest_size


def fetch_code(path: Path, arguments: Any, returned: Any) -> Any | None:
    """The compiled function that a file holds; None if there is none, or none that can be trusted.

    Machine code is run unseen: only a file that the user owns, and that nobody else may write, is read.

    Args:
        path: the file.
        arguments: a tuple of what the function takes, for its structure.
        returned: the structure of what it returns.
    """
    # Whatever is wrong with what was kept, the function can be compiled.
    with suppress(Exception):
        told = path.stat()
        if hasattr(os, "getuid") and (told.st_uid != os.getuid() or told.st_mode & 0o022):
            return None
        content = path.read_bytes()
        digest, code = content[:_DIGEST], content[_DIGEST:]
        if hashlib.sha256(code).digest() != digest:
            return None
        given, returned = jax.tree.structure((arguments, {})), jax.tree.structure(returned)
        _look_up_lapack()
        return serialize_executable.deserialize_and_load(code, given, returned)
    return None


def _look_up_lapack() -> None:
    """Tell jaxlib where LAPACK is, which jax does when it lowers an operation that needs it."""
    try:
        from jaxlib.lapack import prepare_lapack_call

        prepare_lapack_call("potrf_ffi", np.dtype(np.float64))
    except (ImportError, AttributeError, TypeError):
        # A longer way to the same, in which nothing has a name that a later jaxlib may drop.
        jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float64))


def keep_code(path: Path, compiled: Any) -> None:
    """Leave a compiled function in a file; where that cannot be done, nothing is left."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    with suppress(OSError, ValueError):
        code = serialize_executable.serialize(compiled)[0]
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        part.write_bytes(hashlib.sha256(code).digest() + code)
        part.chmod(0o600)
        part.replace(path)


def fingerprint(*sources: str, packages: tuple[str, ...] = ()) -> str:
    """All that machine code depends on, in a few letters.

    Args:
        sources: the files of the functions that were compiled.
        packages: beside jax, those that they call.
    """
    device = jax.devices()[0]
    about = [f"{name} {version(name)}" for name in ("jax", "jaxlib", *packages)]
    about += [platform.python_version(), platform.system(), platform.machine(), _instructions()]
    about += [device.platform, device.device_kind, str(jax.device_count())]
    about += [f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(("JAX_", "XLA_"))]
    parts = [*(text.encode() for text in about), *(Path(file).read_bytes() for file in sources)]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:24]


def _instructions() -> str:
    """The processor's instruction set where the system tells it, else the processor's name."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        return next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return platform.processor()
