"""From a hypothesis of the ground's orientation to the slab lattice that lies on it.

The two families of joints are found as combs on the rectified ground; their common pose is refined by the
joints themselves; then the presence of every single slab side tells the bond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from autoreg.bond import BondHypothesis, bond_hypotheses
from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground_frame import turned
from autoreg.image import pyramid
from autoreg.lattice_choice import Paving, settle_bond
from autoreg.periods import Comb, best_combs
from autoreg.presence import field_polygon, presence_of
from autoreg.rectify import Gradient, near_reach, picture_gradient, rectify
from autoreg.refine import Fit, Free, refine
from autoreg.segments import Segments
from autoreg.sharpen import sharpen
from autoreg.stations import Grid

# Beyond this margin no other start is tried.
CERTAIN_NATS = 40.0
# The most starts tried on one plane after its first.
MOST_STARTS = 6
# The most places at which joints are measured while a lattice is looked for.
STATIONS = 700
# Size of the first look, and its and the second look's numbers of rows on the ground.
COARSE_PIXELS, COARSE_LINES, FINE_LINES = 110_000, 320, 800
# Planes whose joints carry less than this are not worth another start, ...
HOPELESS_NATS = 8.0
# ... and the first one is tried before all others are looked at, if it carries this much.
PROMISING_NATS = 15.0


@dataclass(frozen=True)
class Look:
    """A picture's gradient, and the number of rows and columns that sample the ground from it."""

    gradient: Gradient
    lines: int


@dataclass(frozen=True)
class Looks:
    """A photo at detection scale: its grey levels, and a coarse and a fine look at it.

    Directions of rough joints, and lenses that bend them, leave lines some pixels askew, which blurs a fine
    profile of the ground more than a coarse one.
    """

    picture: Float32[np.ndarray, "h w"]
    coarse: Look
    fine: Look


@dataclass(frozen=True)
class PlaneCombs:
    """One ground hypothesis with the joints found on it; the camera is the photo's."""

    camera: Camera
    R: Float[np.ndarray, "3 3"]
    x: tuple[Comb, ...]
    y: tuple[Comb, ...]

    @property
    def score(self) -> float:
        """How much better the two best combs explain the plane than chance does."""
        return sum((combs[0].score for combs in (self.x, self.y) if combs), 0.0)


Hypothesis = tuple[Camera, Float[np.ndarray, "3 3"]]


def looks_at(small: UInt8[np.ndarray, "h w"]) -> Looks:
    """Both looks at a picture at detection scale."""
    coarse = picture_gradient(pyramid(small, COARSE_PIXELS)[0])
    return Looks(
        small.astype(np.float32), Look(coarse, COARSE_LINES), Look(picture_gradient(small), FINE_LINES)
    )


def promising_plane(looks: Looks, hypotheses: list[Hypothesis]) -> PlaneCombs | None:
    """The first hypothesis, if its joints are clear as it came."""
    plane = _combed(looks.fine, *hypotheses[0]) if hypotheses else None
    return plane if plane is not None and plane.score > PROMISING_NATS else None


def comb_planes(
    looks: Looks, segments: Segments, hypotheses: list[Hypothesis], *, free_focal: bool
) -> list[PlaneCombs]:
    """The joints of both families on each hypothesised ground, the planes with the clearest joints first.

    Each is looked at as it came and sharpened, finely and coarsely.
    """
    planes: list[PlaneCombs] = []
    for camera, R in hypotheses:
        versions = ((camera, R), sharpen(segments, camera, R, free_focal=free_focal))
        tried = [_combed(look, *version) for version in versions for look in (looks.coarse, looks.fine)]
        seen = [plane for plane in tried if plane is not None]
        if seen:
            planes.append(max(seen, key=lambda plane: plane.score))
    return sorted(planes, key=lambda plane: -plane.score)


def _combed(look: Look, camera: Camera, R: Float[np.ndarray, "3 3"]) -> PlaneCombs | None:
    rectified = rectify(look.gradient, camera.scaled(*look.gradient.size), R, size=look.lines)
    if rectified is None:
        return None
    return PlaneCombs(camera, R, best_combs(rectified.x), best_combs(rectified.y))


def lay_combs(looks: Looks, plane: PlaneCombs, free: Free) -> Paving | None:
    """The lattice that the best combs of a plane lead to: for joints that repeat as whole lines."""
    if not (plane.x and plane.y):
        return None
    return _laid(looks, plane, _comb_start(plane.R, plane.x[0], plane.y[0]), free)


def lay_lattice(looks: Looks, plane: PlaneCombs, free: Free) -> tuple[Paving, ...]:
    """The lattices that several starts on a plane lead to, the one that explains the picture best first.

    Where both families repeat as whole lines, they are the start. A running bond seen from afar, or one with
    an unusual shift, shows its cross joints only course by course.
    """
    first = lay_combs(looks, plane, free)
    found = [] if first is None else [first]
    if (first is not None and first.margin_nats > CERTAIN_NATS) or plane.score < HOPELESS_NATS:
        return tuple(found)
    starts: list[tuple[Rigid, Grid]] = []
    for look in (looks.coarse, looks.fine):
        camera = plane.camera.scaled(*look.gradient.size)
        reach = near_reach(camera, plane.R)
        near = rectify(look.gradient, camera, plane.R, reach=reach, size=look.lines)
        if near is None:
            continue
        starts += [_bond_start(plane.R, bond) for bond in bond_hypotheses(near, keep=2)]
        pairs = [(b, a) for b in best_combs(near.x, count=2) for a in best_combs(near.y, count=2)]
        pairs.sort(key=lambda p: -p[0].score - p[1].score)
        starts += [_comb_start(plane.R, b, a) for b, a in pairs[:2]]
    for start in starts[:MOST_STARTS]:
        laid = _laid(looks, plane, start, free)
        found += [] if laid is None else [laid]
        if laid is not None and laid.margin_nats > CERTAIN_NATS:
            break
    return tuple(sorted(found, key=lambda paving: -paving.margin_nats))


def _comb_start(R: np.ndarray, b: Comb, a: Comb) -> tuple[Rigid, Grid]:
    return Rigid(R, R @ np.array([a.phase, b.phase, -1.0])), Grid(a.spacing, b.spacing)


def _bond_start(R: np.ndarray, bond: BondHypothesis) -> tuple[Rigid, Grid]:
    pose = Rigid(R, R @ np.array([bond.origin[0], bond.origin[1], -1.0]))
    return (turned(pose) if bond.turned else pose), bond.grid


def _laid(looks: Looks, plane: PlaneCombs, start: tuple[Rigid, Grid], free: Free) -> Paving | None:
    """The lattice that a start leads to, if any."""
    fit = fit_outwards(looks.picture, plane, *start, free)
    if fit is None:
        return None
    presence = presence_of(looks.picture, fit)
    if len(presence.p) < 6:
        return None
    return settle_bond(looks.picture, refine_in_field(looks.picture, fit, field_polygon(presence)))


def fit_outwards(
    picture: Float[np.ndarray, "h w"], plane: PlaneCombs, cam_from_ground: Rigid, grid: Grid, free: Free
) -> Fit | None:
    """The fit that a start grows to, from the camera's feet outwards."""
    camera = plane.camera.scaled(picture.shape[1], picture.shape[0])
    return refine(
        picture, camera, cam_from_ground, grid, free=free, search=0.2, reaches=(2.5, 4.0, 7.0), limit=STATIONS
    )


def refine_in_field(picture: Float[np.ndarray, "h w"], fit: Fit, field: Float[np.ndarray, "k 2"]) -> Fit:
    """A fit refined within a field of the ground; the fit itself where nothing can be measured there."""
    within = refine(
        picture,
        fit.camera,
        fit.cam_from_ground,
        fit.grid,
        free=fit.free,
        search=0.05,
        reaches=(9.0, 9.0),
        strip=fit.strip,
        field=field,
        limit=STATIONS,
    )
    return within or fit
