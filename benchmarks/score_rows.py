"""Score `autoreg align` on ray-traced scenes of random ashlar, whose joints have a period along Y only.

A scene succeeds when the rotation is within 0.5°, the spacing and the camera's height within 2 %, and the
unbroken joints within 2 % of their spacing of the true ones where the picture's middle meets the ground.

    python benchmarks/score_rows.py SCENES/rows RESULTS [--cmd 'autoreg align']
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np


def compare(truth: dict, got: dict) -> dict[str, float]:
    """Differences between an alignment and the truth, modulo half turns."""
    R, t = np.array(truth["R"]), np.array(truth["t"])
    R_got, t_got = np.array(got["pose"]["R"]), np.array(got["pose"]["t"])
    scale = truth["slab"][1] / got["lattice"]["spacing"][1]
    if not truth["tell_slab"]:
        t_got = t_got * scale
    angles = []
    for sign in (1.0, -1.0):
        D = R_got @ np.diag([sign, sign, 1.0]) @ R.T
        skew = 0.5 * np.linalg.norm([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
        angles.append(np.rad2deg(np.arctan2(skew, 0.5 * (np.trace(D) - 1))))
    eye, eye_got = -R.T @ t, -R_got.T @ t_got
    # The true unbroken joint nearest to where the view meets the ground, seen in the estimated frame.
    b = truth["slab"][1]
    aim = eye - R[2] * eye[2] / R[2, 2]
    node = np.array([aim[0], b * np.round(aim[1] / b), 0.0])
    ray = R_got.T @ (R @ node + t)
    y_got = (eye_got - ray * eye_got[2] / ray[2])[1]
    miss = abs(y_got / b - np.round(y_got / b))
    return {
        "rot_deg": float(min(angles)),
        "height_pct": float(100 * abs(eye_got[2] / eye[2] - 1)),
        "row_miss_pct": float(100 * miss),
        "spacing_err_pct": float(100 * abs(1 / scale - 1)) if truth["tell_slab"] else 0.0,
    }


def main() -> int:
    """Run the command on every scene and print one line for each, then how many succeeded."""
    parser = argparse.ArgumentParser(description="Score alignments of random ashlar.")
    parser.add_argument("scenes", type=Path)
    parser.add_argument("results", type=Path)
    parser.add_argument("--cmd", default="autoreg align")
    options = parser.parse_args()
    good = total = 0
    for path in sorted(options.scenes.glob("*.truth.json")):
        truth = json.loads(path.read_text())
        photo, out = path.with_name(f"{truth['name']}.jpg"), options.results / truth["name"]
        command = [*shlex.split(options.cmd), str(photo), "-o", str(out)]
        if truth["tell_camera"]:
            command += ["--camera", str(path.with_name(f"{truth['name']}.camera.json"))]
        # The rows' height is the only slab size that such a field has.
        command += ["--slab", f"{truth['slab'][1]:.12g}"] if truth["tell_slab"] else []
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        report = out / "alignment.json"
        got: dict = json.loads(report.read_text()) if report.exists() else {"status": "none"}
        row: dict[str, object] = {
            "name": truth["name"],
            "code": done.returncode,
            "status": got["status"],
            "ok": False,
        }
        if got["status"] == "aligned":
            errors = compare(truth, got)
            within = [errors["height_pct"] < 2, errors["row_miss_pct"] < 2, errors["spacing_err_pct"] < 2]
            row |= {**errors, "kind": got["lattice"]["kind"], "ok": errors["rot_deg"] < 0.5 and all(within)}
        good, total = good + bool(row["ok"]), total + 1
        print(json.dumps(row), flush=True)
    print(json.dumps({"aligned": f"{good}/{total}"}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
