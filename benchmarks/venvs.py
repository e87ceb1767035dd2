"""Environments of their own for peers whose requirements contradict autoreg's."""

from __future__ import annotations

import subprocess
import sys
import venv
from pathlib import Path


def environment(folder: Path, requirements: tuple[str, ...]) -> Path | str:
    """The Python of an environment with these packages, made if missing; else why there is none."""
    python, done = folder / "bin" / "python", folder / "installed.txt"
    wanted = "\n".join(requirements)
    if done.is_file() and done.read_text() == wanted:
        return python
    print(f"  making an environment for {', '.join(requirements)} ...", file=sys.stderr, flush=True)
    try:
        venv.create(folder, with_pip=True, clear=True)
        subprocess.run(
            [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *requirements],
            check=True,
            capture_output=True,
            text=True,
            timeout=600,
        )
    except subprocess.CalledProcessError as error:
        last = (error.stderr or "").strip().splitlines()
        return f"pip could not install it: {last[-1] if last else error}"
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"no environment could be made: {error}"
    done.write_text(wanted)
    return python
