"""Cross joints between rows: segments square to the unbroken joints, and how far off square each is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammainc

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.ground.points import inside_box, on_ground
from autoreg.ground.sides import ALONG_Y, Grid
from autoreg.segments import Segments
from autoreg.spread import spread

# Cross joints lie this close to the right angle; segments that lie this far from either direction show how
# many would by chance.
RIGHT_RAD, OBLIQUE_RAD = np.radians(4.0), np.radians(15.0)
# Length of a cross joint's segments, in widths of a row.
SHORTEST, LONGEST = 0.3, 1.4
# Longer segments at right angles are joints that run on through what then are no rows: their share of the
# length is 0.03 at the most in rows, and 0.4 to 0.6 where the ends of boards were taken for rows. Fewer of
# them than this are a kerb or a shadow.
MOST_LONGER, FEWEST_LONGER = 0.3, 4
# Segments this close along a row, in its widths, are of one joint: they are its edges, or parts of them.
ONE_JOINT = 0.15
# Those this close to one of the row before it are of a line that runs on: the mirror image of a window, or a
# shadow, on boards that have no cross joints at all.
RUNS_ON = 0.3
# Segments within this share of a slab of a lattice's cross joint, or of its edges, are of it.
BESIDE_JOINT = 0.03
# Segments that lean by less tell how far the cross joints lean together.
LEANING_RAD = np.radians(20.0)
# Those that lean by less tell how their lean changes from row to row, as it does where they stand on arcs.
FANNED_RAD = np.radians(35.0)
# Cross joints stand in columns about as far apart as the rows, or in some that move on evenly from row to
# row, where their places have so much power at such a period (Scargle 1982: exponential where they have none,
# twice that where each joint is seen as two edges), and this share of all they can have: those of random
# ashlar have 0.18 at the most, those of a herringbone drive 0.30 at least. A focal length that is not known
# yet leaves it open how far apart columns of the rows' width are seen.
COLUMNS_POWER, COLUMNS_SHARE = 30.0, 0.25
COLUMNS_PER_WIDTH, MOVES = np.linspace(0.7, 1.4, 141), np.arange(32) / 32
# Fewer cross joints than this do not tell their own scatter.
FEWEST_JOINTS = 8
# Standard deviation of a median of normal values, per that of their mean.
MEDIAN_LOSS = 1.2533


@dataclass(frozen=True)
class CrossJoints:
    """Segments at right angles to the unbroken joints: where they lie, and their evidence against chance.

    `longer` is the share of the length of segments at right angles that is of some which are longer than a
    cross joint may be; zero where these are few.
    """

    middle: Float[np.ndarray, "n 2"]
    evidence_nats: float
    longer: float = 0.0

    @property
    def run_through(self) -> bool:
        """Whether so many joints at right angles run on through several rows that these are none."""
        return self.longer > MOST_LONGER


@dataclass(frozen=True)
class OffSquare:
    """Segments of cross joints: how far each is off square in radians, and the noise of that by its ends.

    `joint` numbers the joint that each is of; a positive angle leads a segment away from the camera to +X.
    """

    ends_px: Float[np.ndarray, "n 2 2"]
    middle: Float[np.ndarray, "n 2"]
    angle: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]
    joint: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, some: Bool[np.ndarray, " n"]) -> OffSquare:
        """Some of the segments."""
        return OffSquare(
            *(value[some] for value in (self.ends_px, self.middle, self.angle, self.noise, self.joint))
        )


@dataclass(frozen=True)
class Lean:
    """How far the cross joints lean together, and the standard deviation of that, in radians.

    The joints of rectangular slabs lean where their camera is not the one that they are seen with: a stack
    bond then looks like a running one whose courses move on by a little each, and suits it as well as can be
    at the unbroken joints.
    """

    angle: float
    sigma: float

    def clear_deg(self, most_deg: float, sure_sigmas: float) -> float | None:
        """Its size in degrees where it is at least so large, and surely more than none; else None."""
        degrees = float(np.degrees(abs(self.angle)))
        return None if degrees < most_deg or abs(self.angle) < sure_sigmas * self.sigma else degrees


def find_cross_joints(
    segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"], size: tuple[int, int]
) -> CrossJoints:
    """Segments of the field at right angles to the unbroken joints, against those of any direction.

    Of those that run on from row to row the first counts alone.
    """
    index, ground = _in_field(segments, fit.camera.scaled(*size), fit, field, longest=np.inf)
    along = ground[:, 1] - ground[:, 0]
    fitting = np.linalg.norm(along, axis=1) < LONGEST * fit.grid.spacing_y
    angle = np.abs(np.arctan2(along[:, 1], along[:, 0])) % np.pi
    off_right = np.abs(angle - np.pi / 2)
    crossing, length_px = off_right < RIGHT_RAD, segments.length_px[index]
    beyond = crossing & ~fitting
    longer = (
        float(length_px[beyond].sum() / length_px[crossing].sum()) if beyond.sum() >= FEWEST_LONGER else 0.0
    )
    right = crossing & fitting
    oblique = (off_right > OBLIQUE_RAD) & (off_right < np.pi / 2 - OBLIQUE_RAD) & fitting
    # A half observed besides keeps an empty field from proving anything.
    expected = (oblique.sum() + 0.5) * RIGHT_RAD / (np.pi / 2 - 2 * OBLIQUE_RAD)
    middle = ground[right].mean(1)
    found = int((~running_on(middle / fit.grid.spacing_y)).sum())
    # The chance of as many or more in a Poisson distribution; scipy.stats would take half a second to import.
    chance = float(gammainc(found, expected)) if found else 1.0
    return CrossJoints(middle, float(-np.log(max(chance, 1e-87))), longer)


def running_on(middle: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Which segments run on from one of the row before, by their middles in widths of a row."""
    if len(middle) == 0:
        return np.zeros(0, dtype=bool)
    # One number tells the row and the place in it, with room between the rows.
    along = middle[:, 0] - middle[:, 0].min()
    apart = along.max() + 2.0 * RUNS_ON + 1.0
    key = apart * np.floor(middle[:, 1]) + along
    ordered = np.sort(key)
    first, last = (np.searchsorted(ordered, key - apart + way * RUNS_ON) for way in (-1.0, 1.0))
    return last > first


def in_columns(cross: CrossJoints, width: float) -> bool:
    """Whether cross joints stand in common columns about as far apart as the rows.

    Those of rows follow no period. Those of herringbone do: its joints lie on a grid of squares either way.
    """
    n = len(cross.middle)
    if n <= COLUMNS_POWER:
        return False
    place, row = cross.middle[:, 0] / width, np.floor(cross.middle[:, 1] / width)
    along, across = (
        np.exp(2j * np.pi * np.outer(*pair)) for pair in ((COLUMNS_PER_WIDTH, place), (MOVES, row))
    )
    power = float((np.abs(along @ across.T) ** 2).max()) / n
    return power > max(COLUMNS_POWER, COLUMNS_SHARE * n)


def off_square(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"], within_rad: float) -> OffSquare:
    """The field's segments that are off the right angle by less than `within_rad`.

    Both ends' noise is taken as independent; the fit is at the photo's own resolution.
    """
    camera, pose = fit.camera, fit.cam_from_ground
    index, ground = _in_field(segments, camera, fit, field)
    angle = off_angle(ground)
    near = np.abs(angle) < within_rad
    index, ground, angle = index[near], ground[near], angle[near]
    ends_px = segments.ends_px[index]
    across = ends_px[:, 1] - ends_px[:, 0]
    across = across[:, ::-1] * [-1.0, 1.0] / np.linalg.norm(across, axis=1, keepdims=True)
    moved = np.stack([ends_px, ends_px])
    moved[0, :, 0] += across
    moved[1, :, 1] += across
    by_end = np.stack([off_angle(on_ground(ends, camera, pose)) for ends in moved]) - angle
    noise = segments.sigma_px[index] * np.hypot(*by_end)
    middle = ground.mean(1)
    return OffSquare(ends_px, middle, angle, noise, _joints(middle, fit.grid.spacing_y))


def common_lean(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"]) -> Lean | None:
    """The median lean of the field's cross joints; None where too few are seen.

    Of a lattice only what lies on its cross joints counts: the shadows of a railing's bars run across
    anywhere. The fit is at the photo's own resolution.
    """
    seen = off_square(segments, fit, field, LEANING_RAD)
    if fit.grid.spacing_x is not None:
        seen = seen.take(_on_cross_joints(seen.middle, fit.grid, fit.strip.width[ALONG_Y]))
    return _lean_of(seen)


def change_of_lean(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"]) -> Lean | None:
    """By how much more the cross joints of the field's last rows lean than those of its first ones.

    They are of the outer thirds of all that is seen of them; None where these are too few. Joints across
    arcs that repeat along a line, as those of fans do, turn with each of these rows.
    """
    seen = off_square(segments, fit, field, FANNED_RAD)
    if len(seen) == 0:
        return None
    low, high = np.quantile(seen.middle[:, 1], [1 / 3, 2 / 3])
    first, last = (
        _lean_of(seen.take(near)) for near in (seen.middle[:, 1] <= low, seen.middle[:, 1] >= high)
    )
    if first is None or last is None:
        return None
    return Lean(last.angle - first.angle, float(np.hypot(first.sigma, last.sigma)))


def _lean_of(seen: OffSquare) -> Lean | None:
    """The median angle of some cross joints, if they are enough."""
    joints = len(np.unique(seen.joint))
    if joints < FEWEST_JOINTS:
        return None
    return Lean(float(np.median(seen.angle)), MEDIAN_LOSS * spread(seen.angle) / float(np.sqrt(joints)))


def off_angle(ground: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, " n"]:
    """Angle of each segment from the Y axis, between -pi/2 and pi/2, growing towards +X."""
    along = ground[:, 1] - ground[:, 0]
    return np.arctan(along[:, 0] / np.where(along[:, 1] == 0, 1e-300, along[:, 1]))


def _on_cross_joints(place: Float[np.ndarray, "n 2"], grid: Grid, width: float) -> Bool[np.ndarray, " n"]:
    """Which places lie on cross joints of a lattice, whose joints are so wide, or beside them by little."""
    assert grid.spacing_x is not None
    slab = place[:, 0] / grid.spacing_x - grid.shift * np.floor(place[:, 1] / grid.spacing_y)
    return np.abs(slab - np.rint(slab)) < BESIDE_JOINT + 0.5 * width / grid.spacing_x


def _in_field(
    segments: Segments,
    camera: Camera,
    fit: Fit,
    field: Float[np.ndarray, "k 2"],
    *,
    longest: float = LONGEST,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2 2"]]:
    """Index and ground ends of the field's segments that are as long as a cross joint, or up to `longest`.

    A cross joint lies between two unbroken ones, and is a good part of a row long. Lengths are in rows.
    """
    ground = on_ground(segments.ends_px, camera, fit.cam_from_ground)
    middle = ground.mean(1)
    length = np.linalg.norm(ground[:, 1] - ground[:, 0], axis=1) / fit.grid.spacing_y
    index = np.flatnonzero(inside_box(middle, field) & (length > SHORTEST) & (length < longest))
    return index, ground[index]


def _joints(middle: Float[np.ndarray, "n 2"], across: float) -> Int[np.ndarray, " n"]:
    """Which joint each segment is of: those of a row that follow each other closely are of one."""
    row = np.floor(middle[:, 1] / across)
    order = np.lexsort((middle[:, 0], row))
    new = (np.diff(row[order]) != 0) | (np.diff(middle[order, 0]) > ONE_JOINT * across)
    joint = np.empty(len(middle), dtype=np.int64)
    joint[order] = np.concatenate([[0], np.cumsum(new)])[: len(middle)]
    return joint
