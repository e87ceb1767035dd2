"""The paving of a photo in the tone in which its joints show best: luminance, or another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from autoreg.answer.full_resolution import Laid
from autoreg.answer.pattern_refusals import PatternRefusal
from autoreg.errors import Refusal
from autoreg.fine_hue import Hue, finest_hue
from autoreg.fitting.fit import Fit
from autoreg.ground.sight import see
from autoreg.joint_tone import Tone, clearest_tone
from autoreg.laying import camera_to_blame, lay, lay_where
from autoreg.paving.lattice_evidence import SAME_SPACING, alike
from autoreg.search.find import find_lattice_or_rows_on, find_on
from autoreg.search.glance import promises
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
        seen, laid = task, lay(task)
    except Refusal as refusal:
        if refusal.code == "slab_mismatch":
            blamed = camera_to_blame(task, slab=task.slab)
            told = _slabs_in_joint_tone(task) if blamed is None else None
            if told is None:
                raise blamed or refusal from None
            return told
        if refusal.code in OWN_REASONS:
            raise
        blamed = camera_to_blame(task)
        if blamed is not None:
            raise blamed from None
        by_hue = _laid_by_hue(task)
        # Where luminance shows another pattern, hue may show the stones of one of its columns, like rows.
        if by_hue is None or (isinstance(refusal, PatternRefusal) and _are_rows(by_hue[1])):
            raise
        seen, laid = by_hue
    return _in_joint_tone(seen, laid)


def _slabs_in_joint_tone(task: Task) -> tuple[Task, Laid] | None:
    """Slabs of the told sides, and the photo in a tone that shows them, where luminance shows other ones.

    Stripes of shadow may do that. What is theirs alone changes with the light, and not in a tone of hue, in
    which the slabs are looked for on the clearest grounds alone.
    """
    other = None if task.colour is None else _perhaps_laid(replace(task, slab=None))
    toned = other and _in_tone_of(task, other.fit)
    laid = toned and _perhaps_laid(toned, thorough=False)
    if other is None or toned is None or laid is None:
        return None
    return (toned, laid) if laid.settled.margin_nats > other.settled.margin_nats else None


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
