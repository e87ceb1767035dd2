"""How irregular slabs, relief, bright tiles and bent ground change the joints' measured middles and widths.

These are the columns of the mixed model's random effects, in pixels, each for a size of one.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_matrix

from autoreg.fitting.bare_steps import across_slope, only_steps, without_joints
from autoreg.grey_levels.joint_image import SOON
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.numbering import numbered
from autoreg.slabs.measured_joints import MeasuredJoints
from autoreg.slabs.quadric import Quadric

# Slope across the joint (ground distance over camera height) at which the relief stops growing.
KNEES = (0.4, 0.8, 1.6, 3.2, 8.0)
# A dark wall hides the bed as well, but shows where the joint ends once it has hidden it all: slopes at which
# it is half hidden, that at which nothing is left of it as a multiple of these, and the size of such shifts.
HALF_HIDDEN, HIDDEN, DARK_WALL = (0.5, 0.9, 1.6), 2.2, 0.3
# The same moves a joint's middle by more than the widths show, since what is left is darkest beside the near
# slab: by such a share of the width.
DARK_SIDE_SLOPES, DARK_SIDE_END, DARK_SIDE = (0.8, 1.3), 2.5, 0.04
# Where a joint is hardly wider than so many blurs its middle is that of its darkness, not of its edges, and
# moves by another share of the width.
BLURRED_BLURS, BLURRED_SIDE = 2.5, 0.02
# ... from wherever it is seen: beds and bevels in the shade are seen apart where joints are wider, and are
# one dark line where they are narrower, so that this share sets in soon. Without it, of 111 ray-traced photos
# by six hands 95 % regions held 88 % of the turns and of the poses, with it 91 % and 93 %, no less exact.
BLURRED_ASIDE, SOON_BLURRED = 0.1, 4
# Walls that are lit, shaded and dark in parts have yet other shapes: any that changes between these slopes.
BUMP_SLOPES, BUMP = (0.2, 0.4, 0.7, 1.1, 1.6, 2.3, 3.2, 4.5), 0.015
# Walls hide a part of the bed, and never lay more of it bare. Shifts of a standard deviation that are all to
# one side have this mean. Without it the camera is found too high, by 0.7 standard deviations at the median
# of ray-traced pavings.
HIDING = 0.8
# Shift of a joint's far edge by a shadow on the bed, against that by a lit wall, and the near edge's against
# the far one's.
FAR_SHADE, NEAR_SHADE = 0.4, 0.2
# What all joints of a family may be off by together, as a share of their width, and the slope besides SOON at
# which this differs most: real walls and shadows have shapes that are not drawn, as ray-traced pavings show.
TOGETHER, LATE = 0.03, 4.0
# Where a family shows as steps of tone only, these lie at a rim of its joints, may be off together by more,
# and by less of the shifts that the other family's widths tell, since no widths of their own say how far.
STEPS_TOGETHER, STEPS_RELIEF = 0.2, 0.25
# Light joints lie in the shadow of their slabs' rims, of which nothing is seen on a dark bed: where they are
# a millimetre deep it takes some hundredths of a usual width.
LIGHT_TOGETHER = 0.05
# What joints that were measured from their near rims may be off by together, as a share of their width. Their
# walls are allowed for already: no relief is asked of them.
RIMMED_TOGETHER = 0.05
# Slabs' rims may be bevelled or worn, which no residual shows: the joint then ends where the bevels do, or
# where the one in the light begins, and what fills it lies below the slabs. By such shares of its width it
# may lie aside, each family by itself, and lower than they. On ray-traced pavings with bevelled and worn rims
# by two hands joints lie 0.10 and 0.14 of it aside (median; RMS 0.23 and 0.41), and 0.12 and 0.10 lower (RMS
# 0.20 and 0.22); on those with sawn rims 0.02 to 0.05 aside, and as high as the slabs.
RIM_ASIDE, RIM_BELOW = 0.2, 0.2
# Joints that were measured to the outer edges of bevels in the light still lie aside by such a share of them,
# and the others of the photo, whose bevels do not show, by such a share; all lie lower than the slabs.
SEEN_ASIDE, UNSEEN_ASIDE, BEVEL_BELOW = 0.3, 0.7, 0.4
# Combinations of effects that are this small beside the largest are left out.
LEAST_EFFECT = 0.005
# What tells that joints look narrower aslant: so many of them, whose widths differ by such a share among
# themselves, and a slope of so many standard deviations.
FEWEST_SEEN, UNEVEN_SHARE, CLEAR_SIGMAS = 10, 0.02, 3.0
# What is not known of the joints' full width, as a share of it, and what a wrong blur adds to it.
WIDTH_SIGMA, BLUR_PX = 0.1, 0.15


def slab_effects(joints: MeasuredJoints) -> tuple[csr_matrix, ...]:
    """Pixels by which its two slabs change each measurement, per unit of their places, heights and turns.

    Every slab moves its own edge of the joint. Turns are in units of one over a slab's side.
    """
    (a, b), side = joints.fit.grid.slab_size, joints.fit.grid.slab_side
    fit, wide, n = joints.fit, joints.wide, len(joints.rows)
    stations = fit.stations.take(joints.rows)
    along_x = stations.family == ALONG_X
    rows, columns, lever = [], [], []
    for beyond in (0, 1):
        row = np.where(along_x, stations.line - 1 + beyond, np.floor(stations.ground[:, 1] / b)).astype(int)
        place = stations.ground[:, 0] / a - row * fit.grid.shift
        column = np.where(along_x, np.floor(place), np.round(place) - 1 + beyond).astype(int)
        middle = np.stack([(column + 0.5 + row * fit.grid.shift) * a, (row + 0.5) * b], 1)
        away = stations.ground - middle
        # A positive turn moves a slab's sides along X by +x, those along Y by -y.
        lever.append(np.where(along_x, away[:, 0], -away[:, 1]) / side)
        rows.append(row)
        columns.append(column)
    slab, names = numbered(np.concatenate(rows), np.concatenate(columns))
    slab = slab.reshape(2, n)
    row = np.concatenate([np.tile(np.arange(n), 2), np.tile(n + np.arange(len(wide)), 2)])

    def effect(value: np.ndarray, column: np.ndarray, count: int) -> csr_matrix:
        moves = value * joints.px_per_unit
        data = np.concatenate([0.5 * moves.ravel(), -moves[0, wide], moves[1, wide]])
        columns = np.concatenate([column.ravel(), column[:, wide].ravel()])
        return csr_matrix((data, (row, columns)), shape=(n + len(wide), count))

    ones = np.ones((2, n))
    return (
        effect(ones, 2 * slab + stations.family, 2 * len(names)),
        effect(ones * _slope(joints), slab, len(names)),
        effect(np.stack(lever), slab, len(names)),
    )


def _slope(joints: MeasuredJoints) -> Float[np.ndarray, " n"]:
    """How far a unit of height moves each station across its joint, seen from the camera."""
    return across_slope(joints.fit)[joints.rows]


def relief_effects(
    joints: MeasuredJoints,
) -> tuple[Float[np.ndarray, "n r"], Float[np.ndarray, " r"]]:
    """Pixels by which the relief changes each measurement, for a shift of the far edge by about a width.

    With them the mean of their sizes, of which each has a standard deviation of one.

    A wall's light is the same all over what the sun reaches, and all over a shadow, so that each of the four
    directions has one shift of the far edge in either, which grows with the slope of the view until the bed
    is hidden. A shadow on the bed moves an edge even from above: a far one more, since of the bed beside a
    near one little is seen.
    """
    slope, family = _slope(joints), joints.fit.stations.family[joints.rows]
    steep, facing = np.abs(slope), np.where(slope < 0, -1.0, 1.0)
    steps, bare = only_steps(joints.fit), without_joints(joints.fit)
    full = np.where(joints.fit.rimmed[joints.rows], 0.0, _full_width_px(joints))
    fading = [FAR_SHADE * np.ones_like(slope)]
    fading += [0.7 * FAR_SHADE * np.maximum(0.0, 1.0 - steep / knee) for knee in (0.8, 2.0)]
    walls = [np.minimum(steep / knee, 1.0) / np.sqrt(len(KNEES)) for knee in KNEES]
    walls += [DARK_WALL * _hump(steep, peak, HIDDEN) for peak in HALF_HIDDEN]
    far, near, expected = [], [], []
    for own in (ALONG_X, ALONG_Y):
        for way, light in product((-1.0, 1.0), joints.lights):
            mine = full * (light & (family == own)) * (STEPS_RELIEF if own in steps else 1.0)
            there = facing == way
            far += [mine * there * shift for shift in (*walls, *fading)]
            nearer = 0.0 if own in bare else -way * HIDING
            expected += [nearer] * len(KNEES) + [0.0] * (len(walls) - len(KNEES) + len(fading))
            # The edge on one side of a joint is the far one for some stations, the near one for others.
            near += [np.zeros_like(slope)] * len(walls) + [mine * ~there * NEAR_SHADE * f for f in fading]
    beyond, before = np.stack(far, 1), np.stack(near, 1)
    width = facing[joints.wide, None] * (beyond - before)[joints.wide]
    effects = np.concatenate([0.5 * (beyond + before), width])
    axes = _main_axes(effects)
    return effects @ axes, np.array(expected) @ axes


def narrowing(joints: MeasuredJoints) -> float:
    """By what share of their width joints look narrower at a slope of one than from above, at the most.

    Each family is asked by itself, and each way that it is seen: a wall in the light hides a part of the bed
    that grows with the slope. Zero where nothing speaks for it.
    """
    rows, full = joints.wide, _full_width_px(joints)[joints.wide]
    slope, family = _slope(joints)[rows], joints.fit.stations.family[joints.rows][rows]
    lost, noise = (v[len(joints.rows) :] / full for v in (joints.off_px, joints.noise_px))
    found = 0.0
    for own in (ALONG_X, ALONG_Y):
        for way in (-1.0, 1.0):
            some = np.flatnonzero((family == own) & (way * slope > 0))
            if len(some) < FEWEST_SEEN:
                continue
            weight = 1.0 / np.hypot(noise[some], UNEVEN_SHARE)
            columns = np.stack([weight, weight * np.abs(slope[some])], 1)
            covariance = np.linalg.pinv(columns.T @ columns)
            rise = float((covariance @ (columns.T @ (weight * lost[some])))[1])
            if rise > CLEAR_SIGMAS * np.sqrt(covariance[1, 1]):
                found = max(found, rise)
    return found


def _hump(steep: Float[np.ndarray, " n"], peak: float, end: float) -> Float[np.ndarray, " n"]:
    """A shift that grows with the slope of the view to one, and is gone at so many times that slope."""
    return np.interp(steep, [0.0, peak, end * peak], [0.0, 1.0, 0.0])


def common_effects(joints: MeasuredJoints) -> Float[np.ndarray, "n r"]:
    """Pixels by which the joints of a family may lie off together, whatever their widths are.

    Alike, or by how steeply they are seen, or by how much of them is blur; those seen from one side also by
    how their walls look.
    """
    fit, slope, full = joints.fit, _slope(joints), _full_width_px(joints)
    family, steps = fit.stations.family[joints.rows], only_steps(fit)
    rimmed = fit.rimmed[joints.rows]
    soon, late = (np.clip(slope / knee, -1.0, 1.0) for knee in (SOON, LATE))
    shapes = np.stack([np.ones_like(slope), np.abs(soon), soon, late], 1)
    blurs = full / (BLURRED_BLURS * fit.strip.blur_px)
    walls, line = _wall_shapes(np.abs(slope), 1.0 / (1.0 + blurs**2)), 1.0 / (1.0 + blurs**SOON_BLURRED)
    own: list[np.ndarray] = []
    for each, light in product((ALONG_X, ALONG_Y), joints.lights):
        mine = full * (light & (family == each))
        unseen = LIGHT_TOGETHER if fit.strip.polarity[each] > 0 else TOGETHER
        together = np.where(rimmed, RIMMED_TOGETHER, STEPS_TOGETHER if each in steps else unseen)
        own += [shapes * (together * mine)[:, None], (BLURRED_ASIDE * line * mine)[:, None]]
        own += [walls * (way * mine * (way * slope > 0))[:, None] for way in (-1.0, 1.0)]
    effects = np.concatenate(own, 1)
    return joints.middles_only(effects @ _main_axes(effects))


def rim_effects(joints: MeasuredJoints) -> Float[np.ndarray, "k 5"]:
    """Pixels by which joints lie aside, family by family, and lower than the slabs, with bevelled rims.

    Where bevels of some joints were seen, the others have them too; what those still lie aside comes last.
    """
    fit, full = joints.fit, _full_width_px(joints)
    family, bare, bevel = fit.stations.family[joints.rows], without_joints(fit), fit.bevel[joints.rows]
    full = np.where(np.isin(family, bare), 0.0, full)
    wide = float(bevel.max(initial=0.0)) * joints.px_per_unit
    aside = np.where(bevel > 0, SEEN_ASIDE * wide, np.maximum(RIM_ASIDE * full, UNSEEN_ASIDE * wide))
    own = np.stack([aside * (family == each) for each in (ALONG_X, ALONG_Y)], 1)
    seen = (bevel > 0)[:, None]
    below = np.maximum(RIM_BELOW * full, BEVEL_BELOW * wide) * _slope(joints)
    return joints.middles_only(np.column_stack([own * ~seen, below, own * seen]))


def _wall_shapes(
    steep: Float[np.ndarray, " n"], blurred: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n r"]:
    """Shares of their width by which walls that no width tells may move the joints seen from one side.

    Joints are seen so `steep`, and are `blurred` by so much: one where they are nothing but blur.
    """
    dark = np.stack([_hump(steep, peak, DARK_SIDE_END) for peak in DARK_SIDE_SLOPES], 1)
    at, places = np.log(np.maximum(steep, 1e-3)), np.log(np.array(BUMP_SLOPES))
    bumps = np.stack([np.interp(at, places, only) for only in np.eye(len(places))], 1)
    return np.concatenate([DARK_SIDE * dark, BLURRED_SIDE * blurred[:, None] * dark, BUMP * bumps], 1)


def _main_axes(effects: Float[np.ndarray, "n r"]) -> Float[np.ndarray, "r s"]:
    """Combinations of effects, as few as have nearly the covariance of all."""
    square, V = np.linalg.eigh(effects.T @ effects)
    return V[:, square > LEAST_EFFECT**2 * square[-1]]


def _full_width_px(joints: MeasuredJoints) -> Float[np.ndarray, " n"]:
    """Width of the joints in the picture, as the widest show it, or else as a strip fits them all."""
    return (joints.width or float(np.mean(joints.fit.strip.width))) * joints.px_per_unit


def width_effects(joints: MeasuredJoints) -> Float[np.ndarray, "n r"]:
    """Pixels by which the widths are off for all joints alike, and for those of one family.

    A blur taken for another adds to all widths of a family alike.
    """
    own = joints.fit.stations.family[joints.rows][joints.wide]
    width, way = _full_width_px(joints)[joints.wide], np.where(own == ALONG_X, 1.0, -1.0)
    columns = [WIDTH_SIGMA * width, WIDTH_SIGMA * way * width, BLUR_PX * (way > 0), BLUR_PX * (way < 0)]
    return np.concatenate([np.zeros((len(joints.rows), len(columns))), np.stack(columns, 1)])


def bow_effects(joints: MeasuredJoints) -> Float[np.ndarray, "n 3"]:
    """Pixels that each station moves where the ground is bent along X, along Y, or twisted, by its extent."""
    ground = joints.fit.stations.ground[joints.rows]
    quadric = Quadric.over(ground)
    rise = quadric.extent * joints.px_per_unit * _slope(joints)
    return joints.middles_only(rise[:, None] * quadric.shapes(ground))


def bloom_effects(joints: MeasuredJoints) -> Float[np.ndarray, "n r"]:
    """Pixels that each station moves where bright tiles look larger by one, for families without joints."""
    fit, rows = joints.fit, joints.rows
    up, family = np.sign(fit.offsets.step[rows]), fit.stations.family[rows]
    bare = without_joints(fit)
    moved = (up * (family == np.array(bare)[:, None])).T if bare else np.zeros((len(rows), 0))
    return joints.middles_only(moved)
