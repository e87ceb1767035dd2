"""Make the pictures of README.md from the demo photo: before, and after `autoreg align --render`.

Run it with autoreg installed: `python docs/make_images.py`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2

from autoreg.job import Listener, demo_job, run_job

WIDTH = 1200
GAP = 12


def main() -> None:
    """Write docs/images/before-after.jpg and docs/images/overlay.jpg."""
    images = Path(__file__).resolve().parent / "images"
    images.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        job = demo_job(Path(name), "auto")
        outcome = run_job(job, Listener(note=print, doing=print))
        failure = outcome.refusal or outcome.render_error
        if failure is not None:
            raise SystemExit(f"the demo failed: {failure}")
        before, after, overlay = (
            cv2.imread(str(path))
            for path in (job.photo, Path(name) / "composite.png", Path(name) / "overlay.png")
        )
    half = (WIDTH - GAP) // 2
    height = round(half * before.shape[0] / before.shape[1])
    pair = [cv2.resize(picture, (half, height), interpolation=cv2.INTER_AREA) for picture in (before, after)]
    gap = cv2.copyMakeBorder(pair[0], 0, 0, 0, GAP, cv2.BORDER_CONSTANT, value=(255, 255, 255))
    quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
    cv2.imwrite(str(images / "before-after.jpg"), cv2.hconcat([gap, pair[1]]), quality)
    cv2.imwrite(str(images / "overlay.jpg"), overlay, quality)


if __name__ == "__main__":
    main()
