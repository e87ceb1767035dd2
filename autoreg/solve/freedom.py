"""What a solve may change, and what it did: small motions of the pose, the camera and the lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector
from autoreg.ground.sides import Grid
from autoreg.solve import joint_data as terms
from autoreg.solve.joint_data import PARAMETERS
from autoreg.solve.solver import Prior, Solution


@dataclass(frozen=True)
class Free:
    """What the solve may change besides the pose, and how far a prior lets it go.

    `radial` is the first radial coefficient, `bent` what else bends lines: the second one, and the tangential
    ones. `slab` are the sides of a slab as somebody told them, in either order, whose ratio is good for
    `ratio_sigma` (logarithm). `step_sigma` holds every single solve near its start: so many radians, and
    heights of the camera. Joints of one direction leave motions free that must not wander.
    """

    ratio: bool = False
    slab: tuple[float, float] | None = None
    ratio_sigma: float = np.inf
    focal: bool = False
    centre: bool = False
    radial: bool = False
    aspect: bool = False
    bent: bool = False
    nominal: Camera | None = None
    focal_sigma: float = np.inf
    centre_sigma_px: float = np.inf
    radial_sigma: float = np.inf
    aspect_sigma: float = np.inf
    second_radial_sigma: float = np.inf
    tangential_sigma: float = np.inf
    step_sigma: float = np.inf

    def scaled(self, camera: Camera) -> Free:
        """What is known of the same photo at the scale that `camera` belongs to."""
        if self.nominal is None:
            return self
        return replace(
            self,
            nominal=self.nominal.scaled(camera.width, camera.height),
            centre_sigma_px=self.centre_sigma_px * camera.width / self.nominal.width,
        )

    @property
    def mask(self) -> Float[np.ndarray, " p"]:
        """Ones for the free parameters."""
        mask = np.zeros(PARAMETERS)
        mask[:6] = 1.0
        mask[terms.RATIO], mask[terms.FOCAL] = self.ratio, self.focal
        mask[terms.CENTRE], mask[terms.RADIAL] = self.centre, self.radial
        mask[terms.ASPECT] = self.aspect
        mask[terms.SECOND_RADIAL] = mask[terms.TANGENTIAL] = self.bent
        return mask

    def prior(self, camera: Camera, grid: Grid | None = None) -> Prior:
        """What is known of a solve's parameters when it starts from a camera and a lattice.

        The nominal camera is meant, and a slab as it was told, its longer side where the lattice's is.
        """
        mean, sigma = np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf)
        if self.slab is not None and grid is not None and grid.spacing_x is not None:
            mean[terms.RATIO] = -log_stretch(grid.spacing_x, grid.spacing_y, self.slab)
            sigma[terms.RATIO] = self.ratio_sigma
        sigma[terms.FOCAL], sigma[terms.CENTRE] = self.focal_sigma, self.centre_sigma_px
        sigma[terms.RADIAL], sigma[terms.ASPECT] = self.radial_sigma, self.aspect_sigma
        sigma[terms.SECOND_RADIAL], sigma[terms.TANGENTIAL] = self.second_radial_sigma, self.tangential_sigma
        sigma[terms.ROTATION] = sigma[terms.TRANSLATION] = self.step_sigma
        if self.nominal is not None:
            mean[terms.FOCAL] = np.log(self.nominal.fx / camera.fx)
            mean[terms.CENTRE] = self.nominal.cx - camera.cx, self.nominal.cy - camera.cy
            lens = np.subtract(self.nominal.dist[:4], camera.dist[:4])
            mean[terms.RADIAL], mean[terms.SECOND_RADIAL], mean[terms.TANGENTIAL] = lens[0], lens[1], lens[2:]
            mean[terms.ASPECT] = np.log(self.nominal.fy / self.nominal.fx * camera.fx / camera.fy)
        return Prior(mean, sigma)


def log_stretch(spacing_x: float, spacing_y: float, slab: tuple[float, float]) -> float:
    """Logarithm by which a lattice's ratio of sides x / y is beyond a slab's, told in either order."""
    told = float(np.log(max(slab) / min(slab)))
    return float(np.log(spacing_x / spacing_y)) - (told if spacing_x > spacing_y else -told)


def moved_pose(pose: Rigid, solution: Solution) -> Rigid:
    """The pose after a solve's small motion."""
    p = solution.parameters
    turn = rotation_from_vector(p[terms.ROTATION])
    return Rigid(nearest_rotation(turn @ pose.R), turn @ pose.t + p[terms.TRANSLATION])


def moved_camera(camera: Camera, solution: Solution) -> Camera:
    """The camera after a solve."""
    p = solution.parameters
    if not p[terms.FOCAL :].any():
        return camera
    focal = float(np.exp(p[terms.FOCAL]))
    dx, dy = (float(v) for v in p[terms.CENTRE])
    change = (p[terms.RADIAL], p[terms.SECOND_RADIAL], *p[terms.TANGENTIAL])
    dist = (*(k + float(more) for k, more in zip(camera.dist[:4], change, strict=True)), *camera.dist[4:])
    taller = focal * float(np.exp(p[terms.ASPECT]))
    return replace(
        camera, fx=camera.fx * focal, fy=camera.fy * taller, cx=camera.cx + dx, cy=camera.cy + dy, dist=dist
    )


def stretched(grid: Grid, solution: Solution) -> Grid:
    """The lattice after a solve."""
    half = 0.5 * float(solution.parameters[terms.RATIO])
    a = None if grid.spacing_x is None else grid.spacing_x * float(np.exp(half))
    return replace(grid, spacing_x=a, spacing_y=grid.spacing_y * float(np.exp(-half)))
