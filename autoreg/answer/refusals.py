"""Why a photo was refused, in words: cause, measured value, next step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from autoreg.alignment import CameraSource
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.fitting.one_edge import MOST as MOST_ONE_EDGED
from autoreg.ground.ground_planes import FRONTAL_RAD, LEVEL_RAD
from autoreg.paving.bond import FALSE_ALARM_NATS
from autoreg.paving.lattice_choice import RIVAL_NATS, TESTED_NATS, Paving
from autoreg.rows.arcs import Arc
from autoreg.rows.cross_joints import Lean
from autoreg.rows.rows import Rows
from autoreg.rows.turning_stones import Directions

# Cross joints that lean together by more than this, and by so many standard deviations, are none of slabs
# seen with this camera. What slabs and their laying are off square is a tenth of it.
MOST_LEAN_DEG, LEAN_SIGMAS = 3.0, 5.0
# Nor do they turn by so much from the first rows to the last, or with the joints along the rows from one side
# to the other: by some tenths of a degree in slabs. Where so much cannot be told from none, it may well be.
MOST_FANNED_DEG, FANNED_SIGMAS = 8.0, 2.5
# Both families of a lattice's joints do not scatter in direction by more than this. Of right answers the
# family with less of it does by 4.2 at most (wickerwork; elsewhere by 2.1), of waves that passed by 6.4.
MOST_ASKEW_DEG = 5.5
# Joints run along their lattice: those of pinwheels of large and small squares lie 2 degrees across what
# looks like a lattice of theirs, others by 0.3 at most.
MOST_OFF_DEG, OFF_SIGMAS = 1.0, 5.0
# Straight joints turn alike by less than this from end to end: by up to three through an untold lens.
MOST_ARC_DEG, ARC_SIGMAS = 3.5, 4.0
# Of the edges along a lattice's joints so many lie inside its slabs, over the share of those that lie
# anywhere, where the slabs are cells of a pattern: 1.0 and more in herringbone, 0.3 at the most in real ones.
MOST_INNER = 0.5
# A camera's focal length must differ by this much before it is blamed for a refusal.
FOCAL_BLAME = 0.05
# ... and its principal point lie so far off the middle, as a share of the width.
CENTRE_BLAME = 0.03
# Fewer sides than this are a few joints, however clear.
FEW_SIDES = 16
# Courses seen no more aslant than the first, within so many standard deviations of the pose, and no farther
# from level than the second, may be a wall's: the search for the ground cannot drop such a wall for its plumb
# joints.
FRONTAL_SIGMAS = 1.5
FRONTAL_DEG, LEVEL_DEG = float(np.degrees(FRONTAL_RAD)), float(np.degrees(LEVEL_RAD))
_OTHER_CAMERA = (
    "the camera file belongs to another camera, zoom or picture size: check it with its calibration, "
    "or leave --camera out"
)
# Edges of which more than this share runs in one direction are of no joints in two.
ONE_WAY = 0.9


def no_lattice(best: Paving | None, rows: Rows | None, one_way: float = 0.0) -> Refusal:
    """The refusal of a photo whose best lattice, and whose best rows, explain it no better than chance.

    `one_way` is the share of all segments' length that runs in one direction, where that was looked at.
    """
    single = 0.5 * TESTED_NATS + FALSE_ALARM_NATS
    strongest = max(
        (e for e in (*(best.evidence_nats if best else ()), rows.paving.evidence_nats[0] if rows else 0.0)),
        default=0.0,
    )
    if strongest > single:
        return Refusal(
            "one_direction",
            "only one family of parallel joints repeats here, and the joints across it could be chance, so "
            "the pose is not determined; take a photo that shows joints in both directions",
            measured=round(min(best.evidence_nats) if best else 0.0, 2),
            limit=round(0.5 * TESTED_NATS, 2),
        )
    if one_way > ONE_WAY:
        return Refusal(
            "one_direction",
            f"{100 * one_way:.0f} % of the edges in this picture run in one direction, as boards do, "
            "so the pose is not determined; take a photo that shows joints in both directions",
            measured=round(one_way, 3),
            limit=ONE_WAY,
        )
    evidence = sum(best.evidence_nats) if best else 0.0
    if best is not None and len(best.presence.p) < FEW_SIDES and best.margin_nats > -0.5 * TESTED_NATS:
        return Refusal(
            "too_few_joints",
            f"a lattice may be there, but only {len(best.presence.p)} slab sides are in view, too few to "
            "tell it from chance; step back or tilt the camera so that more slabs are seen",
            measured=round(evidence, 2),
            limit=round(TESTED_NATS + FALSE_ALARM_NATS, 2),
        )
    return Refusal(
        "no_lattice",
        "no lattice of slabs explains this picture better than chance (evidence in nats, against what as "
        "many tried lattices reach by luck once in a thousand photos); take a photo in which two or more "
        "rows of slabs and their cross joints are clearly seen",
        measured=round(evidence, 2),
        limit=round(TESTED_NATS + FALSE_ALARM_NATS, 2),
    )


def ambiguous(best: Paving, other: Paving) -> Refusal:
    """The refusal of a photo that two lattices explain equally well; both are named, in camera heights."""
    return Refusal(
        "ambiguous",
        f"two lattices explain this picture equally well: {_named(best)}, and {_named(other)}; "
        "take a photo that shows more slabs, or more sharply",
        measured=round(best.margin_nats - other.margin_nats, 2),
        limit=RIVAL_NATS,
    )


def maybe_wall(fit: Fit, covariance: Float[np.ndarray, "6 6"] | None = None) -> Refusal | None:
    """The refusal of courses seen from the front, level in the picture: a brick wall as likely as a floor.

    With the pose's covariance those that may as well be seen from the front are refused too, and so is what
    recedes downwards: the wall below the eye of somebody who looks down.
    """
    R = fit.cam_from_ground.R
    tilt = float(np.arccos(np.clip(-R[2, 2], -1.0, 1.0)))
    tilt_deg = float(np.rad2deg(tilt))
    if covariance is not None:
        # A small rotation w turns the ground's normal by w x normal.
        by_turn = np.array([R[1, 2], -R[0, 2]]) / max(float(np.sin(tilt)), 1e-9)
        sigma = float(np.sqrt(by_turn @ covariance[:2, :2] @ by_turn))
        tilt_deg -= FRONTAL_SIGMAS * float(np.rad2deg(sigma))
    skew_deg = float(np.rad2deg(np.arcsin(np.abs(R[0, :2]).min())))
    stack = fit.grid.spacing_x is not None and fit.grid.shift == 0.0
    if stack or skew_deg > LEVEL_DEG:
        return None
    if tilt_deg > FRONTAL_DEG:
        return _upside_down(R) if R[1, 2] > 0 else None
    return Refusal(
        "not_ground",
        f"these courses lie level in the picture and are seen from the front ({np.rad2deg(tilt):.0f} "
        "degrees aslant) as those of a wall are, and the photo does not tell whether it is one; photograph "
        "the ground more from the side, or with the camera turned by some degrees",
        measured=round(skew_deg, 2),
        limit=LEVEL_DEG,
    )


def _upside_down(R: Float[np.ndarray, "3 3"]) -> Refusal:
    """The refusal of joints that lie level and recede downwards."""
    below_deg = float(np.rad2deg(np.arcsin(R[1, 2])))
    return Refusal(
        "not_ground",
        f"these joints lie level and recede downwards ({below_deg:.0f} degrees), as those of a wall do that "
        "the camera looks down on; turn the photo if it stands on its head, or photograph the ground",
        measured=round(below_deg, 1),
        limit=0.0,
    )


def on_its_side(quarters: int) -> Refusal:
    """The refusal of a photo that shows paving only if it is turned clockwise by so many quarters."""
    degrees = 90 * quarters
    return Refusal(
        "not_ground",
        f"a lattice lies on the ground only if this photo is turned clockwise by {degrees} degrees: turn it "
        "if it does not stand upright, and its camera with it; as it is, the lattice is that of a wall",
        measured=float(degrees),
        limit=0.0,
    )


def focal_untold(
    kind: Literal["rows", "slabs"], focal_px: float | None, sigma_log_focal: float, limit: float
) -> Refusal:
    """The refusal of paving that leaves the focal length open, and with it the camera's tilt or its height.

    Args:
        kind: rows, or slabs with both of their spacings.
        focal_px: the likeliest focal length, if there is any.
        sigma_log_focal: standard deviation of its logarithm.
        limit: the largest one that will do.
    """
    what, depends, instead = {
        "rows": (
            "rows of slabs and the cross joints between them",
            "the tilt of the ground",
            "the rows aslant, at about 45 degrees, and not",
        ),
        "slabs": ("joints that hardly run together", "the height of the camera", "the ground less"),
    }[kind]
    told = "do not tell its focal length"
    if focal_px is not None:
        percent = 100 * sigma_log_focal
        told = f"tell its focal length only as {focal_px:.0f} px with a standard deviation of {percent:.0f} %"
    return Refusal(
        "ambiguous",
        f"the photo names no camera, and {what} {told}, on which {depends} depends; give the camera with "
        f"--camera, or photograph {instead} steeply from above",
        measured=None if focal_px is None else round(sigma_log_focal, 3),
        limit=limit,
    )


def focal_implausible(camera: Camera) -> Refusal:
    """The refusal of joints that tell a focal length as hardly any camera has."""
    long_side = max(camera.width, camera.height)
    times = camera.fx / long_side
    return Refusal(
        "ambiguous",
        f"the photo names no camera, and its joints ask for a focal length of {camera.fx:.0f} px, "
        f"{times:.2g} times its long side, as hardly any camera has; the photo may have been cut from a "
        "larger one, or its joints be bent; give the camera with --camera",
        measured=round(times, 3),
    )


def leaning(lean: Lean | None, camera: Camera, source: CameraSource) -> Refusal | None:
    """The refusal of joints that are not at right angles to each other; None if they may be."""
    degrees = _clear_deg(lean, MOST_LEAN_DEG, LEAN_SIGMAS)
    if degrees is None:
        return None
    measured, limit = round(degrees, 2), MOST_LEAN_DEG
    if source == "photo":
        return Refusal(
            "no_lattice",
            f"the joints across the unbroken ones are {degrees:.1f} degrees off square at every focal length "
            "that suits them, which those of rectangular slabs are not; photograph slabs with right angles",
            measured=measured,
            limit=limit,
        )
    whose = {"file": "with this camera", "exif": "at the focal length of the photo's EXIF data"}[source]
    return Refusal(
        "camera_contradicted",
        f"{whose} ({camera.fx:.0f} px) the joints across the unbroken ones are {degrees:.1f} degrees off "
        f"square, which those of rectangular slabs are not; {_OTHER_CAMERA}",
        measured=measured,
        limit=limit,
    )


def fanned(change: Lean | None) -> Refusal | None:
    """The refusal of joints that turn from row to row as those across arcs do; None if they may not."""
    return _curved(
        change,
        MOST_FANNED_DEG,
        FANNED_SIGMAS,
        "the joints across these rows turn by {:.0f} degrees from the first rows to the last, as those of "
        "fans and waves do; photograph slabs with right angles",
    )


def turning(turn: Lean | None) -> Refusal | None:
    """The refusal of stones that turn across their field as those of fans do; None if they may not."""
    return _curved(
        turn,
        MOST_FANNED_DEG,
        FANNED_SIGMAS,
        "these stones turn by {:.0f} degrees from one side of their field to the other, as those of fans and "
        "rings do; photograph slabs in straight rows",
    )


def askew(run: Sequence[Directions | None]) -> Refusal | None:
    """The refusal of stones both families of whose joints scatter in direction; None if they do not."""
    known = [float(np.degrees(family.scatter)) for family in run if family is not None]
    if len(known) < len(run) or min(known) < MOST_ASKEW_DEG:
        return None
    return Refusal(
        "no_lattice",
        f"the joints of these stones run {min(known):.0f} degrees askew of each other (standard deviation), "
        "as those of waves, fans and crazy paving do; photograph slabs in straight rows",
        measured=min(known),
        limit=MOST_ASKEW_DEG,
    )


def off_lattice(turn: Lean | None) -> Refusal | None:
    """The refusal of a lattice across which its stones lie; None if they do not."""
    return _curved(
        turn,
        MOST_OFF_DEG,
        OFF_SIGMAS,
        "what repeats here does so {:.1f} degrees askew of its joints, as patterns of stones of several "
        "sizes do; photograph slabs in straight rows",
    )


def arcs(arc: Arc | None) -> Refusal | None:
    """The refusal of unbroken joints that bow alike; None if they may be straight."""
    return _curved(
        None if arc is None else Lean(arc.turn, arc.sigma),
        MOST_ARC_DEG,
        ARC_SIGMAS,
        "the joints along these rows are arcs, which turn by {:.0f} degrees from end to end, as those of "
        "fans and waves do; photograph slabs in straight rows",
    )


def one_edged(share: float) -> Refusal | None:
    """The refusal of joints of which only one edge was met, as `one_edge` tells it; None if both were."""
    if share <= MOST_ONE_EDGED:
        return None
    return Refusal(
        "no_lattice",
        f"the ground beside these joints differs from one side to the other by {100 * share:.0f} % of their "
        "contrast, the same way at every joint, as where only one edge of wide joints was met; photograph "
        "slabs with joints narrower than a tenth of them, or from farther away",
        measured=round(share, 2),
        limit=MOST_ONE_EDGED,
    )


def filled(inner: float) -> Refusal | None:
    """The refusal of a lattice whose slabs are full of edges along its joints; None if they are not."""
    if inner < MOST_INNER:
        return None
    return Refusal(
        "no_lattice",
        "what repeats here as slabs would is full of joints itself, as herringbone and other patterns of "
        "several stones are; photograph slabs in straight rows",
        measured=round(inner, 2),
        limit=MOST_INNER,
    )


def _curved(turn: Lean | None, most_deg: float, sure_sigmas: float, message: str) -> Refusal | None:
    """The refusal, by a message about its degrees, of a turn that is clear; None of one that is not."""
    degrees = _clear_deg(turn, most_deg, sure_sigmas)
    if degrees is None:
        return None
    return Refusal("no_lattice", message.format(degrees), measured=round(degrees, 1), limit=most_deg)


def _clear_deg(turn: Lean | None, most_deg: float, sure_sigmas: float) -> float | None:
    """The size of an angle in degrees, where it is surely more than none and at least so large; else None."""
    if turn is None:
        return None
    degrees = float(np.degrees(abs(turn.angle)))
    return None if degrees < most_deg or abs(turn.angle) < sure_sigmas * turn.sigma else degrees


def _named(paving: Paving) -> str:
    grid = paving.grid
    height = float(paving.fit.cam_from_ground.origin_in_a[2])
    bond = f"running bond with shift {grid.shift:.2f}" if grid.shift else "stack bond"
    return f"{bond} of {(grid.spacing_x or 0.0) / height:.3f} x {grid.spacing_y / height:.3f} camera heights"


def camera_contradicted(given: Camera, from_photo_px: float) -> Refusal | None:
    """The refusal of a photo whose joints fit a camera of this focal length; None if that is about the same.

    The other camera has its principal point in the middle of the picture.
    """
    share = from_photo_px / given.fx - 1.0
    size = np.array([given.width, given.height])
    off = float(np.linalg.norm(np.array([given.cx, given.cy]) - 0.5 * (size - 1))) / given.width
    if abs(share) >= FOCAL_BLAME:
        return Refusal(
            "camera_contradicted",
            f"no lattice fits this camera's focal length of {given.fx:.0f} px, but one fits "
            f"{from_photo_px:.0f} px ({100 * share:+.0f} %); {_OTHER_CAMERA}",
            measured=round(from_photo_px, 1),
            limit=round(given.fx, 1),
        )
    if off >= CENTRE_BLAME:
        return Refusal(
            "camera_contradicted",
            f"no lattice fits this camera, whose principal point ({given.cx:.0f}, {given.cy:.0f}) px lies "
            f"{100 * off:.0f} % of the width off the picture's middle, but one fits if it lies there; "
            f"if the photo was cut from a larger one say so with --crop; {_OTHER_CAMERA}",
            measured=round(off, 3),
            limit=CENTRE_BLAME,
        )
    return None
