"""Vanishing points by lu-vp-detect, as a program of its own: it wants another OpenCV than autoreg.

Reads a JSON list of {"file", "focal_px", "centre_px"} on stdin; writes one of {"dirs", "seconds", "error"},
whose directions are the rows' unit vectors in camera axes x right, y down, z forward. Where it fails, "dirs"
is null and "error" says by what: whoever reads counts these. What cannot be imported ends the program.
"""

from __future__ import annotations

import json
import sys
import time


def main() -> None:
    import cv2
    from lu_vp_detect import VPDetection  # pyright: ignore[reportMissingImports]

    answers: list[dict[str, object]] = []
    for entry in json.load(sys.stdin):
        picture = cv2.imread(entry["file"])
        if picture is None:
            raise SystemExit(f"{entry['file']}: cannot be read")
        began = time.process_time()
        # Its own default for the shortest segment; a fixed seed, since it draws hypotheses.
        finder = VPDetection(30, entry["centre_px"], entry["focal_px"], 1)
        dirs, why = None, None
        try:
            dirs = finder.find_vps(picture).tolist()
        except ImportError:
            raise
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
        answers.append({"dirs": dirs, "seconds": time.process_time() - began, "error": why})
    json.dump(answers, sys.stdout)


if __name__ == "__main__":
    main()
