"""Processes that are timed: seconds on the clock and peak memory of each, told by the system."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Ran:
    """How a process went."""

    seconds: float
    processor_s: float
    peak_gb: float
    code: int
    said: str

    def answer(self) -> dict[str, Any]:
        """The JSON of its last line.

        Raises:
            RuntimeError: it failed.
        """
        if self.code:
            raise RuntimeError(f"a timed program ended with {self.code}: {self.said[-800:]}")
        return json.loads(self.said.strip().splitlines()[-1])


# Starts the program, waits for it, and writes what the system says of it into a file. A program started from
# here directly would have this process's own memory as its peak: the system counts from the fork on.
_LAUNCHER = """
import json, os, subprocess, sys, time
began = time.perf_counter()
process = subprocess.Popen([sys.executable, *sys.argv[2:]])
_, status, usage = os.wait4(process.pid, 0)
took = time.perf_counter() - began
told = [took, usage.ru_utime + usage.ru_stime, usage.ru_maxrss, os.waitstatus_to_exitcode(status)]
with open(sys.argv[1], "w") as file:
    json.dump(told, file)
"""


def run_timed(words: Sequence[str], environment: Mapping[str, str] | None = None) -> Ran:
    """Run Python with these words from the project's root.

    It keeps its modules' bytecode, as installed ones come with theirs, whatever the environment says of that.
    """
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore", **(environment or {})}
    env.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder, "told.json")
        done = subprocess.run(
            [sys.executable, "-S", "-E", "-c", _LAUNCHER, str(told), *words],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env,
            cwd=ROOT,
            check=False,
        )
        if not told.exists():
            raise RuntimeError(f"a timed program could not be run: {done.stdout[-800:]}")
        took, spent, peak, code = json.loads(told.read_text())
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return Ran(took, spent, peak * unit / 1e9, code, done.stdout)
