"""Processes that are timed: seconds on the clock and peak memory of each, told by the system."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
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


def run_timed(words: Sequence[str], environment: Mapping[str, str] | None = None) -> Ran:
    """Run Python with these words from the project's root."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore", **(environment or {})}
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=env,
        cwd=ROOT,
    )
    assert process.stdout is not None
    said = process.stdout.read()
    # wait4 tells this child's own peak; getrusage would tell the largest of all children.
    _, status, usage = os.wait4(process.pid, 0)
    took = time.perf_counter() - began
    process.stdout.close()
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    spent = usage.ru_utime + usage.ru_stime
    return Ran(took, spent, usage.ru_maxrss * unit / 1e9, process.returncode, said)
