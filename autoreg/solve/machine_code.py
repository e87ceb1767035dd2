"""Machine code of compiled functions, kept in a folder for later processes.

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

_DIGEST = hashlib.sha256().digest_size


def read_code(path: Path) -> bytes | None:
    """What a file holds; None if there is none, or none that can be trusted.

    Machine code is run unseen: only a file that the user owns, and that nobody else may write, is read.
    """
    with suppress(OSError):
        told = path.stat()
        if hasattr(os, "getuid") and (told.st_uid != os.getuid() or told.st_mode & 0o022):
            return None
        content = path.read_bytes()
        digest, code = content[:_DIGEST], content[_DIGEST:]
        if hashlib.sha256(code).digest() == digest:
            return code
    return None


def keep_code(path: Path, code: bytes) -> None:
    """Leave machine code in a file; where that cannot be done, nothing is left."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    with suppress(OSError):
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        part.write_bytes(hashlib.sha256(code).digest() + code)
        part.chmod(0o600)
        part.replace(path)


def fingerprint(*sources: Path, packages: tuple[str, ...]) -> str:
    """All that machine code for the processor depends on, in a few letters; no package is imported for it.

    Args:
        sources: the files of the functions that were compiled.
        packages: those that compiled them, and those that they call.
    """
    about = [f"{name} {version(name)}" for name in packages]
    about += [platform.python_version(), platform.system(), platform.machine(), _instructions()]
    # jax and XLA are configured by these; a program that does it in other ways must not share the folder.
    about += [f"{k}={v}" for k, v in sorted(os.environ.items()) if k.startswith(("JAX_", "XLA_"))]
    parts = [*(text.encode() for text in about), *(file.read_bytes() for file in sources)]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:24]


def _instructions() -> str:
    """The processor's instruction set where the system tells it, else the processor's name."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        return next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return platform.processor()
