"""Ray-trace a random mixture of paving scenes with exact truth.

Each scene is NAME.jpg, NAME.camera.json (what the user is told) and NAME.truth.json (what is so). Scenes of
random ashlar ("rows") have no period along X; they go to OUT/rows.

    python benchmarks/scenes.py OUT --count 60 --seed 2 [--kinds easy rect bond-half]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

# The script runs from a checkout, whether or not autoreg is installed.
sys.path[:0] = [str(Path(__file__).parents[1])]

from benchmarks.raytrace.files import write  # noqa: E402
from benchmarks.raytrace.kinds import KINDS, draw  # noqa: E402
from benchmarks.raytrace.scene import Scene  # noqa: E402

# Alignable scenes are most of the mixture; the kinds that take minutes or that ask for refusal are rarer.
WEIGHTS = {"large": 0.4} | {kind: 0.5 for kind in KINDS if kind.startswith("refuse-")}


def mixture(count: int, seed: int, kinds: list[str]) -> list[Scene]:
    """The scenes of a mixture: each kind once in turn, then kinds drawn by their weight."""
    rng = np.random.default_rng(seed)
    weights = np.array([WEIGHTS.get(kind, 1.0) for kind in kinds])
    extra = [str(k) for k in rng.choice(kinds, max(0, count - len(kinds)), p=weights / weights.sum())]
    taken: dict[str, int] = {}
    scenes: list[Scene] = []
    for kind in [*kinds, *extra][:count]:
        number = taken.get(kind, 0)
        taken[kind] = number + 1
        scenes.append(draw(kind, number, seed))
    return scenes


def main() -> int:
    """Write the scenes that the command line asks for; scenes already there are kept."""
    parser = argparse.ArgumentParser(description="Ray-trace paving scenes with exact truth.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=len(KINDS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    for scene in mixture(options.count, options.seed, options.kinds):
        folder = options.out / "rows" if scene.paving.layout == "rows" else options.out
        if (folder / f"{scene.name}.truth.json").exists():
            continue
        started = time.monotonic()
        write(scene, folder)
        print(f"{scene.name}: {time.monotonic() - started:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
