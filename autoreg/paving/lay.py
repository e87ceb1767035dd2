"""From the combs on a hypothesised ground to the slab lattice that lies on it.

The common pose of both families of joints is refined by the joints themselves; then the presence of every
single slab side tells the bond.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine
from autoreg.geometry import Rigid
from autoreg.ground.ground_frame import turned
from autoreg.ground.rectify import near_reach, rectify
from autoreg.ground.sides import Grid, visible_sides
from autoreg.ground.sight import Look, Looks
from autoreg.paving.bond import BondHypothesis, bond_hypotheses
from autoreg.paving.corrections import by_measured_shifts
from autoreg.paving.lattice_choice import hopeful, of_true_bond, settle_bond
from autoreg.paving.lattice_evidence import Paving, presented, told_twice
from autoreg.paving.multiples import divided, slabs_in_one, too_long
from autoreg.paving.periods import Comb, best_combs
from autoreg.paving.plane_combs import PlaneCombs
from autoreg.paving.side_support import Effort, presence_of
from autoreg.solve.freedom import Free

# The most starts tried on one plane after its first.
MOST_STARTS = 6
# The most places at which joints are measured while a lattice is looked for.
STATIONS = 700
# How far a fit looks in its rounds, in camera heights, as it grows from the feet, and in a known field.
OUTWARDS, FIELD_REACH, IN_FIELD_ROUNDS = (2.5, 4.0, 7.0), 9.0, 3
# A lattice is followed to another shift if it misses at most so many times as many of its joints by that:
# where there is none, a shift that suits chance a little better is always found.
FEWER = 0.8
# Where a round of a fit that looks farther moves its joints by less than this, farther ones are as expected.
STEADY_PX = 0.1
# Sides that tell whether a start is worth following.
GLANCE = Effort(sides=600)
# Planes whose joints carry less than this are not worth another start.
HOPELESS_NATS = 8.0


def lay_combs(looks: Looks, plane: PlaneCombs, free: Free) -> Paving | None:
    """The lattice that the best combs of a plane lead to: for joints that repeat as whole lines."""
    start = _best_start(plane)
    return None if start is None else _laid(looks, plane, start, free)


def lay_lattice(
    looks: Looks, plane: PlaneCombs, free: Free, *, most_starts: int = MOST_STARTS
) -> tuple[Paving, ...]:
    """The lattices that several starts on a plane lead to, the one that explains the picture best first.

    Where both families repeat as whole lines, they are the start. A running bond seen from afar, or one with
    an unusual shift, shows its cross joints only course by course. All looks at the picture give starts, of
    which no more than `most_starts` are tried after the first. A coarse one shows joints more clearly than
    what is finer, but where there is a grain it takes thin ones for a part of that.
    """
    found: list[Paving] = []
    tried: list[_Start] = []
    ordered = (looks.fine, looks.coarse) if looks.fine.strong else (looks.coarse, looks.fine)
    for start in _starts((*ordered, looks.unshaded), plane):
        if any(start.like(other) for other in tried):
            continue
        # The first start may be refined to a finer lattice whose joints its own miss.
        laid = _laid(looks, plane, start, free, both=bool(tried))
        tried.append(start)
        found += [] if laid is None else [laid]
        if (laid is not None and laid.plain) or told_twice(found) or len(tried) > most_starts:
            break
    return tuple(sorted(found, key=lambda paving: -paving.margin_nats))


def lay_first(looks: Looks, plane: PlaneCombs, free: Free) -> Paving | None:
    """The lattice that the first start on a plane leads to: its best combs, else the clearest near by."""
    start = next(_starts((looks.fine,), plane), None)
    return None if start is None else _laid(looks, plane, start, free)


def lay_bond(looks: Looks, plane: PlaneCombs, pose: Rigid, grid: Grid, free: Free) -> Paving | None:
    """The lattice that a bond seen by such a pose leads to, if any."""
    return _laid(looks, plane, _Start(pose, grid), free)


def _starts(looks: tuple[Look, ...], plane: PlaneCombs) -> Iterator[_Start]:
    best = _best_start(plane)
    if best is not None:
        yield best
    if plane.score < HOPELESS_NATS:
        return
    for look in looks:
        camera = plane.camera.scaled(*look.gradient.size)
        reach = near_reach(camera, plane.R)
        near = rectify(look.gradient, camera, plane.R, reach=reach, size=look.lines, strong=look.strong)
        if near is None:
            continue
        yield from (_bond_start(plane.R, bond) for bond in bond_hypotheses(near, keep=2))
        x, y = (best_combs(family, count=2, local=True) for family in (near.x, near.y))
        pairs = sorted(((b, a) for b in x for a in y), key=lambda p: -p[0].score - p[1].score)
        yield from (_comb_start(plane.R, b, a) for b, a in pairs[:2])


@dataclass(frozen=True)
class _Start:
    """Where a refinement starts; `field` is the part of the ground that is known to be paved, if any."""

    pose: Rigid
    grid: Grid
    field: Float[np.ndarray, "4 2"] | None = None

    def like(self, other: _Start) -> bool:
        """Whether both lead to the same lattice: their axes, spacings and bonds are about the same."""
        mine, theirs = (np.array([g.spacing_x or 0.0, g.spacing_y]) for g in (self.grid, other.grid))
        same_axes = abs(float(self.pose.R[:, 0] @ other.pose.R[:, 0])) > 0.7
        theirs = theirs if same_axes or self.grid.shift or other.grid.shift else theirs[::-1]
        return bool(
            np.allclose(mine, theirs, rtol=0.03)
            and abs(self.grid.shift - other.grid.shift) < 0.03
            and (self.field is None) == (other.field is None)
        )


def _best_start(plane: PlaneCombs) -> _Start | None:
    """The start from a plane's best combs, if there are any along both axes."""
    return _comb_start(plane.R, plane.x[0], plane.y[0]) if plane.x and plane.y else None


def _comb_start(R: np.ndarray, b: Comb, a: Comb) -> _Start:
    """A start from the comb of the joints along X and that of those along Y."""
    pose, grid = Rigid(R, R @ np.array([a.phase, b.phase, -1.0])), Grid(a.spacing, b.spacing)
    low = np.array([max(a.lines[0], b.along[0]), max(b.lines[0], a.along[0])])
    high = np.array([min(a.lines[1], b.along[1]), min(b.lines[1], a.along[1])])
    spacing = np.array([a.spacing, b.spacing])
    if not np.isfinite([low, high]).all() or (high - low < 1.5 * spacing).any():
        return _Start(pose, grid)
    (x0, y0), (x1, y1) = low - 0.5 * spacing, high + 0.5 * spacing
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    return _Start(pose, grid, corners - [a.phase, b.phase])


def _bond_start(R: np.ndarray, bond: BondHypothesis) -> _Start:
    pose = Rigid(R, R @ np.array([bond.origin[0], bond.origin[1], -1.0]))
    return _Start(turned(pose) if bond.turned else pose, bond.grid)


def _laid(looks: Looks, plane: PlaneCombs, start: _Start, free: Free, *, both: bool = False) -> Paving | None:
    """The lattice that a start leads to, if any; only if the joints of `both` families may be there."""
    fit = _fitted(looks.picture, plane.camera, start.pose, start.grid, free, start.field)
    if fit is None:
        return None
    presence = presence_of(looks.picture, fit, GLANCE)
    whole = len(presence.p) < GLANCE.sides
    if start.field is not None and not whole and not hopeful(presence, both=both):
        # A small field afar may have none of the sides that are largest in the picture.
        presence = presence_of(looks.picture, fit, GLANCE, field=start.field)
    if len(presence.p) < 6 or not hopeful(presence, both=both):
        return None
    field = presence.field
    if fills(fit, field):
        laid = settle_bond(looks.picture, fit, presence if whole else None)
    else:
        fit = refine_in_field(looks.picture, fit, field)
        laid = settle_bond(looks.picture, fit)
    if laid is not None and laid.grid != fit.grid:
        laid = fitted_anew(looks.picture, laid)
    return None if laid is None else of_single_slabs(looks.picture, laid)


def _fitted(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    free: Free,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Fit | None:
    """The fit that a start grows to, with the shift from course to course that its own joints tell."""
    first = fit_outwards(picture, camera, cam_from_ground, grid, free, field)
    if first is None:
        return None
    fits = by_measured_shifts(
        first, lambda fit: fit_outwards(picture, fit.camera, fit.cam_from_ground, fit.grid, free, field)
    )
    # Of those that miss as little as each other the last one.
    best = min(reversed(fits), key=lambda fit: fit.missed)
    return best if best.missed < FEWER * first.missed else first


def fitted_anew(picture: Float[np.ndarray, "h w"], laid: Paving) -> Paving | None:
    """A lattice that was told by the fit of another one, by its own joints, if that makes it clearer.

    What hid from the other fit, the bond or that there is none, shows then.
    """
    told = laid.fit
    grown = _fitted(picture, told.camera, told.cam_from_ground, told.grid, told.free)
    again = grown and presented(picture, refine_in_field(picture, grown, laid.presence.field))
    if again is None or again.margin_nats <= laid.margin_nats:
        return laid
    return of_true_bond(picture, again)


def of_single_slabs(picture: Float[np.ndarray, "h w"], laid: Paving) -> Paving | None:
    """The lattice of the slabs themselves, where one was found whose cells hold several of them.

    None where there are joints within the cells and no lattice has them, and where nothing tells whether
    there are.
    """
    family, count = slabs_in_one(picture, laid.fit, laid.presence)
    if count == 1:
        return None if too_long(laid.grid) else laid
    fine = divided(laid.fit, family, count)
    if fine is None:
        return None
    again = settle_bond(picture, refine_in_field(picture, fine, laid.presence.field))
    still = again is not None and slabs_in_one(picture, again.fit, again.presence)[1] > 1
    return None if still else again


def fills(fit: Fit, field: Float[np.ndarray, "k 2"]) -> bool:
    """Whether a fit rests on all sides that are in view within a field, and on no others."""
    sides = visible_sides(fit.camera, fit.cam_from_ground, fit.grid, reach=FIELD_REACH, field=field)
    mine, all_there = (
        np.unique(np.stack([s.family, s.line, s.cell], 1), axis=0) for s in (fit.stations, sides)
    )
    return np.array_equal(mine, all_there)


def fit_outwards(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    free: Free,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Fit | None:
    """The fit that a start grows to: from the camera's feet outwards, or within a field that is known.

    The camera may be of another picture size.
    """
    camera = camera.scaled(picture.shape[1], picture.shape[0])
    reaches = OUTWARDS if field is None else (FIELD_REACH,) * IN_FIELD_ROUNDS
    return refine(
        picture, camera, cam_from_ground, grid,
        free=free, search=0.2, reaches=reaches, field=field, limit=STATIONS, steady_px=STEADY_PX,
    )  # fmt: skip


def refine_in_field(picture: Float[np.ndarray, "h w"], fit: Fit, field: Float[np.ndarray, "k 2"]) -> Fit:
    """A fit refined within a field of the ground; the fit itself where nothing can be measured there."""
    within = refine(
        picture,
        fit.camera,
        fit.cam_from_ground,
        fit.grid,
        free=fit.free,
        search=0.05,
        reaches=(FIELD_REACH,),
        strip=fit.strip,
        field=field,
        limit=STATIONS,
    )
    return within or fit
