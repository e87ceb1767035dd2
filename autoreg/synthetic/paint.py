"""Tones of the ground: joints by the area that they cover of a pixel's footprint, slabs, and patterns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from autoreg.synthetic.relief import Side, seen_parts
from autoreg.synthetic.scene import SyntheticScene

# The random tables repeat after so many cells, far beyond what one photo shows sharply: a power of two.
TABLE = 128
# Of what a course has drifted by the next one keeps this share.
KEPT = 0.9

Tones = Float[np.ndarray, "*n"]
# Column and row of slabs.
Cell = tuple[Int[np.ndarray, "*n"], Int[np.ndarray, "*n"]]


def comb_coverage(x: Tones, width: Tones, period: float, band: Tones | float) -> Tones:
    """Part of the intervals [x - width/2, x + width/2] that lies in bands around the multiples of a period.

    Exact for any width, because it is the difference of the bands' integral at both ends.
    """

    def integral(s: Tones) -> Tones:
        nearest = np.round(s / period)
        return band * nearest + np.clip(s - period * nearest, -0.5 * band, 0.5 * band)

    return (integral(x + 0.5 * width) - integral(x - 0.5 * width)) / width


def band_coverage(gap: Tones, width: Tones, half_band: float) -> Tones:
    """Part of intervals that lies in one band, from the distances between their middles and the band's."""
    first = np.maximum(gap - 0.5 * width, -half_band)
    last = np.minimum(gap + 0.5 * width, half_band)
    return np.maximum(last - first, 0.0) / width


def of_cell(table: Float[np.ndarray, "m m"], i: Int[np.ndarray, "*n"], j: Int[np.ndarray, "*n"]) -> Tones:
    """The table's value of each cell, by its column and row."""
    return table.ravel().take(TABLE * (j & (TABLE - 1)) + (i & (TABLE - 1)))


def smooth_noise(table: Float[np.ndarray, "m m"], x: Tones, y: Tones) -> Tones:
    """Value noise of unit cells: the table's values at the corners, joined bilinearly."""
    i, j = np.floor(x), np.floor(y)
    p, q = x - i, y - j
    i, j = i.astype(np.int64), j.astype(np.int64)
    low, high = (of_cell(table, i, row) * (1 - p) + of_cell(table, i + 1, row) * p for row in (j, j + 1))
    return low * (1 - q) + high * q


def _drift(rng: np.random.Generator) -> Float[np.ndarray, "2 m"]:
    """What courses have drifted to, across them and along them, in sizes of a step."""
    # As if the last course were followed by the first.
    steps = np.fft.rfft(rng.standard_normal((2, TABLE)))
    return np.fft.irfft(steps / (1.0 - KEPT * np.exp(-2j * np.pi * np.fft.rfftfreq(TABLE))), TABLE)


class Ground:
    """The ground of one scene; its tables are drawn once, so that every sample sees the same stones."""

    def __init__(self, scene: SyntheticScene, rng: np.random.Generator) -> None:
        self.scene = scene
        self._tone = rng.standard_normal((TABLE, TABLE))
        self._shift_x = np.clip(rng.standard_normal((TABLE, TABLE)), -2.5, 2.5) * scene.jitter_m
        self._shift_y = np.clip(rng.standard_normal((TABLE, TABLE)), -2.5, 2.5) * scene.jitter_m
        self._noise = rng.standard_normal((3, TABLE, TABLE))
        self._sites = rng.uniform(0.1, 0.9, (TABLE, TABLE, 2))
        # Ends of the random slabs of a "rows" field: a sorted run of lengths per row, repeated along X.
        lengths = rng.uniform(0.5, 1.5, (TABLE, 32)) * scene.spacing_m[0]
        self._ends = np.cumsum(lengths, 1)
        turns = rng.spawn(1)[0].standard_normal((TABLE, 32))
        self._lean = np.tan(scene.lean_rad + scene.turn_rad * turns)
        # The last one is where the run is repeated.
        self._lean[:, -1] = 0.0
        self._eye = scene.cam_from_ground.origin_in_a
        heights, slab_turns = rng.spawn(1)[0].standard_normal((2, TABLE, TABLE))
        self._lift = np.clip(heights, -2.5, 2.5) * scene.lift_m
        self._slab_turn = slab_turns * scene.slab_turn_rad
        courses = np.clip(rng.spawn(1)[0].standard_normal((2, TABLE)), -2.5, 2.5)
        beside, along = courses * scene.course_jitter_m
        self._shift_y += beside[:, None]
        # The courses of a running bond move along X, each with its cross joints; else columns do.
        self._shift_x += along[:, None] if scene.shift else along
        self._drift = _drift(rng.spawn(1)[0]) * scene.course_drift_m
        # The most that moves a slab's side, across X and across Y, and that lifts a slab.
        turned = np.abs(self._slab_turn).max() * max(scene.spacing_m)
        self._most_aside = [np.abs(shift).max() + turned for shift in (self._shift_x, self._shift_y)]
        self._most_lift = np.abs(self._lift).max()

    def tone(self, x: Tones, y: Tones, width_x: Tones, width_y: Tones) -> Tones:
        """Grey levels of ground samples whose footprints are `width` wide."""
        kind = self.scene.kind
        if kind == "crazy":
            return self._crazy(x, y, np.hypot(width_x, width_y))
        if kind == "gravel":
            return self._gravel(x, y, np.hypot(width_x, width_y))
        if kind == "rows":
            return self._rows(x, y, width_x, width_y)
        if self.scene.course_drift_m:
            x, y = self._undrifted(x, y)
        if self.scene.has_relief:
            return self._sunk_lattice(x, y, width_x, width_y)
        return self._lattice(x, y, width_x, width_y)

    def _undrifted(self, x: Tones, y: Tones) -> tuple[Tones, Tones]:
        """Where on the ground these places would be if no course had drifted.

        Across the courses slabs and joints share what two courses have drifted apart.
        """
        course = y / self.scene.spacing_m[1]
        last = np.floor(course - 0.5).astype(np.int64)
        part = course - 0.5 - last
        aside, along = self._drift
        before, beyond = (aside[row & (TABLE - 1)] for row in (last, last + 1))
        own = along[np.floor(course).astype(np.int64) & (TABLE - 1)]
        return x - own, y - (1.0 - part) * before - part * beyond

    def texture(self, x: Tones, y: Tones, width: Tones) -> Tones:
        """Relative tone of stone at three scales; what is finer than the footprint averages out."""
        if self.scene.texture == 0:
            return np.ones_like(x)
        total = np.zeros_like(x)
        for table, grain in zip(self._noise, (0.5, 0.06, 0.012), strict=True):
            fade = np.minimum(1.0, (0.5 * grain / width) ** 2)
            total += fade * smooth_noise(table, x / grain, y / grain)
        return 1 + self.scene.texture * total / np.sqrt(3)

    def _slab_tone(self, i: Int[np.ndarray, "*n"], j: Int[np.ndarray, "*n"]) -> Tones:
        scene = self.scene
        tone = scene.slab_tone
        if scene.second_tone is not None:
            tone = np.where((i + j) % 2 == 0, scene.slab_tone, scene.second_tone)
        return tone * (1 + scene.tone_spread * of_cell(self._tone, i, j))

    def _lattice(self, x: Tones, y: Tones, width_x: Tones, width_y: Tones) -> Tones:
        scene = self.scene
        (a, b), joint = scene.spacing_m, scene.joint_width_m
        j = np.floor(y / b).astype(np.int64)
        x = x - np.mod(j * scene.shift, 1.0) * a
        i = np.floor(x / a).astype(np.int64)
        # A slab moves inside its own cell; the seam between cells lies in the middle of the joint, unseen.
        along_x = comb_coverage(y - of_cell(self._shift_y, i, j), width_y, b, joint)
        covered = along_x
        if scene.kind != "planks":
            across = comb_coverage(x - of_cell(self._shift_x, i, j), width_x, a, joint)
            covered = along_x + across - along_x * across
        else:
            i = np.zeros_like(i)
        return covered * scene.joint_tone + (1 - covered) * self._slab_tone(i, j)

    def _sunk_lattice(self, x: Tones, y: Tones, width_x: Tones, width_y: Tones) -> Tones:
        """The lattice with relief; where joints cross, the one along X goes on."""
        a, b = self.scene.spacing_m
        j = np.floor(y / b).astype(np.int64)
        i = self._column(x, j)
        # The line that is nearest, and what lies on its two sides.
        row = np.round(y / b).astype(np.int64)
        below, above = ((self._column(x, r), r) for r in (row - 1, row))
        along, joints = self._joint_along(1, below, above, x, y, (y - row * b, width_y, b))
        moved = x - np.mod(j * self.scene.shift, 1.0) * a
        column = np.round(moved / a).astype(np.int64)
        left, right = (column - 1, j), (column, j)
        across, cross_joints = self._joint_along(0, left, right, x, y, (moved - column * a, width_x, a))
        return joints + (1 - along) * (cross_joints + (1 - across) * self._slab_tone(i, j))

    def _joint_along(
        self, axis: int, before: Cell, beyond: Cell, x: Tones, y: Tones, comb: tuple[Tones, Tones, float]
    ) -> tuple[Tones, Tones]:
        """How much of each footprint the joints across one axis cover, and that much of their tone.

        Args:
            axis: the ground axis across the joint.
            before: the slab on the nearest joint's side of smaller coordinates.
            beyond: the slab on its other side.
            x: of the samples.
            y: of the samples.
            comb: the samples' distances from the nearest joint's line, their footprints' widths, the spacing.
        """
        half = 0.5 * self.scene.joint_width_m
        slope = ((x, y)[axis] - self._eye[axis]) / self._eye[2]
        # Footprints that lie beside every joint, as most do, need not be asked what they see of one.
        some = np.flatnonzero(np.abs(comb[0]) <= self._joint_reach(axis, slope) + 0.5 * comb[1])
        x, y, slope, away_m, width_m = (values[some] for values in (x, y, slope, *comb[:2]))
        before, beyond = ((i[some], j[some]) for i, j in (before, beyond))
        low, high = self._side(axis, -half, before, x, y), self._side(axis, half, beyond, x, y)
        covered, tones = np.zeros(comb[0].shape), np.zeros(comb[0].shape)
        for part in seen_parts(self.scene, low, high, slope, axis):
            share = comb_coverage(away_m - part.middle_m, width_m, comb[2], part.width_m)
            covered[some] += share
            tones[some] += share * part.tone
        return covered, tones

    def _joint_reach(self, axis: int, slope: Tones) -> Tones:
        """How far from its line a joint may be seen, at the slabs' level."""
        rim = 0.5 * self.scene.joint_width_m + self.scene.chamfer_m
        return rim + self._most_aside[axis] + np.abs(slope) * (self._most_lift + self.scene.chamfer_m)

    def _side(self, axis: int, edge_m: float, slab: Cell, x: Tones, y: Tones) -> Side:
        """The side of a slab whose edge ought to lie at a distance from the joint's line."""
        (a, b), (i, j) = self.scene.spacing_m, slab
        middle = (i + 0.5 + np.mod(j * self.scene.shift, 1.0)) * a, (j + 0.5) * b
        lever = (middle[1] - y, x - middle[0])[axis]
        shift = (self._shift_x, self._shift_y)[axis]
        place = of_cell(shift, i, j) + of_cell(self._slab_turn, i, j) * lever
        return Side(edge_m + place, of_cell(self._lift, i, j), self._slab_tone(i, j))

    def _column(self, x: Tones, j: Int[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
        a = self.scene.spacing_m[0]
        return np.floor((x - np.mod(j * self.scene.shift, 1.0) * a) / a).astype(np.int64)

    def _rows(self, x: Tones, y: Tones, width_x: Tones, width_y: Tones) -> Tones:
        scene = self.scene
        b, joint = scene.spacing_m[1], scene.joint_width_m
        j = np.floor(y / b).astype(np.int64)
        along = comb_coverage(y, width_y, b, joint)
        ends = self._ends[j % TABLE]
        turn = np.mod(x, ends[..., -1])
        ends = ends + self._lean[j % TABLE] * (y - (j + 0.5) * b)[..., None]
        i = np.sum(ends <= turn[..., None], axis=-1)
        left = np.where(i > 0, np.take_along_axis(ends, np.maximum(i - 1, 0)[..., None], -1)[..., 0], 0.0)
        right = np.take_along_axis(ends, i[..., None], -1)[..., 0]
        gap = np.minimum(turn - left, right - turn)
        across = band_coverage(gap, width_x, 0.5 * joint)
        covered = along + across - along * across
        return covered * scene.joint_tone + (1 - covered) * self._slab_tone(i, j)

    def _crazy(self, x: Tones, y: Tones, width: Tones) -> Tones:
        """Voronoi cells of a shaken grid; the joint is where the two nearest sites are about equally far."""
        scene = self.scene
        size = scene.spacing_m[0]
        i, j = np.floor(x / size).astype(np.int64), np.floor(y / size).astype(np.int64)
        first = np.full(x.shape, np.inf)
        second = np.full(x.shape, np.inf)
        stone = np.zeros(x.shape, np.int64)
        for dj in (-1, 0, 1):
            for di in (-1, 0, 1):
                site = self._sites[(j + dj) % TABLE, (i + di) % TABLE]
                away = np.hypot(x / size - i - di - site[..., 0], y / size - j - dj - site[..., 1])
                nearer = away < first
                second = np.minimum(second, np.where(nearer, first, away))
                stone = np.where(nearer, (i + di) * 31 + (j + dj), stone)
                first = np.minimum(first, away)
        covered = band_coverage(0.5 * size * (second - first), width, scene.joint_width_m)
        return covered * scene.joint_tone + (1 - covered) * self._slab_tone(stone, np.zeros_like(stone))

    def _gravel(self, x: Tones, y: Tones, width: Tones) -> Tones:
        total = np.zeros_like(x)
        for table, grain in zip(self._noise, (0.04, 0.015, 0.006), strict=True):
            fade = np.minimum(1.0, 0.5 * grain / width)
            total += fade * smooth_noise(table, x / grain + 7.3, y / grain + 1.7)
        return self.scene.slab_tone * (1 + 0.25 * total)
