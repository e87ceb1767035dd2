"""Where joints are looked for in the picture: stations along every visible slab side."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import lengths, project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, Sides
from autoreg.numbering import numbered


@dataclass(frozen=True)
class Stations:
    """Short stretches of joint, each measured as one: centre on the ground, and which side it is of."""

    ground: Float[np.ndarray, "n 2"]
    half_length: Float[np.ndarray, " n"]
    family: Int[np.ndarray, " n"]
    line: Int[np.ndarray, " n"]
    cell: Int[np.ndarray, " n"]
    side: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of stations."""
        return len(self.family)

    def take(self, index: np.ndarray) -> Stations:
        """The chosen stations."""
        return Stations(*(getattr(self, f.name)[index] for f in fields(self)))

    @property
    def direction(self) -> Float[np.ndarray, "n 2"]:
        """Unit direction on the ground."""
        return np.where(self.family[:, None] == ALONG_X, [[1.0, 0.0]], [[0.0, 1.0]])


def moved_by_shift(stations: Stations, grid: Grid) -> Float[np.ndarray, " n"]:
    """How far a unit of the bond's shift moves stations along X: cross joints, course by course."""
    return np.where(stations.family == ALONG_Y, stations.cell * (grid.spacing_x or 0.0), 0.0)


def joints_of(stations: Stations, grid: Grid) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"]]:
    """Numbers of the joints that stations lie on, and where one station of each is.

    An unbroken joint is one; the cross joints of a running bond are one each, however short.
    """
    piece = np.where((stations.family == ALONG_Y) & (grid.shift != 0), stations.cell, 0)
    return numbered(stations.family, stations.line, piece)


def place_stations(
    sides: Sides,
    camera: Camera,
    cam_from_ground: Rigid,
    *,
    length_px: float = 24.0,
    limit: int = 2048,
    margin: float | Float[np.ndarray, " m"] = 0.1,
) -> Stations:
    """Stations of about `length_px` along each side, clear of the crossings at its ends.

    They keep off the ends by a `margin`, a share of the side or of each of the sides.
    Where they would be more than `limit`, they are spread over all sides by leaving out every so many.
    """
    px = project_ground(camera, cam_from_ground, sides.ends)
    margin = np.broadcast_to(margin, len(sides))
    usable = (1 - 2 * margin) * lengths(px[:, 1] - px[:, 0])
    count = np.clip(np.round(usable / length_px), 1, 12).astype(int)
    side = np.repeat(np.arange(len(sides)), count)
    nth = np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count)
    step = (1 - 2 * margin[side]) / count[side]
    fraction = margin[side] + (nth + 0.5) * step
    start, end = sides.ends[side, 0], sides.ends[side, 1]
    stations = Stations(
        ground=start + fraction[:, None] * (end - start),
        half_length=0.5 * step * lengths(end - start),
        family=sides.family[side],
        line=sides.line[side],
        cell=sides.cell[side],
        side=side,
    )
    if len(stations) > limit:
        keep = np.unique(np.linspace(0, len(stations) - 1, limit).astype(int))
        stations = stations.take(keep)
    return stations
