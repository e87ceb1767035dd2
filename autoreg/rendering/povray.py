"""Runs POV-Ray: the only module that starts another program."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO

from autoreg.errors import RenderError

Progress = Callable[[float], None]

# POV-Ray names its progress like this, after a carriage return.
_RENDERED = re.compile(rb"Rendered (\d+) of (\d+) pixels")
_COMPLAINT = re.compile(r"File '(?P<file>[^']*)' line (?P<line>\d+): (?P<words>.*)")
_POLL_S = 0.05


def find_povray() -> str | None:
    """The POV-Ray program, or None if it is not installed."""
    return shutil.which("povray")


def povray_version(program: str) -> str:
    """What the program calls itself, such as "3.7.0.10.unofficial"."""
    # It has no option that prints the version alone, and answers this one on stderr.
    done = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=30, check=False)
    lines = (done.stdout + done.stderr).splitlines()
    return next((line.split()[1] for line in lines if line.startswith("POV-Ray ")), "unknown")


def run_povray(
    program: str, options: list[str], folder: Path, *, timeout_s: float, progress: Progress | None = None
) -> None:
    """Run POV-Ray in a folder, until it is done.

    Whatever ends the wait, an interrupt too, ends POV-Ray first.

    Args:
        program: the POV-Ray program.
        options: its options; files by names relative to the folder, as its restrictions on files want it.
        folder: where it works.
        timeout_s: it is stopped after this time.
        progress: told the part that is done, 0 to 1.

    Raises:
        RenderError: it cannot be started, took too long, or failed; then with its words and the scene's line.
    """
    try:
        process = subprocess.Popen(
            [program, *options],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            # Ctrl-C goes to this process alone, which then stops POV-Ray itself.
            start_new_session=True,
        )
    except OSError as error:
        raise RenderError(f"POV-Ray could not be started: {error}") from error
    said = bytearray()
    assert process.stderr is not None
    listener = threading.Thread(target=_listen, args=(process.stderr, said, progress), daemon=True)
    try:
        listener.start()
        begun = time.monotonic()
        while process.poll() is None:
            if time.monotonic() - begun > timeout_s:
                raise RenderError(
                    f"POV-Ray took more than {timeout_s:g} s and was stopped; give it longer with --timeout, "
                    "or take --engine preview"
                )
            time.sleep(_POLL_S)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        listener.join(timeout=5)
        process.stderr.close()
    if process.returncode != 0:
        words = _explained(said.decode("utf-8", "replace"), folder)
        raise RenderError(f"POV-Ray ended with code {process.returncode}: {words}")


def threads() -> int:
    """Processor cores that may be used."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0)) or 1
    return os.cpu_count() or 1


def _listen(stream: IO[bytes], said: bytearray, progress: Progress | None) -> None:
    """Keep the end of what POV-Ray says, and pass its progress on."""
    while chunk := stream.read1(4096):  # pyright: ignore[reportAttributeAccessIssue]  # a BufferedReader
        said += chunk
        del said[:-65536]
        if progress is not None and (found := _RENDERED.findall(said[-4096:])):
            done, whole = (int(number) for number in found[-1])
            progress(done / max(whole, 1))


def _explained(said: str, folder: Path) -> str:
    """What went wrong in POV-Ray's own words, with the line of the scene that it names."""
    # It breaks its lines at 80 characters and indents what follows.
    lines = re.sub(r"\n (?=\S)", " ", said.replace("\r", "\n")).splitlines()
    for line in lines:
        found = _COMPLAINT.search(line)
        if found is None or "rror" not in found["words"]:
            continue
        where, number = folder / found["file"], int(found["line"])
        words = f"{found['file']} line {number}: {found['words'].strip()}"
        if where.is_file():
            text = where.read_text("utf-8", "replace").splitlines()
            if 0 < number <= len(text):
                words += f"\n  {number} | {text[number - 1].strip()}"
        return words
    telling = [line.strip() for line in lines if "rror" in line or "annot" in line][-4:]
    return " ".join(telling) or "it said nothing"
