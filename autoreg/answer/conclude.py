"""From the last fit to the answer: the canonical frame, the scale, and the figures that are reported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from autoreg.alignment import CameraSource, JointFit, Pose, Residual, ScaleSource, height_by_motion
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid, cross_matrix
from autoreg.ground.ground_frame import quarter_turns
from autoreg.ground.points import project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.ground.stations import joints_of
from autoreg.lattice import Lattice, LatticeKind
from autoreg.paving.presence import Presence
from autoreg.slabs.bent_ground import Bend
from autoreg.spread import spread_about

# Stations that are off by less than this many standard deviations carried the fit.
INLIER_SIGMAS = 3.0
# A standard deviation of the camera's turn, in degrees, from which on things on the ground are seen to lean;
# the unknown principal point of a camera without a file is good for 1.5.
UNSURE_DEG = 2.0
# Sides that differ by less than the first share are one; the lengths of a row's slabs tell which side is its
# width where one side is longer by the second.
SAME_SIDE, TOLD_SIDE = 0.01, 0.25


@dataclass(frozen=True)
class Frame:
    """A choice among the lattice's equivalent frames: quarter turns about a crossing.

    `by_shift` is how far a unit of a running bond's shift moves that crossing along the unbroken joints.
    """

    quarter_turns: int
    origin: Float[np.ndarray, "2"]
    by_shift: float = 0.0

    @property
    def by_ratio(self) -> Float[np.ndarray, "2"]:
        """How far a unit of the logarithm of the sides' ratio moves the crossing, whole slabs away."""
        return 0.5 * self.origin * [1.0, -1.0]

    def grid(self, grid: Grid) -> Grid:
        """The lattice in this frame."""
        if self.quarter_turns % 2 == 0 or grid.spacing_x is None:
            return grid
        return Grid(grid.spacing_y, grid.spacing_x, 0.0)

    def pose(self, pose: Rigid) -> Rigid:
        """cam_from_ground for this frame's ground."""
        turn = self.rotation
        return Rigid(pose.R @ turn, pose.t + pose.R[:, :2] @ self.origin)

    def covariance(self, covariance: Float[np.ndarray, "8 8"], pose: Rigid) -> Float[np.ndarray, "8 8"]:
        """Covariance of the moved pose, and of the sides' ratio and the shift, which stay.

        The new origin swings with the rotation about the old one. As many slabs as it lies off the old one,
        so much the farther does it move where their sides become longer. Of rows no ratio is solved for.
        """
        A = np.eye(8)
        A[3:6, :3] = -cross_matrix(pose.R[:, :2] @ self.origin)
        A[3:6, 6], A[3:6, 7] = pose.R[:, :2] @ self.by_ratio, pose.R[:, 0] * self.by_shift
        return A @ covariance @ A.T

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """Old ground axes from this frame's."""
        return quarter_turns(self.quarter_turns)

    def points(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Ground points of the old frame, in this one."""
        return (points - self.origin) @ self.rotation[:2, :2]


def canonical_frame(fit: Fit, presence: Presence, crossing: Float[np.ndarray, "2"] | None) -> Frame:
    """The frame by the written rule: +Y points most away from the camera, origin nearest the paving's middle.

    The middle is the ground under the mean pixel of the sides that are there. A running bond and rows keep
    X along the unbroken joints, so that only half a turn is free; the origin of rows, whose cross joints
    follow no law, is the given `crossing`.
    """
    R = fit.cam_from_ground.R
    ahead = R[2, :2]
    free = (0, 1, 2, 3) if fit.grid.spacing_x is not None and not fit.grid.shift else (0, 2)
    y_axes = {0: (0.0, 1.0), 1: (-1.0, 0.0), 2: (0.0, -1.0), 3: (1.0, 0.0)}
    turns = max(free, key=lambda q: round(float(np.dot(ahead, y_axes[q])), 9))
    if crossing is not None:
        return Frame(turns, crossing)
    here = presence.sides.ends[presence.there].reshape(-1, 2)
    px = project_ground(fit.camera, fit.cam_from_ground, here).mean(0)
    ray = fit.camera.unproject(px[None])[0] @ R
    eye = fit.cam_from_ground.origin_in_a
    middle = (eye - ray * eye[2] / ray[2])[:2] if ray[2] < -1e-9 else here.mean(0)
    a, b, shift = fit.grid.spacing_x, fit.grid.spacing_y, fit.grid.shift
    j = round(float(middle[1] / b))
    # Row 0 of a frame turned by half lies on the other side of the origin's unbroken joint.
    row = j - 1 if turns == 2 else j
    if a is None:
        return Frame(turns, np.array([float(middle[0]), j * b]))
    origin = np.array([(round(float(middle[0] / a - row * shift)) + row * shift) * a, j * b])
    return Frame(turns, origin, row * a)


def lattice_kind(grid: Grid) -> LatticeKind:
    """Name of the bond."""
    if grid.spacing_x is None:
        return "rows"
    return "running" if grid.shift else "stack"


def describe_lattice(fit: Fit, field: Float[np.ndarray, "k 2"], frame: Frame, scale: float) -> Lattice:
    """The lattice in the chosen frame and in metres; its field is in the fit's frame."""
    grid = frame.grid(fit.grid)
    widths = np.array(fit.strip.width)
    counts = np.array([(fit.stations.family[fit.usable] == f).sum() for f in (ALONG_X, ALONG_Y)])
    return Lattice(
        kind=lattice_kind(grid),
        spacing_x=None if grid.spacing_x is None else scale * grid.spacing_x,
        spacing_y=scale * grid.spacing_y,
        shift=None if grid.spacing_x is None else grid.shift % 1.0,
        joint_width=scale * float((widths * counts).sum() / max(counts.sum(), 1)),
        extent=scale * frame.points(field),
    )


def measure_residual(fit: Fit) -> Residual:
    """How far the photographed joints lie from the fitted ones."""
    inlier = _inliers(fit)
    near = np.abs(fit.distances_px[inlier])
    return Residual(
        rms_px=float(np.sqrt(np.mean(near**2))),
        median_px=float(np.median(near)),
        p95_px=float(np.quantile(near, 0.95)),
        joints=len(joints_of(fit.stations.take(np.flatnonzero(inlier)), fit.grid)[1]),
        samples=int(inlier.sum()),
        inlier_fraction=float(inlier.mean()),
    )


def _inliers(fit: Fit) -> Bool[np.ndarray, " n"]:
    """Which stations carried the fit.

    The likeliest pose may leave most of even joints off their lines together, if that is what relief does.
    """
    off = np.abs(fit.distances_px / fit.sigma_px)
    return fit.usable & (off < max(INLIER_SIGMAS, spread_about(off[fit.usable])))


def fitted_joints(fit: Fit, frame: Frame) -> tuple[JointFit, ...]:
    """The joint lines that carried the fit, in the chosen frame's families and indices.

    An unbroken joint is one entry; the cross joints of a running bond are one each, however short. Each lies
    on its line of the lattice, and ends where the last stretch of it ends that was measured.
    """
    inlier = _inliers(fit)
    grid, pose = frame.grid(fit.grid), frame.pose(fit.cam_from_ground)
    stations, off = fit.stations.take(inlier), fit.distances_px[inlier]
    ground, half_length = stations.ground, stations.half_length
    turned = frame.quarter_turns % 2 == 1
    joints: list[JointFit] = []
    inverse, first = joints_of(stations, fit.grid)
    for k, axis in enumerate(stations.family[first]):
        rows = np.flatnonzero(inverse == k)
        along, half = ground[rows, axis], half_length[rows]
        low, high = int((along - half).argmin()), int((along + half).argmax())
        ends = ground[rows[[low, high]]]
        ends[:, axis] += -half[low], half[high]
        ends = frame.points(ends)
        x, y = ends.mean(0)
        name: Literal["x", "y"] = "x" if (axis == ALONG_X) != turned else "y"
        # The stations were laid on the lattice as it was before the last solve.
        if name == "x":
            index = round(float(y / grid.spacing_y))
            ends[:, 1] = index * grid.spacing_y
        else:
            a, moved = grid.spacing_x or 1.0, float(np.floor(y / grid.spacing_y)) * grid.shift
            index = round(float(x / a - moved))
            ends[:, 0] = (index + moved) * a
        ends_px = project_ground(fit.camera, pose, ends)
        joints.append(JointFit(name, index, ends_px, float(np.sqrt(np.mean(off[rows] ** 2)))))
    return tuple(sorted(joints, key=lambda j: (j.family, j.index, float(j.ends_px[0, 0]))))


def bent(bend: Bend, fit: Fit, scale: float, source: ScaleSource) -> str:
    """The warning of ground that one plane does not lie on, as `metric_scale` tells the scale."""
    height = float(fit.cam_from_ground.origin_in_a[2])
    off = f"{100 * bend.off / height:.1f} % of the camera's height"
    if source != "none":
        off = f"{1e3 * scale * bend.off:.0f} mm"
    return (
        f"the ground is bent: it lies up to {off} off the plane that suits its joints best, and leans by "
        f"{np.degrees(bend.lean):.1f}° (RMS) against it, as paving that falls to its gutters does, or as it "
        "looks through a lens that the camera file leaves out; what stands far from the origin may seem to "
        "float or to sink in"
    )


def metric_scale(
    fit: Fit, slab: tuple[float, float] | None, camera_height: float | None, longer: bool | None = None
) -> tuple[float, ScaleSource]:
    """Metres per unit of the fit, and where it comes from.

    Args:
        fit: its lattice has a unit of its own.
        slab: the slab's sides in metres, in either order.
        camera_height: the camera's height in metres, instead.
        longer: of rows, whether their slabs are longer than a row is wide, if that is known.

    Raises:
        Refusal: either side of the slab may be the width of a row.
    """
    a, b = fit.grid.spacing_x, fit.grid.spacing_y
    if slab is not None:
        if a is None:
            return _row_width(slab, longer) / b, "slab"
        return float(np.sqrt(slab[0] * slab[1] / (a * b))), "slab"
    if camera_height is not None:
        return camera_height / float(fit.cam_from_ground.origin_in_a[2]), "camera_height"
    return (1.0 / b if a is None else 2.0 / (a + b)), "none"


def scaled_covariance(
    covariance: Float[np.ndarray, "8 8"],
    pose: Rigid,
    grid: Grid,
    scale: float,
    source: ScaleSource,
) -> Float[np.ndarray, "6 6"]:
    """Covariance of a pose whose translation is scaled, as `metric_scale` says.

    Where the height is held, the scale itself turns and moves with the pose; where the mean of the sides is
    one, it changes with their ratio.
    """
    A = np.zeros((6, 8))
    A[:, :6] = np.diag([1.0, 1.0, 1.0, scale, scale, scale])
    if source == "camera_height":
        # The translation is scale t with scale = known / height.
        A[3:, :6] -= scale * np.outer(pose.t, height_by_motion(pose)) / float(pose.origin_in_a[2])
    a, b = grid.spacing_x, grid.spacing_y
    if source == "none" and a is not None:
        A[3:, 6] = -0.5 * (a - b) / (a + b) * scale * pose.t
    return A @ covariance @ A.T


def _row_width(slab: tuple[float, float], longer: bool | None) -> float:
    """Which side of the slab is the width of a row, whose slabs are `longer` than that, or shorter."""
    short, long = sorted(slab)
    if long <= (1.0 + SAME_SIDE) * short:
        return short
    if longer is not None and long >= (1.0 + TOLD_SIDE) * short:
        return short if longer else long
    raise Refusal(
        "ambiguous",
        f"only the unbroken joints repeat here, and either side of the {slab[0]:g} x {slab[1]:g} m slab may "
        "be the width of a row; give the row's width as one number with --slab",
        measured=2.0,
        limit=1.0,
    )


def exif_not_followed(exif_focal_px: float, own: Camera) -> str:
    """The warning of a photo whose joints contradict the focal length that its EXIF claims."""
    return (
        f"the photo's joints contradict the focal length of its EXIF, {exif_focal_px:.0f} px, as after "
        f"a crop: theirs, {own.fx:.0f} px, was taken"
    )


def unsure(pose: Pose, source: CameraSource, *, slab_told: bool) -> tuple[str, ...]:
    """The warning of a pose that a camera from the photo leaves too unsure for things on the ground."""
    turn_deg = float(np.rad2deg(pose.sigma_turn))
    if source == "file" or turn_deg < UNSURE_DEG:
        return ()
    by_slab = "" if slab_told else ", or the slab's sides with --slab"
    return (
        f"no camera file was given, and how the camera is turned is known to ± {turn_deg:.1f}° only (one "
        "standard deviation): the lines lie on the joints, but what stands on the ground may lean, or look "
        f"too tall or too low; give the camera with --camera{by_slab}",
    )
