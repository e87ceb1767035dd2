"""From a hypothesis of the ground's orientation to the slab lattice that lies on it.

The two families of joints are found as combs on the rectified ground; their common pose is refined by the
joints themselves; then the presence of every single slab side tells the bond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.periods import Comb, best_combs
from autoreg.presence import Pattern, Presence, best_pattern, side_presence, with_origin
from autoreg.rectify import Rectified, rectify
from autoreg.refine import Fit, Free, refine
from autoreg.stations import ALONG_X, ALONG_Y, Grid

# What a hypothesis must beat: spacings x phases of either family, times orientations of the ground.
TESTED_NATS = 2 * float(np.log(400 * 48)) + float(np.log(24))
# Chance of one false alarm in this many photos without a lattice.
FALSE_ALARM_NATS = float(np.log(1000.0))
# Sides of one unbroken line stand and fall together: a line counts as at most this many independent ones.
INDEPENDENT_SIDES = 3.0


@dataclass(frozen=True)
class Paving:
    """A lattice on the ground with the pose that sees it.

    `evidence_nats` is the logarithm of the likelihood ratio of this lattice to chance, for the sides along X
    and along Y, unpenalised.
    """

    fit: Fit
    presence: Presence
    evidence_nats: tuple[float, float]

    @property
    def grid(self) -> Grid:
        """The lattice."""
        return self.fit.grid

    @property
    def margin_nats(self) -> float:
        """Evidence beyond what the number of tested hypotheses demands."""
        return sum(self.evidence_nats) - TESTED_NATS - FALSE_ALARM_NATS


@dataclass(frozen=True)
class PlaneCombs:
    """One ground hypothesis with the joints found on it."""

    camera: Camera
    R: Float[np.ndarray, "3 3"]
    rectified: Rectified
    x: tuple[Comb, ...]
    y: tuple[Comb, ...]

    @property
    def score(self) -> float:
        """How much better the two best combs explain the plane than chance does."""
        return sum(combs[0].score for combs in (self.x, self.y) if combs)


def comb_plane(picture: np.ndarray, camera: Camera, R: Float[np.ndarray, "3 3"]) -> PlaneCombs | None:
    """The joints of both families on a hypothesised ground."""
    rectified = rectify(picture, camera, R)
    if rectified is None:
        return None
    return PlaneCombs(camera, R, rectified, best_combs(rectified.x), best_combs(rectified.y))


def lay_lattice(picture: Float[np.ndarray, "h w"], plane: PlaneCombs, *, free_focal: bool) -> Paving | None:
    """The lattice on a plane whose two families of joints were found."""
    if not plane.x or not plane.y:
        return None
    a, b = plane.y[0], plane.x[0]
    start = Rigid(plane.R, plane.R @ np.array([a.phase, b.phase, -1.0]))
    fit = refine(
        picture,
        plane.camera,
        start,
        Grid(a.spacing, b.spacing),
        free=Free(ratio=True, focal=free_focal),
        search=0.2,
        reaches=(2.5, 4.0, 7.0),
    )
    if fit is None:
        return None
    return settle_bond(picture, fit)


def settle_bond(picture: Float[np.ndarray, "h w"], fit: Fit) -> Paving | None:
    """The bond that the presence of the single sides shows, with the lattice's axes turned to suit it."""
    for _ in range(4):
        presence = side_presence(picture, fit.camera, fit.cam_from_ground, fit.grid, fit.strip)
        if len(presence.p) < 6:
            return None
        along_x, along_y = best_pattern(presence, ALONG_X)[0], best_pattern(presence, ALONG_Y)[0]
        changed = _with_pattern(fit, along_x, along_y)
        if changed is None:
            return Paving(fit, presence, _evidence(presence, fit.grid))
        fit = changed
    return Paving(fit, presence, _evidence(presence, fit.grid))


def _with_pattern(fit: Fit, along_x: Pattern, along_y: Pattern) -> Fit | None:
    """The fit with the lattice that a pattern of present sides means; None if it is the one it has."""
    grid, pose = fit.grid, fit.cam_from_ground
    a, b = grid.spacing_x, grid.spacing_y
    if a is None or grid.shift:
        return None
    if along_x.period == along_y.period == 1:
        return None
    if along_x.advance == 0 and along_x.period > 1:
        return replace(
            fit,
            grid=Grid(a, b * along_x.period),
            cam_from_ground=with_origin(pose, 0.0, along_x.phase * b),
        )
    if along_y.advance == 0 and along_y.period > 1:
        return replace(
            fit,
            grid=Grid(a * along_y.period, b),
            cam_from_ground=with_origin(pose, along_y.phase * a, 0.0),
        )
    if along_x.period == 1:
        return replace(
            fit,
            grid=Grid(a * along_y.period, b, along_y.advance / along_y.period),
            cam_from_ground=with_origin(pose, along_y.phase * a, 0.0),
        )
    if along_y.period == 1:
        # The unbroken joints run along Y: the new X axis is Y, the new Y axis is -X. The new course 0 is
        # the old column -1, hence the one advance in its phase.
        moved = with_origin(pose, 0.0, (along_x.phase - along_x.advance) * b)
        turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        shift = (-along_x.advance / along_x.period) % 1.0
        return replace(
            fit,
            grid=Grid(b * along_x.period, a, shift),
            cam_from_ground=Rigid(moved.R @ turn, moved.t),
            strip=replace(fit.strip, width=(fit.strip.width[1], fit.strip.width[0])),
        )
    return None


def _evidence(presence: Presence, grid: Grid) -> tuple[float, float]:
    """Log likelihood ratio of the lattice, per family, with the sides of a line taken together."""
    total: list[float] = []
    for family in (ALONG_X, ALONG_Y):
        rows = presence.sides.family == family
        line = presence.sides.line[rows]
        if family == ALONG_Y and grid.shift:
            line = line * 10_000 + presence.sides.cell[rows]
        _, inverse = np.unique(line, return_inverse=True)
        count = np.bincount(inverse)
        mean = np.bincount(inverse, weights=presence.llr[rows]) / np.maximum(count, 1)
        total.append(float((mean * np.minimum(count, INDEPENDENT_SIDES)).sum()))
    return total[0], total[1]
