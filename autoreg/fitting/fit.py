"""A refined pose with all that it was fitted to, and what the joints it rests on say of themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.sides import Grid
from autoreg.ground.stations import Stations, moved_by_shift
from autoreg.joints.edges import Offsets
from autoreg.joints.joint_looks import Strip, width_px_of
from autoreg.joints.profiles import Profiles
from autoreg.joints.widths import APART_BLURS, Widths, fit_widths
from autoreg.solve.freedom import Free, moved_camera, moved_pose, stretched
from autoreg.solve.joint_data import SHIFT
from autoreg.solve.solver import CAUCHY_SIGMAS, Solution

# Stations that keep less of their weight do not lie on their joint.
LEAST_WEIGHT = 0.1
# Rounds of reweighted least squares by which a pose follows changed measurements.
FOLLOWED_ROUNDS = 8


@dataclass(frozen=True)
class Fit:
    """A refined pose with all that it was fitted to.

    `weight` is each station's robust weight (0 to 1), `sigma_px` its expected scatter: measurement and the
    slabs' own irregularity together. What is `rimmed` was measured from its near slab's rim, by a width that
    other joints told, or up to the outer edge of a `bevel` in the light, so wide on the ground (else zero).
    """

    camera: Camera
    cam_from_ground: Rigid
    grid: Grid
    strip: Strip
    stations: Stations
    profiles: Profiles
    offsets: Offsets
    distances_px: Float[np.ndarray, " n"]
    sigma_px: Float[np.ndarray, " n"]
    usable: Bool[np.ndarray, " n"]
    solution: Solution
    free: Free
    rimmed: Bool[np.ndarray, " n"]
    bevel: Float[np.ndarray, " n"]

    @property
    def weight(self) -> Float[np.ndarray, " n"]:
        """Cauchy weight of each station; zero for one whose joint could not be measured."""
        return self.usable / (1.0 + (self.distances_px / (CAUCHY_SIGMAS * self.sigma_px)) ** 2)

    @property
    def met(self) -> int:
        """How many stations lie on their joint."""
        return int((self.weight >= LEAST_WEIGHT).sum())

    @property
    def missed(self) -> float:
        """Share of the stations that do not lie on their joint, in the family with more of them."""
        off, family = self.weight < LEAST_WEIGHT, self.stations.family
        return max(float(off[family == k].mean()) for k in np.unique(family))

    @property
    def roughness_px(self) -> float:
        """Median distance of the stations from their lines, in the family with the greater one."""
        used = [self.usable & (self.stations.family == k) for k in np.unique(self.stations.family)]
        return max(float(np.median(np.abs(self.distances_px[rows]))) for rows in used if rows.any())

    @property
    def by_shift_px(self) -> Float[np.ndarray, " n"]:
        """How far a unit of the bond's shift moves the projected joints, across them."""
        return moved_by_shift(self.stations, self.grid) * self.profiles.px_per_unit

    def moves_px(self, motion: Float[np.ndarray, " s"]) -> Float[np.ndarray, " n"]:
        """How far a small motion moves the projected joints, across them.

        The motion is of the solver's parameters, and of the bond's shift behind them.
        """
        return self.solution.jacobian @ motion[:SHIFT] + self.by_shift_px * motion[SHIFT]

    def moved(self, motion: Float[np.ndarray, " s"]) -> Fit:
        """The fit after a small motion of pose, camera and lattice; its joints are not measured anew."""
        step, shift = replace(self.solution, parameters=motion[:SHIFT]), float(motion[SHIFT])
        grid, stations = stretched(self.grid, step), self.stations
        if shift:
            ground = stations.ground + np.outer(shift * moved_by_shift(stations, self.grid), [1.0, 0.0])
            grid, stations = replace(grid, shift=grid.shift + shift), replace(stations, ground=ground)
        return replace(
            self,
            camera=moved_camera(self.camera, step),
            cam_from_ground=moved_pose(self.cam_from_ground, step),
            grid=grid,
            stations=stations,
            distances_px=self.distances_px + self.moves_px(motion),
        )

    def motion_along(self, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " k"]:
        """The motion by some columns, of which each is a station's change, that lays the joints best.

        Least squares by the stations' weights as they are.
        """
        weight = np.sqrt(self.weight) / self.sigma_px
        return np.linalg.lstsq(columns * weight[:, None], -self.distances_px * weight, rcond=1e-9)[0]

    def followed_px(self) -> Float[np.ndarray, " n"]:
        """Distances of the stations from their lines, once the pose has followed what is measured.

        To first order, by robust least squares: of measurements that were changed since the pose was fitted.
        """
        J = self.solution.jacobian[:, np.flatnonzero(self.free.mask)]
        columns, fit = J / np.maximum(np.linalg.norm(J, axis=0), 1e-12), self
        for _ in range(FOLLOWED_ROUNDS):
            fit = replace(fit, distances_px=fit.distances_px + columns @ fit.motion_along(columns))
        return fit.distances_px

    def measured_at(
        self,
        rows: Int[np.ndarray, " k"],
        offset_px: Float[np.ndarray, " k"],
        sigma_px: Float[np.ndarray, " k"],
    ) -> Fit:
        """The fit with other measurements of some stations; its pose stays."""
        offset, sigma = self.offsets.offset_px.copy(), self.offsets.sigma_px.copy()
        distances = self.distances_px.copy()
        # Distances are of the projected places from the measured ones.
        distances[rows] += offset[rows] - offset_px
        offset[rows], sigma[rows] = offset_px, sigma_px
        offsets = replace(self.offsets, offset_px=offset, sigma_px=sigma)
        return replace(self, offsets=offsets, distances_px=distances)

    @cached_property
    def apart(self) -> Bool[np.ndarray, " n"]:
        """Stations whose joint, darker or lighter than its slabs, is so wide that both of its edges show."""
        lined = np.array(self.strip.polarity)[self.stations.family] != 0
        expected = width_px_of(self.strip, self.stations, self.profiles)
        return self.usable & lined & ~self.rimmed & (expected > APART_BLURS * self.strip.blur_px)

    @cached_property
    def widths(self) -> Widths:
        """Middle and width of the joints that are `apart`, by their own two edges."""
        expected, rows = width_px_of(self.strip, self.stations, self.profiles), np.flatnonzero(self.apart)
        return fit_widths(self.profiles, self.offsets.offset_px, expected, self.strip.blur_px, rows)
