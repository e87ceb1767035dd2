"""How courses that lie aside, drift or are askew move the joints' measured middles.

Paving is laid course by course, along strings. A course lies aside by itself, and each goes on from where the
one before it lies, so that their places drift. These are columns of the mixed model's random effects, in
pixels, each for a size of one.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.fitting.bare_steps import without_joints
from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.ground.stations import Stations
from autoreg.numbering import numbered
from autoreg.slabs.measured_joints import MeasuredJoints

# What courses drift by is drawn by so many waves, from half a wave over all of them on: shorter ones are no
# larger than what each lies aside by itself.
WAVES = 6
# Strings are drawn from one end of a course to the other, each of which drifts by itself: at the ends of what
# is seen of a course, the places differ from its middle's by such a share of what that drifts by, in so many
# waves.
ENDS, WAVES_OF_ENDS = 0.5, 4


class _Laid(NamedTuple):
    """Joints of one family, the courses that they were laid with, and how far along these they lie.

    The courses run along the family's `own` lines, or across them: then it is their ends that lie in a line.
    """

    members: Bool[np.ndarray, " n"]
    course: Int[np.ndarray, " n"]
    along: Float[np.ndarray, " n"]
    own: bool


def course_effects(joints: MeasuredJoints) -> Float[np.ndarray, "k c"]:
    """Pixels that joints move where courses lie aside by a unit: each by itself, and a family's together.

    Across the unbroken joints of a running bond it is the cross joints of one course that lie in line. Where
    all joints are lines, what the strings are squared and spaced by lies aside as well.
    """
    grid, stations = joints.fit.grid, joints.fit.stations.take(joints.rows)
    in_course = (stations.family == ALONG_Y) & (grid.shift != 0)
    line = np.where(in_course, stations.cell, stations.line)
    member, names = numbered(stations.family, line)
    moved = np.zeros((len(joints.rows), len(names)))
    moved[np.arange(len(member)), member] = 1.0
    if _is_stack(grid):
        moved = np.concatenate([moved, _askew(stations)], 1)
    return joints.middles_only(moved * joints.px_per_unit[:, None])


def drift_effects(joints: MeasuredJoints) -> Float[np.ndarray, "k d"]:
    """Pixels that joints move where the places of courses change by a unit from each to the next.

    That is a random walk, drawn by its principal components (Karhunen-Loeve): half waves over the courses in
    view, whose sizes go down as their lengths do. Long ones are what a pose that is a little tilted imitates.
    Tiles that meet without a joint are printed, or leave no room for it.
    """
    stations = joints.fit.stations.take(joints.rows)
    moved = [np.zeros((len(joints.rows), 0))]
    for laid in _laid(joints.fit, stations):
        first, last = int(laid.course[laid.members].min()), int(laid.course[laid.members].max())
        count = last - first + 1
        wave = np.arange(1, min(WAVES, count - 1) + 1)
        place = (laid.course - first + 0.5) / count
        walk = np.sqrt(2.0 * count) / (np.pi * wave) * np.cos(np.pi * wave * place[:, None])
        moved.append(walk * laid.members[:, None])
        if laid.own:
            to_ends = np.zeros(len(walk))
            to_ends[laid.members] = _to_ends(laid.along[laid.members])
            of_ends = np.column_stack([np.ones(len(walk)), walk[:, :WAVES_OF_ENDS]])
            moved.append(ENDS * of_ends * to_ends[:, None])
    return joints.middles_only(np.concatenate(moved, 1) * joints.px_per_unit[:, None])


def _is_stack(grid: Grid) -> bool:
    return grid.spacing_x is not None and grid.shift == 0


def _laid(fit: Fit, stations: Stations) -> Iterator[_Laid]:
    """The courses of a lattice with joints: along X, or where all joints are lines along either axis."""
    ways, bare = (ALONG_X, ALONG_Y) if _is_stack(fit.grid) else (ALONG_X,), without_joints(fit)
    for way in ways:
        for family in (ALONG_X, ALONG_Y):
            members = stations.family == family
            if members.any() and family not in bare:
                course = stations.line if family == way else stations.cell
                yield _Laid(members, course, stations.ground[:, way], family == way)


def _to_ends(places: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Where places lie between the first and the last of them along each axis, from -1 to 1."""
    low, high = places.min(0), places.max(0)
    return (2.0 * places - low - high) / np.maximum(high - low, 1e-9)


def _askew(stations: Stations) -> Float[np.ndarray, "n 4"]:
    """Ground distances by which stations move whose family is askew by a unit at its ends, or fans out.

    That shows in no residual, since a pose that is a little tilted imitates it.
    """
    moved = np.zeros((len(stations), 4))
    for family in (ALONG_X, ALONG_Y):
        own = np.flatnonzero(stations.family == family)
        if len(own):
            ground = stations.ground[own][:, [family, 1 - family]]
            along, across = _to_ends(ground).T
            moved[own, 2 * family : 2 * family + 2] = np.stack([along, along * across], 1)
    return moved
