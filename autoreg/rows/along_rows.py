"""Segments along the rows: whether those of the ground lie on the joints that the rows predict.

Rows have no other joints in that direction. A corner of a field whose courses are uneven, or the soldier
course beside herringbone, may suit an even spacing; the rest of the ground then says otherwise. Such joints
are as clear as those of the rows. The grain of boards, which runs along them anywhere, is fainter: as much of
it as is seen far from the joints is left out of the count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.ground.points import inside_box, on_ground, project_ground
from autoreg.segments import Segments

# Segments run along the rows within this angle.
ALONG_RAD = np.radians(4.0)
# The ground around a field reaches so many of its sizes to either side: a wall far beyond it has no say.
AROUND = 1.0
# They lie on a joint if their middles are within the first share of a row's width of its own, as a quarter of
# those at any place are, or within the second one of its edges, yet within the third one of its middle. Blur
# moves the edges outwards, to one standard deviation from the middle of a fine line.
ON_JOINT, ON_EDGE, MOST_ON_JOINT = 0.12, 0.06, 0.2
# Farther from the joints than this share of a row's width is midway between them.
MIDWAY = 0.25
# What lies anywhere is no more than so many times as dense midway as beside the joints, by chance.
FAR_LESS = 1.5
# Shares of their length that lie on joints, in the field and with all that is around it, must be larger.
LEAST_IN_FIELD, LEAST_AROUND = 0.75, 0.5


@dataclass(frozen=True)
class AlongRows:
    """Shares of the length of the segments along the rows, without their grain, that lie on joints."""

    in_field: float
    around: float

    @property
    def contradict(self) -> bool:
        """Whether they speak against these rows."""
        return self.in_field < LEAST_IN_FIELD or self.around < LEAST_AROUND


def along_rows(
    segments: Segments,
    contrast: Float[np.ndarray, " n"],
    fit: Fit,
    field: Float[np.ndarray, "k 2"],
    size: tuple[int, int],
) -> AlongRows:
    """What the segments of the ground that run along the rows say of them; one where there are none.

    Args:
        segments: of the photo, whose width and height is `size`.
        contrast: of each segment, in any unit.
        fit: of the rows.
        field: where they are.
        size: the photo's width and height.
    """
    camera = fit.camera.scaled(*size)
    ground = on_ground(segments.ends_px, camera, fit.cam_from_ground)
    along, middle = ground[:, 1] - ground[:, 0], ground.mean(1)
    with np.errstate(invalid="ignore"):
        chosen = np.abs(along[:, 1]) < np.tan(ALONG_RAD) * np.abs(along[:, 0])
    middle, length, contrast = middle[chosen], segments.length_px[chosen], contrast[chosen]
    blur_px = fit.strip.blur_px * size[0] / fit.camera.width
    blur = blur_px / np.maximum(_row_px(camera, fit, middle), 1e-9)
    # Of rows that are a few blurs wide, far away, it cannot be said what lies on their joints.
    sharp = blur < MOST_ON_JOINT - ON_EDGE
    row = middle[:, 1] / fit.grid.spacing_y
    off = np.abs(row - np.round(row))
    inside, around = (inside_box(middle, field, margin) & sharp for margin in (0.0, AROUND))
    half = 0.5 * fit.strip.width[0] / fit.grid.spacing_y
    near = np.clip(np.hypot(half, blur) + ON_EDGE, ON_JOINT, MOST_ON_JOINT)
    of_joints = contrast[inside & (off < near)]
    usual = float(np.median(of_joints)) if len(of_joints) else 0.0
    faint = 1.0 - np.minimum(contrast / max(usual, 1e-9), 1.0) ** 2
    return AlongRows(*(_share(length[some], off[some], faint[some], near[some]) for some in (inside, around)))


def _row_px(camera: Camera, fit: Fit, ground: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """The width of a row in pixels, across the joints as they are seen, at places on the ground."""
    pose, width = fit.cam_from_ground, fit.grid.spacing_y
    here, along, across = (
        project_ground(camera, pose, ground + step) for step in ([0.0, 0.0], [width, 0.0], [0.0, width])
    )
    (ax, ay), (bx, by) = (along - here).T, (across - here).T
    return np.nan_to_num(np.abs(ax * by - ay * bx) / np.maximum(np.hypot(ax, ay), 1e-9), nan=np.inf)


def _share(length: np.ndarray, off: np.ndarray, faint: np.ndarray, near: np.ndarray) -> float:
    """The share of some segments that lies `near` joints, without what is as likely to lie anywhere.

    That is as much as is seen of it midway between the joints, unless there is far less beside them.
    """
    whole, on_joint = float(length.sum()), float(length[off < near].sum())
    if whole == 0.0:
        return 1.0
    # Were it as dense everywhere as it is in either band.
    beside, midway = (
        0.5 * float((length * faint / (high - low))[(off > low) & (off < high)].sum())
        for low, high in ((near, MIDWAY), (MIDWAY, 0.5))
    )
    anywhere = min(midway, FAR_LESS * beside)
    on_joint -= 2.0 * float(np.average(near, weights=length)) * anywhere
    return float(np.clip(on_joint / max(whole - anywhere, on_joint, 1e-9), 0.0, 1.0))
