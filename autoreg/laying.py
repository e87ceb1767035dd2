"""The paving of a photo, found at detection scale and measured at the photo's own resolution."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.answer.camera_refusals import leaning
from autoreg.answer.full_resolution import Laid, measured_rows, measured_slabs
from autoreg.answer.refusals import maybe_wall
from autoreg.errors import Refusal
from autoreg.fields import largest_field, same_ground
from autoreg.fitting.fit import Fit
from autoreg.ground.upright import like_upright_wall
from autoreg.paving.lattice_evidence import Paving
from autoreg.rows.cross_joints import common_lean
from autoreg.rows.rows import Rows
from autoreg.search.find import find_paving, find_rows
from autoreg.search.glance import other_camera
from autoreg.task import Task

# A wall stands at a right angle on the ground; by a wrong focal length at one that is larger than this.
ACROSS_RAD = np.radians(45.0)
# Refusals of a lattice that is no longer there at the photo's own resolution.
NOT_THERE = {"no_lattice", "one_direction", "too_few_joints"}


def lay(task: Task, *, thorough: bool = True) -> Laid:
    """The paving, measured at the photo's own resolution: of two fields, the larger one that can be measured.

    It is looked for as `thorough`ly as `find_paving` can, or on the clearest grounds alone.

    Raises:
        Refusal: there is none, or it cannot be one of slabs on the ground.
    """
    found = _found(task, thorough=thorough)
    if task.camera is not None and isinstance(found, Paving):
        larger = largest_field(task.sight, found, task.camera, task.slab)
        if larger is not found:
            try:
                return lay_where(task, larger)
            except Refusal as refusal:
                if refusal.code == "camera_contradicted":
                    raise
    return lay_where(task, found)


def lay_where(task: Task, found: Paving | Rows) -> Laid:
    """What was found at detection scale, measured at the photo's own resolution.

    Raises:
        Refusal: it vanishes there, or cannot be one of slabs on the ground.
    """
    try:
        laid = _measured(task, found)
    except Refusal as refusal:
        if isinstance(found, Rows) or refusal.code not in NOT_THERE:
            raise
        # What is no lattice at the photo's own resolution, rows may have looked like: on that ground, or else
        # they are lines of a pattern of several stones, by which the ground is another one.
        rows = find_rows(task.sight, task.camera)
        if rows is None or _maybe_wall(task, rows.paving.fit) is not None:
            raise
        if task.camera is not None and not same_ground(found.fit, rows.paving.fit):
            raise
        laid = _measured(task, rows)
    wall = _maybe_wall(task, laid.likeliest.fit, laid.likeliest.covariance)
    if wall is not None:
        raise wall
    lean = common_lean(task.sight.segments, laid.fit, laid.settled.presence.field)
    off = leaning(lean, laid.fit.camera, task.source)
    if off is not None:
        raise camera_to_blame(task) or off
    return laid


def camera_to_blame(
    task: Task, found: Paving | None = None, *, slab: tuple[float, float] | None = None
) -> Refusal | None:
    """The refusal of a calibrated camera, if the joints clearly fit another one better than those found.

    By that one they must lie as the sides of a `slab` ask, if it is given.
    """
    return None if task.calibrated is None else other_camera(task.sight, task.calibrated, found, slab)


def _found(task: Task, *, thorough: bool) -> Paving | Rows:
    """The paving at detection scale; if that may be a wall, the one on the ground before it.

    What lies at somebody's feet, or is held up, may look like a wall as well, and is taken if there is no
    other, or nothing tells it from a wall but that somebody vouches for the ground.

    Raises:
        Refusal: there is none, or none that may not be a wall.
    """
    found = find_paving(task.sight, task.camera, task.slab, thorough=thorough)
    wall = maybe_wall(found.fit)
    if wall is None and not _like_wall(found):
        return found
    try:
        before = find_paving(task.sight, task.camera, task.slab, walls=False, thorough=thorough)
    except Refusal:
        before = None
    if before is not None and maybe_wall(before.fit) is None and _across(found, before):
        return before
    if wall is not None and not task.ground:
        raise wall
    return found


def _maybe_wall(task: Task, fit: Fit, covariance: Float[np.ndarray, "6 6"] | None = None) -> Refusal | None:
    """The refusal of what may be a wall, unless somebody vouches for the ground."""
    return None if task.ground else maybe_wall(fit, covariance)


def _like_wall(found: Paving | Rows) -> bool:
    return like_upright_wall(found.fit.cam_from_ground.R)


def _across(wall: Paving | Rows, before: Paving | Rows) -> bool:
    """Whether one lies before the other as ground before a wall, and is none itself."""
    one, other = (found.fit.cam_from_ground.R[:, 2] for found in (wall, before))
    return bool(np.arccos(np.clip(one @ other, -1.0, 1.0)) > ACROSS_RAD) and not _like_wall(before)


def _measured(task: Task, found: Paving | Rows) -> Laid:
    """What was found, measured at the photo's own resolution, if it may be what it looks like.

    Raises:
        Refusal: it is not, or vanishes there.
    """
    # A wrong camera may leave rows of what is a lattice, or a small field of it.
    rows = isinstance(found, Rows)
    little = rows or found.closer is not None
    blamed = camera_to_blame(task, None if rows else found) if little else None
    if blamed is not None:
        raise blamed
    if rows:
        square = task.source == "photo"
        return measured_rows(task.sight, task.picture, found, task.free, square=square, ground=task.ground)
    return measured_slabs(task.sight, task.picture, found, task.free, task.slab)
