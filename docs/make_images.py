"""Make the pictures of README.md and docs/ from the demo photo.

Run it with autoreg and POV-Ray installed: `python docs/make_images.py`.
"""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import cv2

from autoreg.jobs.job import Listener, demo_job, run_job
from autoreg.jobs.render_job import RenderJob, Wish, run_render
from autoreg.rendering.render import EngineName

WIDTH = 1200
GAP = 12
QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 88]


def main() -> None:
    """Write before-after, before, overlay, and the composites by both engines to docs/images."""
    docs = Path(__file__).resolve().parent
    images = docs / "images"
    images.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        job = demo_job(Path(name), None)
        outcome = run_job(job, Listener(note=print, doing=print))
        if outcome.refusal is not None:
            raise SystemExit(f"the demo failed: {outcome.refusal}")
        shutil.copyfile(job.photo, images / "before.jpg")
        copy(Path(name) / "overlay.png", images / "overlay.jpg")
        for engine in ("preview", "povray"):
            draw(engine, docs / "scene.toml", Path(name))
            copy(Path(name) / "composite.png", images / f"composite-{engine}.jpg")
        before, after = (cv2.imread(str(path)) for path in (job.photo, Path(name) / "composite.png"))
    half = (WIDTH - GAP) // 2
    height = round(half * before.shape[0] / before.shape[1])
    pair = [cv2.resize(picture, (half, height), interpolation=cv2.INTER_AREA) for picture in (before, after)]
    gap = cv2.copyMakeBorder(pair[0], 0, 0, 0, GAP, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    cv2.imwrite(str(images / "before-after.jpg"), cv2.hconcat([gap, pair[1]]), QUALITY)


def draw(engine: EngineName, scene: Path, folder: Path) -> None:
    """Render a scene in the folder of an alignment."""
    job = RenderJob(folder / "alignment.json", Wish(scene=scene), engine)
    outcome = run_render(job, print, lambda part: None, print)
    if outcome.error is not None:
        raise SystemExit(f"the render failed: {outcome.error}")


def copy(source: Path, target: Path) -> None:
    """A picture as JPEG."""
    cv2.imwrite(str(target), cv2.imread(str(source)), QUALITY)


if __name__ == "__main__":
    main()
