"""Why a photo was refused, in words: cause, measured value, next step."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.fitting.heavier_lines import HEAVIER, MOST_TIMES, Heavier
from autoreg.ground.upright import FRONTAL_RAD, LEVEL_RAD, MAX_ROLL_RAD, like_upright_wall, roll_deg
from autoreg.paving.bond import FALSE_ALARM_NATS
from autoreg.paving.lattice_evidence import RIVAL_NATS, TESTED_NATS, Paving
from autoreg.rows.rows import Rows

# Fewer sides than this are a few joints, however clear.
FEW_SIDES = 16
# Courses seen no more aslant than the first, within so many standard deviations of the pose, and no farther
# from level than the second, may be a wall's: the search for the ground cannot drop such a wall for its plumb
# joints.
FRONTAL_SIGMAS = 1.5
FRONTAL_DEG, LEVEL_DEG = float(np.degrees(FRONTAL_RAD)), float(np.degrees(LEVEL_RAD))
# A lattice that does better than chance by less than the first may not miss more than the second share of its
# joints. Right ones that were so hard to see missed 0.23 of theirs at the most, other patterns 0.35 to 0.82.
DOUBTFUL_NATS, MOST_OF_DOUBTFUL = 10.0, 0.3
# A picture that spans fewer grey levels, but for a hundredth of it at either end, shows nothing. Joints of a
# contrast of five levels are found.
LEAST_LEVELS = 3.0
# Edges of which more than this share runs in one direction are of no joints in two.
ONE_WAY = 0.9
# Edges of which more than the first share runs in two directions at right angles, and more than the second in
# the rarer of them, are those of joints: of pavings that are refused up to 0.9 do, of gravel, cobbles, setts,
# books and facades less than 0.4.
CROSSING, RARER = 0.55, 0.12


def without_contrast(levels: float) -> Refusal | None:
    """The refusal of a picture whose grey levels are as good as one; None if they are more."""
    if levels >= LEAST_LEVELS:
        return None
    return Refusal(
        "no_lattice",
        f"nearly the whole picture lies within {levels:.1f} of 255 grey levels, so that no joint can show; "
        "give the photo as the camera took it, or one that is exposed longer",
        measured=round(levels, 1),
        limit=LEAST_LEVELS,
    )


def no_lattice(
    best: Paving | None,
    rows: Rows | None,
    one_way: float = 0.0,
    crossing: tuple[float, float] = (0.0, 0.0),
) -> Refusal:
    """The refusal of a photo whose best lattice, and whose best rows, explain it no better than chance.

    `one_way` is the share of all segments' length that runs in one direction, `crossing` those that run in
    two directions at right angles, the larger one first, where that was looked at.
    """
    families = [(0.0, 0.0, 0.0)]
    if best is not None:
        families.append((max(best.evidence_nats), min(best.evidence_nats), 0.5 * TESTED_NATS))
    if rows is not None:
        families.append((*rows.paving.evidence_nats, FALSE_ALARM_NATS))
    clearer, other, least = max(families)
    if clearer > 0.5 * TESTED_NATS + FALSE_ALARM_NATS:
        return Refusal(
            "one_direction",
            "only one family of parallel joints repeats here, and the joints across it could be chance, so "
            "the pose is not determined; take a photo that shows joints in both directions",
            measured=round(other, 2),
            limit=round(least, 2),
        )
    if one_way > ONE_WAY:
        return Refusal(
            "one_direction",
            f"{100 * one_way:.0f} % of the edges in this picture run in one direction, as boards do, "
            "so the pose is not determined; take a photo that shows joints in both directions",
            measured=round(one_way, 3),
            limit=ONE_WAY,
        )
    evidence = round(sum(best.evidence_nats), 2) if best else 0.0
    limit = round(TESTED_NATS + FALSE_ALARM_NATS, 2)
    if best is not None and len(best.presence.p) < FEW_SIDES and best.margin_nats > -0.5 * TESTED_NATS:
        return Refusal(
            "too_few_joints",
            f"a lattice may be there, but only {len(best.presence.p)} slab sides are in view, too few to "
            "tell it from chance; step back or tilt the camera so that more slabs are seen",
            measured=evidence,
            limit=limit,
        )
    nats = "evidence in nats, against what as many tried lattices reach by luck once in a thousand photos"
    said = (
        f"no lattice of slabs explains this picture better than chance ({nats}); take a photo in which two "
        "or more rows of slabs and their cross joints are clearly seen"
    )
    if sum(crossing) > CROSSING and crossing[1] > RARER:
        said = (
            f"{100 * sum(crossing):.0f} % of the edges in this picture run in two directions at right angles "
            "as joints do, but no even spacing explains them: slabs may be of several sizes, or courses of "
            f"several widths ({nats}); photograph slabs of one size, or rows of one width"
        )
    return Refusal("no_lattice", said, measured=evidence, limit=limit)


def not_measured(sides: int) -> Refusal:
    """The refusal of joints, of so many slab sides, that are seen at detection scale alone."""
    return Refusal(
        "no_lattice",
        f"what looks like {sides} sides of slabs where the picture is made smaller cannot be measured as "
        "joints at the photo's own resolution, as where slabs are of several sizes; photograph two or more "
        "rows of slabs of one size, and more sharply",
    )


def hardly_met(paving: Paving, missed: float) -> Refusal | None:
    """The refusal of a lattice that is hardly better than chance, and at whose joints there mostly are none.

    `missed` is the share that is not met at the photo's own resolution, of the family with more of them; None
    where there is no such doubt.
    """
    if paving.margin_nats >= DOUBTFUL_NATS or missed <= MOST_OF_DOUBTFUL:
        return None
    return Refusal(
        "no_lattice",
        "a lattice of slabs is seen that is hardly clearer than chance, and at the photo's own resolution "
        f"{100 * missed:.0f} % of its joints in one direction are not there; take a photo that shows more "
        "slabs of one size, or more sharply",
        measured=round(missed, 2),
        limit=MOST_OF_DOUBTFUL,
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


def grooved(heavier: Heavier) -> Refusal | None:
    """The refusal of a told slab whose size may be that of slabs, or of what lies between their grooves.

    None where no joints are heavier in turn than those between them.
    """
    if heavier.period == 1:
        return None
    return Refusal(
        "ambiguous",
        f"{_said_heavier(heavier)}: the photo does not tell which of the two --slab is the size of, and all "
        f"lengths would be {heavier.period} times as large by the other; give --camera-height instead, or "
        "photograph slabs without grooves",
        measured=round(heavier.times, 2),
        limit=HEAVIER,
    )


def maybe_grooves(heavier: Heavier) -> tuple[str, ...]:
    """The warning of a lattice that may be of what grooves leave of its slabs, where no slab was told."""
    if heavier.period == 1:
        return ()
    return (f"{_said_heavier(heavier)}: the slabs may be {heavier.period} times as large as this lattice",)


def _said_heavier(heavier: Heavier) -> str:
    times = "many" if heavier.times >= MOST_TIMES else f"{heavier.times:.1f}"
    return (
        f"one joint in {heavier.period} is {times} times as wide and dark as those between, which may be "
        "grooves in the slabs"
    )


def maybe_wall(fit: Fit, covariance: Float[np.ndarray, "6 6"] | None = None) -> Refusal | None:
    """The refusal of courses seen from the front, level in the picture: a brick wall as likely as a floor.

    With the pose's covariance those that may as well be seen from the front are refused too, and so is what
    recedes downwards: the wall below the eye of somebody who looks down. So are courses that are ground only
    for a camera that was rolled far, and a wall for one that was held upright. Squares may be those of a
    board that somebody holds up.
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
    if stack:
        return None
    if tilt_deg > FRONTAL_DEG and like_upright_wall(R):
        return _upright(R)
    if skew_deg > LEVEL_DEG:
        return None
    if tilt_deg > FRONTAL_DEG:
        return _upside_down(R) if R[1, 2] > 0 else None
    return Refusal(
        "not_ground",
        f"these courses lie level in the picture and are seen from the front ({np.rad2deg(tilt):.0f} "
        "degrees aslant) as those of a wall are, and the photo does not tell whether it is one; give "
        "--ground if this is the ground, or photograph it more from the side, or with the camera turned by "
        "some degrees",
        measured=round(skew_deg, 2),
        limit=LEVEL_DEG,
    )


def _upright(R: Float[np.ndarray, "3 3"]) -> Refusal:
    """The refusal of joints that stand upright in the picture, on a plane that is no ground unless rolled."""
    return Refusal(
        "not_ground",
        f"{_said_upright(R)}; turn the photo if it does not stand upright, give --ground if this is the "
        "ground all the same, or photograph that",
        measured=round(roll_deg(R), 1),
        limit=round(float(np.rad2deg(MAX_ROLL_RAD)), 1),
    )


def upright(fit: Fit) -> tuple[str, ...]:
    """The warning of a lattice that may be a wall's, where no other ground was found."""
    R = fit.cam_from_ground.R
    if not like_upright_wall(R):
        return ()
    return (
        f"{_said_upright(R)}: look at overlay.png; turn the photo, and its camera with it, if it does not "
        "stand upright, and photograph the ground if this is a wall",
    )


def _said_upright(R: Float[np.ndarray, "3 3"]) -> str:
    return (
        "these joints stand upright in the picture as those of a wall do, and are the ground's only if the "
        f"camera was rolled by {roll_deg(R):.0f} degrees"
    )


def _upside_down(R: Float[np.ndarray, "3 3"]) -> Refusal:
    """The refusal of joints that lie level and recede downwards."""
    below_deg = float(np.rad2deg(np.arcsin(R[1, 2])))
    return Refusal(
        "not_ground",
        f"these joints lie level and recede downwards ({below_deg:.0f} degrees), as those of a wall do that "
        "the camera looks down on; turn the photo if it stands on its head, give --ground if this is the "
        "ground all the same, or photograph that",
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


def _named(paving: Paving) -> str:
    grid = paving.grid
    height = float(paving.fit.cam_from_ground.origin_in_a[2])
    bond = f"running bond with shift {grid.shift:.2f}" if grid.shift else "stack bond"
    return f"{bond} of {(grid.spacing_x or 0.0) / height:.3f} x {grid.spacing_y / height:.3f} camera heights"
