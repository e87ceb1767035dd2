"""Real boards and floors whose pose is known by other means, through the whole `align`.

The pictures of a chessboard set are calibrated by OpenCV, and each board's pose is that of its corners:
nothing of it comes from autoreg. A floor's camera and homography are its publisher's. What is compared is the
rotation, up to the lattice's symmetry, and of a floor the direction of its normal: by the camera, the axes of
its homography are not square. A lattice of another scale may lie on the right ground, and so the height of
the camera is compared as well.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from autoreg.align import align
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.geometry import Rigid
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.result import Result, Table
from benchmarks.suites.robust import angle_up_to_quarter_turns

# Inner corners of the boards, along and across; their squares are the unit of length.
COLUMNS, ROWS = 9, 6
CORNERS = np.array([[i, j, 0.0] for j in range(ROWS) for i in range(COLUMNS)], np.float32)
# Corners are searched for within this share of the least distance of two of them, and of so many pixels.
WINDOW, WINDOW_PX = 0.35, (3, 11)
# What counts as right, in degrees, and as wrong where nothing is said against the camera; a height that is
# off by more than this share of the true one is wrong.
RIGHT_DEG, WRONG_DEG, RIGHT_HEIGHT = 0.3, 1.0, 0.02
# Fewer boards than this make no calibration.
FEWEST = 5
QUICK_VIEWS = 3


@dataclass(frozen=True)
class View:
    """A picture with its camera, its lattice, and its true pose; the ground's z axis points to the camera.

    `turn_known` is whether the directions of the lattice's joints are known, too.
    """

    group: str
    name: str
    gray: UInt8[np.ndarray, "h w"]
    camera: Camera
    slab: tuple[float, float]
    true: Rigid
    turn_known: bool = True


@dataclass(frozen=True)
class Outcome:
    """What became of a view: how far its pose is off, or why there is none, and what is said of K.

    `height_off` is a share of the camera's height above the board or the floor.
    """

    view: View
    turn_deg: float = np.nan
    height_off: float = np.nan
    reason: str = ""
    contradicted: bool = False

    @property
    def right(self) -> bool:
        """Whether there is a pose, and it is the true one."""
        return self.turn_deg <= RIGHT_DEG and self.height_off <= RIGHT_HEIGHT

    @property
    def wrong(self) -> bool:
        """Whether there is another pose, and nothing is said against the camera."""
        return (self.turn_deg > WRONG_DEG or self.height_off > RIGHT_HEIGHT) and not self.contradicted


def run(options: Options) -> Result:
    """Every board that OpenCV finds in whole, and every floor."""
    views = [*board_views(options.chessboards), *floor_views(options.groundgrid)]
    if not views:
        return Result(
            "boards",
            skipped=(
                f"neither {options.chessboards} has sets of boards nor {options.groundgrid} floors "
                "(--chessboards DIR, --groundgrid DIR)"
            ),
            absent=options.is_absent("chessboards") and options.is_absent("groundgrid"),
        )
    found = [examine(view) for view in (views[:QUICK_VIEWS] if options.quick else views)]
    aligned = [o for o in found if not o.reason]
    figures = [
        Figure("boards.right", 100.0 * sum(o.right for o in found) / len(found)),
        Figure("boards.wrong", sum(o.wrong for o in found)),
        Figure("boards.alarms", sum(o.contradicted for o in found)),
    ]
    if aligned:
        figures.append(Figure("boards.turn", float(np.median([o.turn_deg for o in aligned]))))
        figures.append(Figure("boards.height", 100.0 * max(o.height_off for o in aligned)))
    return Result(
        "boards",
        about=(
            "Photographed chessboards, their camera and poses by OpenCV from their corners, and floors whose "
            f"publisher tells both, through the whole `align`. Right is a rotation within {RIGHT_DEG:g}°, up "
            "to the lattice's symmetry, and of a floor its normal, and a height of the camera within "
            f"{RIGHT_HEIGHT:.0%}. All cameras are right, as far as a set's boards are flat."
        ),
        figures=tuple(figures),
        tables=(_table(found),),
        notes=_notes(found),
    )


def board_views(folder: Path) -> list[View]:
    """The boards of each subfolder, with the camera that OpenCV calibrates from them."""
    return [
        view
        for group in sorted(path for path in folder.glob("*") if path.is_dir())
        for view in _views_of_set(group)
    ]


def _views_of_set(group: Path) -> list[View]:
    """The boards of a folder whose pictures have the size that most have."""
    seen: list[tuple[str, np.ndarray, np.ndarray]] = []
    for file in sorted(group.glob("*.jpg")):
        gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        corners = None if gray is None else corners_of(gray)
        if gray is not None and corners is not None:
            seen.append((file.name, gray, corners))
    if not seen:
        return []
    size = Counter(gray.shape[::-1] for _, gray, _ in seen).most_common(1)[0][0]
    used = [view for view in seen if view[1].shape[::-1] == size]
    if len(used) < FEWEST:
        return []
    corners = [own for _, _, own in used]
    _, K, dist, _, _ = cv2.calibrateCamera([CORNERS] * len(used), corners, size, None, None)  # pyright: ignore
    camera = camera_of(size, K, dist)
    return [
        View(group.name, name, gray, camera, (1.0, 1.0), _board_pose(own, K, dist))
        for name, gray, own in used
    ]


def camera_of(size: Sequence[int], K: np.ndarray, dist: np.ndarray) -> Camera:
    """The camera of a size, a matrix and OpenCV's coefficients."""
    (width, height), (fx, fy, cx, cy) = size, (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(width, height, fx, fy, cx, cy, tuple(float(k) for k in dist.ravel()))


def corners_of(gray: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "n 2"] | None:
    """The inner corners of a board, row by row, to a part of a pixel; None where not all are found."""
    found, corners = cv2.findChessboardCornersSB(gray, (COLUMNS, ROWS), flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        found, corners = cv2.findChessboardCorners(gray, (COLUMNS, ROWS))
    if not found:
        return None
    # The places of findChessboardCornersSB are biased by up to 0.2 px; those of gradients are not.
    grid = corners.reshape(ROWS, COLUMNS, 2)
    least = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min()) for axis in (0, 1))
    half = int(np.clip(WINDOW * least, *WINDOW_PX))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    start = np.ascontiguousarray(corners.reshape(-1, 1, 2), np.float32)
    return cv2.cornerSubPix(gray, start, (half, half), (-1, -1), until).reshape(-1, 2)


def _board_pose(corners: np.ndarray, K: np.ndarray, dist: np.ndarray) -> Rigid:
    _, turn, t = cv2.solvePnP(CORNERS, corners, K, dist)
    turn, t = cv2.solvePnPRefineLM(CORNERS, corners, K, dist, turn, t)
    return towards_camera(cv2.Rodrigues(turn)[0], t.ravel())


def floor_views(folder: Path) -> list[View]:
    """The floors of a folder with `gt.json`: squares of 40 cm, lengths in centimetres."""
    truth = folder / "gt.json"
    if not truth.is_file():
        return []
    views: list[View] = []
    for name, entry in sorted(json.loads(truth.read_text())["views"].items()):
        gray = cv2.imread(str(folder / entry["image"]), cv2.IMREAD_GRAYSCALE)
        if gray is None:
            continue
        camera = camera_of(entry["size"], np.array(entry["K"]), np.array(entry["dist"]))
        pose = towards_camera(np.array(entry["R"]), 0.01 * np.array(entry["t_cm"]))
        views.append(View(folder.name, name, gray, camera, (0.4, 0.4), pose, turn_known=False))
    return views


def towards_camera(R: np.ndarray, t: np.ndarray) -> Rigid:
    """The pose with the plane's frame turned over, where its z axis points away from the camera."""
    pose = Rigid(R, t)
    return pose if pose.origin_in_a[2] > 0 else Rigid(R * [1.0, -1.0, -1.0], t)


def examine(view: View) -> Outcome:
    """What `align` makes of a view."""
    try:
        found = align(view.gray, view.camera, slab=view.slab)
    except Refusal as refusal:
        return Outcome(view, reason=refusal.code, contradicted=refusal.code == "camera_contradicted")
    pose, true = found.pose.cam_from_ground, view.true
    tilt = float(np.rad2deg(np.arccos(np.clip(pose.R[:, 2] @ true.R[:, 2], -1.0, 1.0))))
    turn = angle_up_to_quarter_turns(pose, true) if view.turn_known else tilt
    height_off = abs(float(pose.origin_in_a[2] / true.origin_in_a[2]) - 1.0)
    return Outcome(view, turn, height_off, contradicted=found.camera.consistent is False)


def _table(found: list[Outcome]) -> Table:
    rows: list[tuple[str, ...]] = []
    for group in dict.fromkeys(o.view.group for o in found):
        own = [o for o in found if o.view.group == group]
        aligned = [o for o in own if not o.reason]
        turns, heights = [o.turn_deg for o in aligned], [o.height_off for o in aligned]
        rows.append(
            (
                group,
                str(len(own)),
                str(len(turns)),
                str(sum(o.right for o in aligned)),
                f"{np.median(turns):.3f}" if turns else "",
                f"{max(turns):.3f}" if turns else "",
                f"{100.0 * max(heights):.2f}" if turns else "",
                str(sum(o.contradicted for o in own)),
            )
        )
    head = (
        "set",
        "pictures",
        "aligned",
        "right",
        "median °",
        "worst °",
        "worst height %",
        "camera called wrong",
    )
    return Table("Poses of real boards and floors", head, tuple(rows))


def _notes(found: list[Outcome]) -> tuple[str, ...]:
    refused = [f"{o.view.name} ({o.reason})" for o in found if o.reason]
    far = [f"{o.view.name} ({o.turn_deg:.2f}°)" for o in found if o.turn_deg > RIGHT_DEG]
    scaled = [f"{o.view.name} ({o.height_off:.1%})" for o in found if o.height_off > RIGHT_HEIGHT]
    said = (
        ("Refused", refused),
        (f"Beyond {RIGHT_DEG:g}°", far),
        (f"Heights off by more than {RIGHT_HEIGHT:.0%}", scaled),
    )
    return tuple(f"{what}: {', '.join(names)}." for what, names in said if names)
