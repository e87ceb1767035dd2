"""First values of an adjustment: the focal length by trial, each view's pose from its homography."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.calibration.adjustment import adjust
from autoreg.calibration.models import COUNT, GENERAL, INTRINSICS, NONE
from autoreg.calibration.observations import Data
from autoreg.calibration.unknowns import Freedom, State

# Focal lengths to try, in widths of the picture's longer side: from a very wide lens to a long one.
_FOCALS = tuple(np.geomspace(0.35, 6.0, 15))
# A view that its pose explains so many times worse than the median view, at the best of them, is nonsense.
_NONSENSE = 5.0


def first_state(data: Data, width: int, height: int) -> State:
    """Unknowns near the solution: the trial focal length whose poses explain the views best, then refined.

    The trials are judged by the median over views, so bad views do not matter.
    """
    trials: list[tuple[np.ndarray, State]] = []
    for focal in _FOCALS:
        state = _posed(data, focal * max(width, height), width, height)
        trials.append((_misfits(data, state), state))
    misfits, state = min(trials, key=lambda trial: float(np.median(trial[0])))
    # A view of nonsense must not lead the first steps astray.
    sane = np.flatnonzero(misfits <= _NONSENSE * np.median(misfits))
    some, near = data.part(sane), state.part(sane)
    focals_only = np.isin(INTRINSICS, ("fx", "fy"))
    for free, steps in ((focals_only, 10), (NONE.free, 15), (GENERAL.free, 30)):
        found = adjust(some, near, Freedom(free), steps=steps)
        if sound(found.state, width, height):
            near = found.state
    poses = np.array([pose_of(data, k, near.intrinsics) for k in range(len(data))])
    poses[sane] = near.poses
    return State(near.intrinsics, poses, near.shape)


def _posed(data: Data, focal_px: float, width: int, height: int) -> State:
    intrinsics = np.zeros(COUNT)
    intrinsics[:4] = focal_px, focal_px, (width - 1) / 2, (height - 1) / 2
    return State(
        intrinsics,
        np.array([pose_of(data, k, intrinsics) for k in range(len(data))]),
        np.zeros(data.basis.shape[-1]),
    )


def pose_of(data: Data, view: int, intrinsics: np.ndarray) -> np.ndarray:
    """A view's pose as (rotation vector, translation) under given intrinsics, from the sheet as if flat."""
    here = data.present[view]
    fx, fy, cx, cy = intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    middle = data.places[view][here].mean(0)
    places, px = data.places[view][here] - middle, data.px[view][here]
    try:
        found, rvecs, tvecs, errors = cv2.solvePnPGeneric(
            places, px, K, intrinsics[4:], flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # corners that no plane's picture can be, such as all on one line
        found, rvecs, tvecs, errors = 0, (), (), ()
    if not found:
        far = np.linalg.norm(np.ptp(places, axis=0))
        return np.array([0, 0, 0, *(-middle[:2]), 3 * far])
    best = int(np.argmin(np.asarray(errors).ravel()))
    rvec, tvec = (np.asarray(v[best], float).ravel() for v in (rvecs, tvecs))
    return np.concatenate([rvec, tvec - np.asarray(cv2.Rodrigues(rvec)[0]) @ middle])


def _misfits(data: Data, state: State) -> Float[np.ndarray, " v"]:
    """RMS distance between measured and projected corners, per view."""
    distances: list[float] = []
    fx, fy, cx, cy = state.intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    for k in range(len(data)):
        here, pose = data.present[k], state.poses[k]
        px = cv2.projectPoints(data.places[k][here], pose[:3], pose[3:], K, state.intrinsics[4:])[0]
        distances.append(float(np.sqrt(np.mean((np.asarray(px).reshape(-1, 2) - data.px[k][here]) ** 2))))
    return np.array(distances)


def sound(state: State, width: int, height: int) -> bool:
    """Whether focal lengths and principal point are those of some camera, however odd."""
    fx, fy, cx, cy = state.intrinsics[:4]
    size = max(width, height)
    return bool(
        np.isfinite(state.intrinsics).all()
        and 0.1 * size < min(fx, fy) <= max(fx, fy) < 50 * size
        and abs(cx - width / 2) < size
        and abs(cy - height / 2) < size
    )
