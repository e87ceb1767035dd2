"""Ray-traced scenes with exact truth: what becomes of each, how near it comes, and whether it knows that."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from autoreg.align import align_seen
from autoreg.alignment import Alignment, Pose
from autoreg.camera import Camera
from autoreg.camera_files import read_camera
from autoreg.errors import Refusal
from autoreg.geometry import Rigid, angle_between_rotations
from autoreg.ground.ground_frame import turned, with_origin
from autoreg.ground.sight import see
from autoreg.image import load_photo
from autoreg.synthetic import SyntheticScene
from benchmarks.last_stage import crossings_error_px, crossings_of, pose_error
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.result import Result, Table
from benchmarks.suites.robust import TURN_DEG, angle_up_to_quarter_turns, within
from benchmarks.suites.truth import covered

Became = Literal["right", "rows only", "refused", "told", "wrong"]
# Without a camera, what counts as right: degrees, and share of the height.
UNTOLD_TURN_DEG, UNTOLD_HEIGHT = 3.0, 0.1
QUICK_SCENES = 2


@dataclass(frozen=True)
class Outcome:
    """What became of one scene; errors and their normalised squares where a told camera led to a lattice."""

    name: str
    kind: str
    paved: bool
    became: Became
    turn_deg: float = np.nan
    crossings_px: float = np.nan
    height: float = np.nan
    rotation: float = np.nan
    pose: float = np.nan


def run(options: Options) -> Result:
    """Every scene of the folder."""
    truths = sorted(options.scenes.rglob("*.truth.json"))
    if not truths:
        return Result(
            "scenes",
            skipped=f"{options.scenes} has no scenes (--scenes DIR; benchmarks/scenes.py makes them)",
            absent=options.is_absent("scenes"),
        )
    found = [examine(path) for path in (truths[:QUICK_SCENES] if options.quick else truths)]
    paved = sum(o.paved for o in found)
    return Result(
        "scenes",
        about=(
            f"{paved} ray-traced pavings and {len(found) - paved} other grounds, as `benchmarks/scenes.py` "
            "makes them, through the whole `align`. Right is within 0.5°, 2 % of a side at the crossings and "
            f"2 % of the height, up to the lattice's symmetry (without a camera {UNTOLD_TURN_DEG:g}° and "
            f"{100 * UNTOLD_HEIGHT:g} % of the height), and a wrong camera that is called wrong. Errors are "
            "normalised by the stated covariance; the medians should be 2.4 (rotation) and 5.3 (pose)."
        ),
        figures=_figures(found),
        tables=(_table(found),),
        notes=_notes(found),
    )


def _figures(found: list[Outcome]) -> tuple[Figure, ...]:
    """Of whatever kinds of scene there are."""

    def share(some: list[Outcome], became: Became) -> float:
        return 100.0 * sum(o.became == became for o in some) / len(some)

    paved, bare = ([o for o in found if o.paved == kind] for kind in (True, False))
    near = [o for o in paved if np.isfinite(o.pose)]
    figures = [Figure("scenes.right", share(paved, "right"))] if paved else []
    figures.append(Figure("scenes.wrong", share(found, "wrong")))
    figures += [Figure("scenes.refused", share(bare, "refused"))] if bare else []
    if near:
        figures += [
            Figure("scenes.turn", float(np.median([o.turn_deg for o in near]))),
            Figure("scenes.crossings", float(np.median([o.crossings_px for o in near]))),
            Figure("scenes.pose", covered([o.pose for o in near], 6)),
            Figure("scenes.rotation", covered([o.rotation for o in near], 3)),
        ]
    return tuple(figures)


def examine(path: Path) -> Outcome:
    """What `align` makes of the scene with this truth."""
    truth, stem = json.loads(path.read_text()), path.name.removesuffix(".truth.json")
    name, kind = str(truth["name"]), str(truth.get("kind", stem.rpartition("-")[0] or stem))
    paved = bool(truth["lattice"])
    told = read_camera(path.with_name(f"{stem}.camera.json")) if truth["tell_camera"] else None
    slab = tuple(truth["slab"]) if truth["tell_slab"] else None
    try:
        photo = load_photo(path.with_name(f"{stem}.jpg"))
        found = align_seen(see(photo.gray), told, slab=slab, colour=photo.colour)
    except Refusal:
        return Outcome(name, kind, paved, "right" if paved and truth["wrong_k"] else "refused")
    if not paved:
        return Outcome(name, kind, paved, "wrong")
    if truth["wrong_k"]:
        return Outcome(name, kind, paved, "right" if found.camera.consistent is False else "wrong")
    if found.lattice.spacing_x is None:
        right = truth.get("lattice_kind") == "rows" and _turn_deg(found, truth) < TURN_DEG
        return Outcome(name, kind, paved, "right" if right else "rows only")
    found = in_metres(found, truth)
    scene = seen_from(found, truth)
    true, pose = scene.cam_from_ground, found.pose.cam_from_ground
    turn = float(np.rad2deg(angle_between_rotations(pose.R, true.R)))
    height = abs(float(pose.origin_in_a[2] / true.origin_in_a[2]) - 1)
    if told is None:
        right = turn < UNTOLD_TURN_DEG and height < UNTOLD_HEIGHT
        return Outcome(name, kind, paved, "right" if right else "wrong")
    error, C = pose_error(pose, true), found.pose.covariance
    return Outcome(
        name,
        kind,
        paved,
        "right" if within(found, scene) else "told" if found.camera.consistent is False else "wrong",
        turn,
        crossings_error_px(pose, scene, crossings_of(scene, heights=4.0)),
        height,
        rotation=_normalised(error[:3], C[:3, :3]),
        pose=_normalised(error, C),
    )


def _turn_deg(found: Alignment, truth: dict[str, Any]) -> float:
    true = Rigid(np.array(truth["R"]), np.array(truth["t"]))
    return angle_up_to_quarter_turns(found.pose.cam_from_ground, true)


def in_metres(found: Alignment, truth: dict[str, Any]) -> Alignment:
    """The alignment in units in which a slab's area is the true one."""
    lattice, pose = found.lattice, found.pose
    assert lattice.spacing_x is not None
    k = float(np.sqrt(np.prod(truth["slab"]) / (lattice.spacing_x * lattice.spacing_y)))
    units = np.diag([1.0, 1.0, 1.0, k, k, k])
    rigid = pose.cam_from_ground
    return replace(
        found,
        pose=Pose(Rigid(rigid.R, k * rigid.t), units @ pose.covariance @ units),
        lattice=replace(lattice, spacing_x=k * lattice.spacing_x, spacing_y=k * lattice.spacing_y),
    )


def seen_from(found: Alignment, truth: dict[str, Any]) -> SyntheticScene:
    """The true scene in that equivalent ground frame which is nearest to the found one."""
    (width, height), K = truth["size"], np.array(truth["K"])
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    camera = Camera(width, height, fx, fy, cx, cy, tuple(truth["dist"]))
    true = Rigid(np.array(truth["R"]), np.array(truth["t"]))
    pose = found.pose.cam_from_ground
    quarters = min(range(4), key=lambda q: angle_between_rotations(pose.R, turned(true, q).R))
    own = turned(true, quarters)
    a, b = truth["slab"] if quarters % 2 == 0 else truth["slab"][::-1]
    shift = float(truth["bond"])
    x, y, _ = own.R.T @ (pose.t - own.t)
    row = round(float(y / b))
    # The rows of a frame turned by half lie on the other side of their lines: they are one shift further.
    moved = (row + (quarters == 2)) * shift
    nearest = with_origin(own, (round(float(x / a) - moved) + moved) * a, row * b)
    return SyntheticScene(camera=camera, cam_from_ground=nearest, spacing_m=(a, b), shift=shift, colour=False)


def _normalised(error: Float[np.ndarray, " k"], covariance: Float[np.ndarray, "k k"]) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def _table(found: list[Outcome]) -> Table:
    rows: list[tuple[str, ...]] = []
    for kind in dict.fromkeys(o.kind for o in found):
        own = [o for o in found if o.kind == kind]
        near = [o for o in own if np.isfinite(o.pose)]
        numbers = [np.median([getattr(o, key) for o in near]) if near else np.nan for key in SHOWN]
        counts = Counter(o.became for o in own)
        became = ", ".join(f"{count} {what}" for what, count in counts.items())
        rows.append((kind, became, *("" if np.isnan(v) else f"{v:.2g}" for v in numbers)))
    head = ("kind", "became", "turn °", "crossings px", "height", "normalised rotation", "normalised pose")
    return Table("What became of the scenes, and medians", head, tuple(rows))


SHOWN = ("turn_deg", "crossings_px", "height", "rotation", "pose")


def _notes(found: list[Outcome]) -> tuple[str, ...]:
    odd = [f"{o.name} ({o.became})" for o in found if o.became != ("right" if o.paved else "refused")]
    far = sorted(
        (o for o in found if covered([o.pose], 6) == 0 and np.isfinite(o.pose)), key=lambda o: -o.pose
    )
    notes = [f"Not right: {', '.join(odd)}."] if odd else []
    if far:
        names = ", ".join(f"{o.name} ({o.pose:.0f})" for o in far)
        notes.append(
            f"Truth outside the stated 95 % region of the pose (normalised square above 12.6): {names}."
        )
    return tuple(notes)
