"""Refinement: projected joints are laid on the photographed ones and measured again, until all is still."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.measure import NARROW, Measured, measure
from autoreg.fitting.scatter import beside_rim, scatter_model
from autoreg.geometry import Rigid
from autoreg.ground.points import project_ground
from autoreg.ground.sides import Grid
from autoreg.ground.stations import Stations
from autoreg.joints.edges import Offsets
from autoreg.joints.joint_looks import Strip
from autoreg.joints.profiles import Profiles
from autoreg.joints.smeared_looks import smear_px
from autoreg.solve.freedom import Free, moved_camera, moved_pose, stretched
from autoreg.solve.joint_data import JointData, parameter_scale
from autoreg.solve.solver import CAPACITY, CAUCHY_SIGMAS, MOST_STEPS, solve_joints

# Solves per round, each with the scatter that the one before left.
SOLVES = 2
# A slab's side is at least this part of the camera's height, as of setts below a drone, and at most as many
# times it.
MOST_SIDES = 1000.0
# Where what is near must bring the farther joints within reach: how far to look, in camera heights, and the
# half width of the first search, in slab sides.
FROM_THE_FEET, WIDE_SEARCH = (2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 9.0, 12.0), 0.15
# A motion by less than this share of the joints' median distance from their lines does not matter; and what
# all further rounds would move joints by, as a share of the last motion: each moves them by about a third as
# far as the one before, at the most.
STILL_SHARE, TO_COME = 0.04, 0.5


def refine(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    *,
    free: Free,
    search: float,
    reaches: tuple[float, ...],
    strip: Strip | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    limit: int = CAPACITY,
    steady_px: float = 0.0,
    most_steps: int = MOST_STEPS,
) -> Fit | None:
    """The pose at which the projected joints lie on the photographed ones; None if nothing can be measured.

    Args:
        picture: grey levels that `camera` belongs to.
        camera: its camera.
        cam_from_ground: start; the lattice's unit is that of its translation.
        grid: start of the lattice.
        free: what else is solved for.
        search: half width of the first search, in slab sides; 0 starts from the predicted places.
        reaches: how far to look in each round, in camera heights.
        strip: looks of the joints, if known.
        field: where on the ground the paving is, a convex polygon; everywhere if None.
        limit: the most stations that are measured.
        steady_px: the rounds end with the first one that moves the joints by less than this (RMS).
        most_steps: of a solve.
    """
    fit: Fit | None = None
    for reach in reaches:
        before = (camera, cam_from_ground, grid)
        found = measure(
            picture, camera, cam_from_ground, grid, strip,
            search=search, reach=reach, field=field, limit=limit,
        )  # fmt: skip
        now = None if found is None else _laid_on(found, *before, free, search, most_steps)
        if now is None:
            return fit
        fit = now
        camera, cam_from_ground, grid, strip = fit.camera, fit.cam_from_ground, fit.grid, fit.strip
        search = 0.5 * search if search >= 0.06 else 0.0
        if steady_px and _motion_px(fit, *before) < steady_px:
            break
    return fit


def refine_until_still(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    *,
    free: Free,
    search: float,
    reach: float,
    strip: Strip | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    still_px: float = 0.003,
    most_rounds: int = 6,
    most_steps: int = MOST_STEPS,
) -> Fit | None:
    """Like `refine` at one reach, measured again until joints would move by no more than `still_px` (RMS).

    Where the joints lie less even, a part of how far they are off their lines is still enough.
    """
    fit: Fit | None = None
    for _ in range(most_rounds):
        before = (camera, cam_from_ground, grid)
        fit = refine(
            picture, *before,
            free=free, search=search, reaches=(reach,), strip=strip, field=field, most_steps=most_steps,
        )  # fmt: skip
        if fit is None:
            return None
        settled = strip is not None and fit.strip.like(strip)
        camera, cam_from_ground, grid, strip = fit.camera, fit.cam_from_ground, fit.grid, fit.strip
        if search and not strip.smeared:
            strip = replace(strip, smear_px=smear_px(fit.profiles, fit.stations, strip, fit.usable))
            if strip.smeared:
                continue
        enough_px = max(still_px, STILL_SHARE * float(np.median(np.abs(fit.distances_px[fit.usable]))))
        if not search and settled and TO_COME * _motion_px(fit, *before) < enough_px:
            break
        search = 0.0
    return fit


def _motion_px(fit: Fit, camera: Camera, pose: Rigid, grid: Grid) -> float:
    """RMS motion, across the joints, of the fit's stations from an earlier state."""
    stretched_ground = fit.stations.ground * fit.grid.stretch_from(grid)
    now = project_ground(fit.camera, fit.cam_from_ground, stretched_ground)
    was = project_ground(camera, pose, fit.stations.ground)
    across = ((now - was) * fit.profiles.normal).sum(1)
    return float(np.sqrt(np.mean(across**2)))


def _laid_on(
    found: Measured, camera: Camera, pose: Rigid, grid: Grid, free: Free, search: float, most_steps: int
) -> Fit | None:
    """The lattice laid on joints as they were measured, where a state had them; None if it runs away."""
    stations, profiles, offsets, usable = found.stations, found.profiles, found.offsets, found.usable
    sigma = np.hypot(offsets.sigma_px, 0.3)
    fit: Fit | None = None
    # While joints are searched farther off the next round solves again.
    rough = search > NARROW
    for _ in range(1 if rough else SOLVES):
        data = joint_data(camera, pose, stations, profiles, offsets, sigma, usable)
        prior = free.prior(camera, grid)
        solution = solve_joints(data, free.mask, prior, rough=rough, most_steps=most_steps)
        moved, new_grid = moved_pose(pose, solution), stretched(grid, solution)
        if solution.outcome == "diverged" or not plausible(moved, new_grid):
            return fit
        distances = solution.distances_px
        if not search:
            usable = usable & ~beside_rim(distances, profiles.px_per_unit * found.across, stations, usable)
        sigma = scatter_model(distances, offsets.sigma_px, profiles.px_per_unit, stations.side, usable)
        fit = Fit(
            camera=moved_camera(camera, solution),
            cam_from_ground=moved,
            grid=new_grid,
            strip=found.strip,
            stations=stations,
            profiles=profiles,
            offsets=offsets,
            distances_px=distances,
            sigma_px=sigma,
            usable=usable,
            solution=solution,
            free=free,
            rimmed=np.zeros(len(stations), dtype=bool),
            bevel=np.zeros(len(stations)),
        )
    return fit


def plausible(pose: Rigid, grid: Grid) -> bool:
    """Whether a lattice may be one of slabs, in the unit of the pose: what nothing holds can run away."""
    height = float(pose.origin_in_a[2])
    sides = np.array(grid.slab_size) / height
    return bool(height > 0 and (sides > 1.0 / MOST_SIDES).all() and (sides < MOST_SIDES).all())


def joint_data(
    camera: Camera,
    pose: Rigid,
    stations: Stations,
    profiles: Profiles,
    offsets: Offsets,
    sigma_px: Float[np.ndarray, " n"],
    usable: Bool[np.ndarray, " n"],
) -> JointData:
    """The measured joints in the solver's form."""
    height = float(pose.origin_in_a[2])
    return JointData(
        ground=stations.ground,
        measured_px=profiles.centre_px + offsets.offset_px[:, None] * profiles.normal,
        normal=profiles.normal,
        weight=usable / (CAUCHY_SIGMAS * sigma_px),
        R=pose.R,
        t=pose.t,
        intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist]),
        scale=parameter_scale(height, camera.fx),
    )
