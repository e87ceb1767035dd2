"""Many runs in one call, side by side in processes of their own."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from autoreg.errors import AutoregError, InputError
from autoreg.jobs.job import Job, Listener, Outcome, run_job


@dataclass(frozen=True)
class Run:
    """How one job ended: `outcome`, or the `error` for which its photo, camera or folder could not be used.

    `notes` are what a person has to read.
    """

    job: Job
    outcome: Outcome | None
    error: AutoregError | None
    notes: tuple[str, ...]


def run_jobs(jobs: Sequence[Job], *, processes: int | None = None) -> Iterator[Run]:
    """The jobs' runs, in the order of the jobs, each as soon as it and those before it have ended.

    Every run is what the command does with its photo, and so are the files that it leaves. To start a process
    takes a second or two, once; each takes the memory of one command. They are started anew, so a program
    that calls this keeps what it does itself behind `if __name__ == "__main__":`.

    Args:
        jobs: what to do, each in a folder of its own.
        processes: how many run side by side; by default as many as there are processors.

    Raises:
        InputError: two jobs have one folder, one is no Job, or there is no process to run them; nothing was
            written.
        AutoregError: a process has ended by itself, for lack of memory perhaps. Runs that had ended by then
            have left whole folders.
    """
    count = os.cpu_count() or 1 if processes is None else processes
    if count < 1:
        raise InputError(f"processes: at least one has to run the jobs, got {count}")
    seen: set[Path] = set()
    for job in jobs:
        if not isinstance(job, Job):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise InputError(f"jobs must be of type Job, got {job!r}")
        # What is no folder ends its own job, and no other.
        if not isinstance(job.folder, Path):  # pyright: ignore[reportUnnecessaryIsInstance]
            continue
        folder = job.folder.resolve()
        if folder in seen:
            raise InputError(f"two jobs would write into {folder}; give each a folder of its own")
        seen.add(folder)
    return _runs(jobs, min(count, len(jobs)))


def _runs(jobs: Sequence[Job], count: int) -> Iterator[Run]:
    if not jobs:
        return
    # Forked processes would inherit the locks of jax's threads, but not the threads.
    pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _left_to_the_caller)
    try:
        yield from pool.map(_run, jobs)
    except BrokenProcessPool as broken:
        raise AutoregError(
            f"one of {count} processes has ended by itself, perhaps for lack of memory; give fewer processes"
        ) from broken
    finally:
        pool.shutdown(cancel_futures=True)


def _left_to_the_caller() -> None:
    # Ctrl-C reaches all processes of a terminal: the caller says what becomes of the others.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(job: Job) -> Run:
    notes: list[str] = []
    try:
        outcome = run_job(job, Listener(note=notes.append, doing=lambda text: None))
    except AutoregError as error:
        return Run(job, None, error, tuple(notes))
    except (ValueError, OSError) as error:
        # What the command finds wrong with its options before it runs, or a disk that is full.
        return Run(job, None, InputError(str(error)), tuple(notes))
    except Exception as error:
        # Whatever it is, the other photos are not to be lost by it.
        said = f"{job.photo} ended with {type(error).__name__}: {error}; run it by itself to see where"
        return Run(job, None, AutoregError(said), tuple(notes))
    return Run(job, outcome, None, tuple(notes))
