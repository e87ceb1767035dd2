"""Programs that the speed suite starts as processes of their own; each prints JSON on its last line.

python -m benchmarks.speed_child floor PHOTO            decode and one LSD pass, cv2 and jax imported
python -m benchmarks.speed_child align PHOTO CAMERA N   stages in process, N times
python -m benchmarks.speed_child many FOLDER OUT        every photo of a folder, as the command does it
python -m benchmarks.speed_child beside FOLDER OUT      the same by `run_jobs`, in two processes
python -m benchmarks.speed_child solver CACHE           what the solver's compilation takes
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

SLAB_M = (0.4, 0.4)
# Steps of `autoreg.align`, each with the module that calls it under this name.
STAGES = {
    "see": "autoreg.align",
    "find_paving": "autoreg.laying",
    "measured_slabs": "autoreg.laying",
    "_concluded": "autoreg.align",
}


def floor(photo: str) -> dict[str, Any]:
    """What no such program can do without."""
    import cv2

    # Whoever solves with jax imports it. The command does, until its solver is kept.
    __import__("jax")
    gray = cv2.imread(photo, cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    return {"segments": len(cv2.createLineSegmentDetector().detect(gray)[0])}


def align(photo: str, camera_file: str, repeats: str) -> dict[str, Any]:
    """Seconds of decoding with one LSD pass, of `align` and of its stages: the best of so many repeats."""
    import cv2

    from autoreg.camera_files import read_camera
    from autoreg.errors import Refusal
    from autoreg.segments import detect_segments

    pipeline: Any = import_module("autoreg.align")
    camera = read_camera(Path(camera_file))
    spent: dict[str, float] = defaultdict(float)
    for name, place in STAGES.items():
        module = import_module(place)
        setattr(module, name, _timed(getattr(module, name), name, spent))
    pipeline.warm_up()
    best: dict[str, float] = {}
    ended, joints, segments = "aligned", 0, 0
    for turn in range(int(repeats) + 1):
        began = time.perf_counter()
        gray = cv2.imread(photo, cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        decoded = time.perf_counter()
        cv2.createLineSegmentDetector().detect(gray)
        passed = time.perf_counter()
        spent.clear()
        try:
            joints = pipeline.align(gray, camera, slab=SLAB_M).residual.joints
        except Refusal as refusal:
            ended = f"refused: {refusal.code}"
        done = time.perf_counter()
        segments = segments or len(detect_segments(gray))
        times = {"decode": decoded - began, "lsd": passed - decoded, "align": done - passed, **spent}
        # The first turn warms up.
        if turn:
            best = {k: min(v, best.get(k, v)) for k, v in times.items()}
    return {"seconds": best, "ended": ended, "joints": joints, "segments": segments}


def _timed(call: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    def timed(*words: Any, **options: Any) -> Any:
        began = time.perf_counter()
        try:
            return call(*words, **options)
        finally:
            spent[name] += time.perf_counter() - began

    return timed


def many(folder: str, out: str) -> dict[str, Any]:
    """Every photo of a folder in this one process, two at a time."""
    from autoreg.jobs.job import Listener, run_job

    listener = Listener(note=lambda text: None, doing=lambda text: None)
    with ThreadPoolExecutor(2) as pool:
        outcomes = list(pool.map(lambda job: run_job(job, listener), _jobs(folder, out)))
    return {"photos": len(outcomes), "aligned": sum(o.alignment is not None for o in outcomes)}


def beside(folder: str, out: str) -> dict[str, Any]:
    """The same, in two processes."""
    from autoreg.jobs.many import run_jobs

    outcomes = [run.outcome for run in run_jobs(_jobs(folder, out), processes=2)]
    return {
        "photos": len(outcomes),
        "aligned": sum(o is not None and o.alignment is not None for o in outcomes),
    }


def _jobs(folder: str, out: str) -> list[Any]:
    from autoreg.jobs.job import Job

    photos = sorted(Path(folder).glob("*.jpg"))
    return [Job(p, Path(out) / p.stem, Path(folder) / "camera.json", slab=SLAB_M) for p in photos]


def solver(cache: str) -> dict[str, Any]:
    """Seconds until the solver's step is compiled, or fetched from the cache in that folder."""
    from autoreg.solve import solver as compiled

    began = time.perf_counter()
    compiled.warm_up(Path(cache))
    return {"seconds": time.perf_counter() - began}


def main() -> None:
    """Run one of the programs."""
    name, *words = sys.argv[1:]
    programs: dict[str, Callable[..., dict[str, Any]]] = {
        "floor": floor,
        "align": align,
        "many": many,
        "beside": beside,
        "solver": solver,
    }
    print(json.dumps(programs[name](*words)))


if __name__ == "__main__":
    main()
