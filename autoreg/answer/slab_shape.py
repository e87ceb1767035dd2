"""The ratio of a known slab's sides: a lattice has it, contradicts it, or is told its focal length by it.

Joints that hardly run together leave a focal length open, and with it how deep the slabs are: a photo taken
squarely to them shows the same picture of long slabs through a long lens and of short ones through a short
lens. Who knows the slab need not guess.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import WIDE_SEARCH, refine
from autoreg.geometry import Rigid, nearest_rotation
from autoreg.paving.lattice_evidence import Paving, has_ratio, presented
from autoreg.paving.lay import FIELD_REACH, OUTWARDS, STATIONS
from autoreg.solve import joint_data as terms
from autoreg.solve.freedom import Free, log_stretch

# A focal length is none that is off by more standard deviations of what is known of it beforehand.
MOST_SIGMAS = 2.5
# Nor does a slab tell a camera whose focal length and principal point together are off by more than this: the
# right slab takes 1.5 at most, one that is wrong by a fifth takes more in three photos of four; nor one by
# which the joints lie so much farther from their lines than by the one that they told themselves: so many
# times as far, or by so many pixels. By the right slab they lie up to 1.2 times as far.
MOST_SIGMAS_BY_SLAB, ROUGHER, ROUGHER_PX = 1.7, 1.3, 0.02
# Logarithm, and standard deviations, by which the joints' own ratio of sides is another one than was told.
OTHER_RATIO, OTHER_RATIO_SIGMAS = 0.003, 4.0
# ... and from which on the slab or the camera is wrong, unless the sides leave out joints, which may be wider
# than they look by this factor. A focal length that is off by 1 % changes the ratio by 0.6 %.
CONTRADICTING_RATIO, WIDER_THAN_SEEN = 0.01, 1.25


@dataclass(frozen=True)
class UnlikeSlab:
    """Joints whose sides are in another ratio than those of a slab as it was told.

    Longer side over shorter; `sigma` is the standard deviation of the logarithm of the joints' `ratio`, and
    `joint_m` the width of a joint that the told sides leave out, if that explains it.
    """

    ratio: float
    told: float
    sigma: float
    sides_m: tuple[float, float]
    joint_m: float | None

    @property
    def off(self) -> float:
        """Logarithm of the joints' ratio over the told one."""
        return float(np.log(self.ratio / self.told))

    @property
    def contradicts(self) -> bool:
        """Whether the slab or the camera is wrong: no joint that sides may leave out explains so much."""
        return self.joint_m is None and abs(self.off) > CONTRADICTING_RATIO

    @property
    def warning(self) -> str:
        """What to tell of it."""
        advice = "measure a slab from the middle of one joint to that of the next, and check the camera"
        if self.joint_m is not None:
            long, short = (side + self.joint_m for side in self.sides_m)
            advice = (
                f"with joints {1e3 * self.joint_m:.1f} mm wide the slabs would have it: "
                f"give {long:.3f}x{short:.3f}"
            )
        return (
            f"the joints lie in the ratio {self.ratio:.4f} (± {self.sigma * self.ratio:.4f}), the sides "
            f"given with --slab in {self.told:.4f}: the pose follows the joints, and its scale may be off by "
            f"{100 * abs(self.off):.1f} %; {advice}"
        )


def of_slab_shape(
    small: Float[np.ndarray, "h w"], found: Paving, slab: tuple[float, float], free: Free
) -> Paving:
    """The lattice with the ratio of a slab's sides, seen with another focal length where that is open.

    Args:
        small: the photo at detection scale, where the lattice was found.
        found: the lattice.
        slab: sides of a slab in either order.
        free: what is known of the camera beforehand.

    Raises:
        Refusal: the slab's sides cannot be those of the lattice.
    """
    # Sides a few per cent off already move the far joints by as much as a focal length that is off with them.
    by_its_focal = _by_another_focal(small, found, slab, free) if free.focal else None
    if by_its_focal is not None:
        return by_its_focal
    if has_ratio(found.fit.grid, slab) and free.ratio:
        return found
    if has_ratio(found.fit.grid, slab):
        return replace(found, fit=with_slab_ratio(found.fit, slab))
    raise slab_mismatch(found.fit, slab, camera_told=not free.focal)


def slab_mismatch(fit: Fit, slab: tuple[float, float], *, camera_told: bool) -> Refusal:
    """The refusal of a slab whose sides cannot be those of the photo's lattice."""
    check = "check that the camera belongs to this photo" if camera_told else "give the camera with --camera"
    seen, told = fit.grid.ratio, max(slab) / min(slab)
    return Refusal(
        "slab_mismatch",
        f"the slabs in this photo have sides in the ratio {seen:.3f}, those given with --slab {told:.3f}; "
        f"measure a slab from joint to joint, or {check}",
        measured=round(float(seen), 4),
        limit=round(float(told), 4),
    )


def unlike_slab(fit: Fit, slab: tuple[float, float], ratio_sigma: float, scale: float) -> UnlikeSlab | None:
    """What the joints say against a slab's ratio of sides as it was told; None if they suit it, and of rows.

    Args:
        fit: the last one.
        slab: sides as they were told, in metres.
        ratio_sigma: standard deviation of the logarithm of the fit's ratio.
        scale: metres per unit of the fit.
    """
    a, b = fit.grid.spacing_x, fit.grid.spacing_y
    if a is None:
        return None
    short, long = sorted(slab)
    ratio = fit.grid.ratio
    sure = max(OTHER_RATIO, OTHER_RATIO_SIGMAS * ratio_sigma)
    if abs(log_stretch(a, b, slab)) < sure:
        return None
    # (long + joint) / (short + joint) is the joints' ratio; no joint is wider than it looks.
    joint = (long - ratio * short) / max(ratio - 1.0, 1e-9)
    widest = WIDER_THAN_SEEN * scale * max(fit.strip.width)
    told = joint if 0.0 < joint < widest else None
    return UnlikeSlab(ratio, long / short, ratio_sigma, (long, short), told)


def with_slab_ratio(fit: Fit, slab: tuple[float, float]) -> Fit:
    """The fit with its lattice's side ratio replaced by the slab's, at the same area."""
    a, b = fit.grid.spacing_x, fit.grid.spacing_y
    if a is None:
        return fit
    short, long = sorted(slab)
    ratio = long / short if a > b else short / long
    mean = float(np.sqrt(a * b))
    root = float(np.sqrt(ratio))
    return replace(fit, grid=replace(fit.grid, spacing_x=mean * root, spacing_y=mean / root))


def _by_another_focal(
    small: Float[np.ndarray, "h w"], found: Paving, slab: tuple[float, float], free: Free
) -> Paving | None:
    """The lattice as slabs of this shape are seen, with the focal length that takes; None if they are not."""
    fit = found.fit
    told = with_slab_ratio(fit, slab)
    assert fit.grid.spacing_x is not None
    assert told.grid.spacing_x is not None
    longer = np.array([told.grid.spacing_x / fit.grid.spacing_x, told.grid.spacing_y / fit.grid.spacing_y])
    start = seen_alike(fit.camera, fit.cam_from_ground, longer)
    if start is None or not _plausible_by_slab(start[0], free):
        return None
    width = (fit.strip.width[0] * float(longer[1]), fit.strip.width[1] * float(longer[0]))
    # Slabs of a known shape tell the principal point as well, and do not suit one that is off.
    again = refine(
        small, *start, told.grid,
        free=free.scaled(fit.camera), search=WIDE_SEARCH, reaches=(*OUTWARDS, FIELD_REACH, FIELD_REACH),
        strip=replace(fit.strip, width=width, polarity_known=True),
        field=found.presence.field * longer, limit=STATIONS,
    )  # fmt: skip
    if again is None or not _plausible_by_slab(again.camera, free):
        return None
    if again.roughness_px > max(ROUGHER * fit.roughness_px, fit.roughness_px + ROUGHER_PX):
        return None
    within = None if found.within is None else found.within * longer
    seen = presented(small, again, within=within)
    return None if seen is None or seen.margin_nats < 0 else seen


def seen_alike(
    camera: Camera, cam_from_ground: Rigid, longer: Float[np.ndarray, "2"]
) -> tuple[Camera, Rigid] | None:
    """Camera and pose that see a ground, longer along X and Y by two factors, as these see the ground itself.

    As nearly as a focal length allows, the principal point being what it is: by the homography H from the
    ground to the picture, whose columns h1 and h2 must be as long as each other once it is undone. None if no
    focal length does that.
    """
    lengths = longer**2
    rx, ry = cam_from_ground.R[2, :2] ** 2
    numerator = ry / lengths[1] - rx / lengths[0]
    denominator = (1.0 - rx) / lengths[0] - (1.0 - ry) / lengths[1]
    if numerator * denominator <= 0.0:
        return None
    # The old focal length over the new one.
    shorter = float(np.sqrt(numerator / denominator))
    factor = np.array([shorter, shorter, 1.0])
    columns = factor[:, None] * np.column_stack([cam_from_ground.R[:, :2] / longer, cam_from_ground.t])
    H = columns / np.sqrt(np.linalg.norm(columns[:, 0]) * np.linalg.norm(columns[:, 1]))
    R = nearest_rotation(np.column_stack([H[:, :2], np.cross(H[:, 0], H[:, 1])]))
    other = replace(camera, fx=camera.fx / shorter, fy=camera.fy / shorter)
    return other, Rigid(R, H[:, 2])


def plausible_focal(camera: Camera, free: Free) -> bool:
    """Whether a focal length may be that of a camera of which something is known."""
    return abs(float(_sigmas_off(camera, free)[0])) < MOST_SIGMAS


def strain(camera: Camera, free: Free) -> float:
    """By how much more a principal point is off than what is known of it allows, in variance; 1 at the least.

    The Birge ratio: joints that put it many standard deviations from the middle of the picture, where it
    hardly ever is, are off by more than their scatter says, as bent ground and uneven courses are.
    """
    if free.nominal is None or not np.isfinite(free.centre_sigma_px):
        return 1.0
    return max(1.0, 0.5 * float(np.sum(_sigmas_off(camera, free)[1:] ** 2)))


def _plausible_by_slab(camera: Camera, free: Free) -> bool:
    return float(np.linalg.norm(_sigmas_off(camera, free))) < MOST_SIGMAS_BY_SLAB


def _sigmas_off(camera: Camera, free: Free) -> Float[np.ndarray, "3"]:
    """How far focal length and principal point are from what is known of them, in standard deviations."""
    prior = free.scaled(camera).prior(camera)
    told = np.r_[terms.FOCAL, terms.CENTRE_X, terms.CENTRE_Y]
    return prior.mean[told] / prior.sigma[told]
