"""The paving of a photo in the tone in which its joints show best: luminance, or another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from autoreg.answer.camera_refusals import contradicted_with_slab
from autoreg.answer.full_resolution import Laid
from autoreg.answer.pattern_refusals import PatternRefusal
from autoreg.errors import Refusal
from autoreg.fine_hue import Hue, finest_hue
from autoreg.fitting.fit import Fit
from autoreg.ground.sight import see
from autoreg.joint_tone import Tone, clearest_tone
from autoreg.laying import NOT_THERE, camera_to_blame, lay, lay_where
from autoreg.parts import SeenCloser, lattice_by_part, paving_by_part
from autoreg.paving.lattice_evidence import SAME_SPACING, alike
from autoreg.search.find import find_lattice_or_rows_on, find_on
from autoreg.search.glance import promises
from autoreg.slabs.camera_check import check_camera
from autoreg.task import Task

# A tone that leaves the joints so many times as far from their lines as luminance does shows them less well.
ROUGHER_IN_TONE = 1.6
# Refusals that have a reason of their own, which no other camera and no other tone would take away.
OWN_REASONS = {"not_ground", "camera_contradicted"}


def lay_in_clearest_tone(task: Task) -> tuple[Task, Laid]:
    """The paving in the tone that shows it best, with the photo in that tone.

    Luminance comes first. What it does not show, the hue of the photo's fine detail may.

    Raises:
        Refusal: there is none, or it cannot be one of slabs on the ground; what luminance refuses is told, or
            that the camera is to blame: what a wrong one hides may look like anything.
    """
    try:
        seen, laid = _with_cross_joints(task, lay(task))
    except Refusal as refusal:
        if refusal.code == "slab_mismatch":
            return _of_told_slabs(task, refusal)
        if refusal.code in OWN_REASONS:
            raise
        blamed = camera_to_blame(task)
        if blamed is not None:
            raise blamed from None
        found = _laid_by_hue(task)
        # Where luminance shows another pattern, hue may show the stones of one of its columns, like rows.
        if found is not None and isinstance(refusal, PatternRefusal) and _are_rows(found[1]):
            raise
        if found is None and _is_absent(refusal):
            found = _laid_by_part(task)
        if found is None:
            raise
        seen, laid = found
    return _in_joint_tone(seen, laid)


def _of_told_slabs(task: Task, refusal: Refusal) -> tuple[Task, Laid]:
    """Slabs of the told sides, and the photo in a tone that shows them, where luminance shows other ones.

    Raises:
        Refusal: there are none; that the camera is to blame, that what is there are no slabs of any sides, or
            else the `refusal` for the slab.
    """
    blamed = camera_to_blame(task, slab=task.slab)
    if blamed is not None:
        raise blamed from None
    try:
        other = lay(replace(task, slab=None))
    except Refusal as own:
        better = own.code == "camera_contradicted" or isinstance(own, PatternRefusal)
        raise (own if better else refusal) from None
    told = _slabs_in_joint_tone(task, other)
    if told is None:
        raise _against_camera(task, other) or refusal from None
    return told


def _against_camera(task: Task, laid: Laid) -> Refusal | None:
    """The refusal of a calibrated camera that the joints of a lattice contradict, as the told slab does."""
    if task.calibrated is None or task.slab is None or _are_rows(laid):
        return None
    check = check_camera(laid.fit, task.picture, laid.field, laid.likeliest.scatter)
    return None if check.consistent else contradicted_with_slab(laid.fit, task.slab, check.focal_px)


def _slabs_in_joint_tone(task: Task, other: Laid) -> tuple[Task, Laid] | None:
    """Slabs of the told sides in the tone of the joints of `other` ones; None if it shows none more clearly.

    Stripes of shadow may look like those. What is theirs alone changes with the light, and not in a tone of
    hue, in which the slabs are looked for on the clearest grounds alone.
    """
    toned = _in_tone_of(task, other.fit)
    laid = None if toned is None else _perhaps_laid(toned, thorough=False)
    if toned is None or laid is None or laid.settled.margin_nats <= other.settled.margin_nats:
        return None
    return toned, laid


def _laid_by_hue(task: Task) -> tuple[Task, Laid] | None:
    """The paving by hue, and the photo in it, where it promises one at the first glance.

    On the clearest grounds alone: what luminance does not show by a thorough search is looked for once.
    """
    if task.colour is None:
        return None
    colour = task.colour()
    hued = _seen_in(task, colour, finest_hue(colour, task.sight.looks.size))
    if hued is None or not promises(hued.sight, hued.camera):
        return None
    laid = _perhaps_laid(hued, thorough=False)
    return None if laid is None else (hued, laid)


def _laid_by_part(task: Task) -> tuple[Task, Laid] | None:
    """The paving that a part of the photo shows, if any does, and the photo at a scale that shows it as well.

    By a known camera: a part by itself tells a focal length too roughly.

    Raises:
        Refusal: there is some, but it is a wall's, or no slabs by this camera.
    """
    return None if task.camera is None else _laid_closer(task, paving_by_part(task.sight, task.camera))


def _with_cross_joints(task: Task, laid: Laid) -> tuple[Task, Laid]:
    """Rows, or the lattice that their cross joints make of them where a part of a large photo shows these.

    Raises:
        Refusal: there is such a lattice, but it is no slabs' by this camera.
    """
    if task.camera is None or not _are_rows(laid):
        return task, laid
    found = _laid_closer(task, lattice_by_part(task.sight, task.camera, laid.fit.cam_from_ground.R))
    return (task, laid) if found is None or _are_rows(found[1]) else found


def _laid_closer(task: Task, seen: SeenCloser | None) -> tuple[Task, Laid] | None:
    """The paving that is seen at another scale, and the photo at that; None if it is not there after all.

    Raises:
        Refusal: it is there, but is a wall's, or no slabs by this camera.
    """
    if seen is None:
        return None
    closer = replace(task, sight=seen.sight)
    try:
        return closer, lay_where(closer, seen.found)
    except Refusal as refusal:
        if _is_absent(refusal):
            return None
        raise


def _is_absent(refusal: Refusal) -> bool:
    """Whether a photo is refused for showing no joints of slabs, and none of other patterns either."""
    return refusal.code in NOT_THERE and not isinstance(refusal, PatternRefusal)


def _perhaps_laid(task: Task, *, thorough: bool = True) -> Laid | None:
    """The paving of a photo, or None where it is refused."""
    try:
        return lay(task, thorough=thorough)
    except Refusal:
        return None


def _are_rows(laid: Laid) -> bool:
    return laid.fit.grid.spacing_x is None


def _in_joint_tone(task: Task, laid: Laid) -> tuple[Task, Laid]:
    """What was laid, or what is in the tone in which its joints show best, with the photo in that tone."""
    toned = _in_tone_of(task, laid.fit)
    clearer = None if toned is None else _laid_anew(toned, laid)
    if toned is None or clearer is None:
        return task, laid
    same = alike(laid.settled, clearer.settled, SAME_SPACING)
    better = same or clearer.settled.margin_nats > laid.settled.margin_nats
    smooth = clearer.fit.roughness_px < ROUGHER_IN_TONE * laid.fit.roughness_px
    smooth |= _at_odds(laid.fit) and not _at_odds(clearer.fit)
    return (toned, clearer) if better and smooth else (task, laid)


def _at_odds(fit: Fit) -> bool:
    """Whether the joints of one family are darker than the slabs, and those of the other lighter.

    What fills the joints is either: a rim in the light was taken for them.
    """
    x, y = fit.strip.polarity
    return x * y < 0


def _in_tone_of(task: Task, fit: Fit) -> Task | None:
    """The photo in the tone in which the joints of a fit show best; None if that is luminance."""
    if task.colour is None:
        return None
    colour = task.colour()
    return _seen_in(task, colour, clearest_tone(colour, fit, task.sight.looks.size))


def _seen_in(task: Task, colour: UInt8[np.ndarray, "h w 3"], tone: Hue | Tone | None) -> Task | None:
    """The photo in a tone in which joints may differ from all slabs; None if there is none."""
    return None if tone is None else replace(task, sight=see(tone.of(colour), toned=True))


def _laid_anew(task: Task, before: Laid) -> Laid | None:
    """The paving in another tone: where it was before, if it is the same there; None if there is none.

    Rows are looked for nowhere else.
    """
    camera, R = before.fit.camera, before.fit.cam_from_ground.R
    try:
        if _are_rows(before):
            again = find_lattice_or_rows_on(task.sight, camera, R)
            return None if again is None else lay_where(task, again)
        found = find_on(task.sight, camera, R)
        if found is None or not alike(before.settled, found, SAME_SPACING):
            return lay(task)
        return lay_where(task, found)
    except Refusal:
        return None
