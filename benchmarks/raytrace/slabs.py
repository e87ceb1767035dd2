"""Where the slabs of a paved field lie, and their boxes in POV-Ray's words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from .scene import Paving
from .textures import TONES


@dataclass(frozen=True)
class Slabs:
    """Rectangles on the ground: middles, sizes (joints taken off), turns, and a cell index for tones."""

    middle_m: Float[np.ndarray, "n 2"]
    size_m: Float[np.ndarray, "n 2"]
    turn_deg: Float[np.ndarray, " n"]
    parity: Int[np.ndarray, " n"]

    def keep(self, mask: Bool[np.ndarray, " n"]) -> Slabs:
        """The slabs that a mask names."""
        return Slabs(self.middle_m[mask], self.size_m[mask], self.turn_deg[mask], self.parity[mask])


def _fan(paving: Paving, centre: np.ndarray, half: float) -> Slabs:
    """Setts in segmental arcs: columns of arcs, one above the other at the setts' own pitch."""
    sett, width = 0.11, 1.3
    radius = 0.75 * width
    spread = np.arcsin(0.5 * width / radius)
    angles = np.linspace(-spread, spread, int(2 * spread * radius / sett) + 1)
    arc = radius * np.column_stack([np.sin(angles), np.cos(angles)])
    columns = np.arange(-int(half / width), int(half / width) + 1) * width
    steps = np.arange(-half - radius, half, 1.05 * sett)
    apexes = np.stack(np.meshgrid(columns, steps), -1).reshape(-1, 1, 2)
    middle = (centre + apexes + arc).reshape(-1, 2)
    turn = np.tile(-np.rad2deg(angles), len(apexes))
    size = np.full((len(middle), 2), sett - paving.joint_m)
    return Slabs(middle, size, turn, np.zeros(len(middle), int))


def _rings(paving: Paving, centre: np.ndarray, half: float, rng: np.random.Generator) -> Slabs:
    """Setts in rings about a point at the field's edge, as many to a ring as find room."""
    sett = paving.slab_m[0]
    away, radius = rng.uniform(0.3, 1.0) * half, np.arange(2, int(2 * half / sett)) * sett
    way = rng.uniform(0.0, 2 * np.pi)
    hub = centre + away * np.array([np.cos(way), np.sin(way)])
    middles, turns = [], []
    for r in radius:
        count = int(2 * np.pi * r / sett)
        angle = rng.uniform(0.0, 2 * np.pi) + 2 * np.pi * np.arange(count) / count
        middles.append(hub + r * np.column_stack([np.cos(angle), np.sin(angle)]))
        turns.append(np.rad2deg(angle))
    middle, turn = np.concatenate(middles), np.concatenate(turns)
    near = np.abs(middle - centre).max(1) < half
    size = np.full((len(middle), 2), sett - paving.joint_m)
    return Slabs(middle, size, turn, np.zeros(len(middle), int)).keep(near)


def _waves(paving: Paving, centre: np.ndarray, half: float, rng: np.random.Generator) -> Slabs:
    """Setts in rows that go up and down together, each row at the setts' own pitch from the next."""
    sett = paving.slab_m[0]
    length, rise = rng.uniform(8.0, 20.0) * sett, rng.uniform(0.6, 1.5) * sett
    x = np.arange(-half, half, sett)
    phase = 2 * np.pi * x / length
    slope = rise * 2 * np.pi / length * np.cos(phase)
    y = np.arange(-half, half, sett * float(np.sqrt(1.0 + slope.max() ** 2)))
    middle = np.stack([np.tile(x, (len(y), 1)), y[:, None] + rise * np.sin(phase)], -1).reshape(-1, 2)
    turn = np.tile(np.rad2deg(np.arctan(slope)), len(y))
    size = np.full((len(middle), 2), sett - paving.joint_m)
    return Slabs(centre + middle, size, turn, np.zeros(len(middle), int))


def _herringbone(paving: Paving, centre: np.ndarray, half: float) -> Slabs:
    """Bricks twice as long as wide, each at a right angle to its neighbours."""
    side = paving.slab_m[1]
    n = int(half / side)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(-n, n), np.arange(-n, n)))
    phase = (i - j) % 4
    lying, standing = phase == 0, phase == 3
    corner = np.column_stack([i, j])
    middle = np.concatenate([corner[lying] + [1.0, 0.5], corner[standing] + [0.5, 1.0]]) * side + centre
    size = np.concatenate([np.tile([2.0, 1.0], (lying.sum(), 1)), np.tile([1.0, 2.0], (standing.sum(), 1))])
    zeros = np.zeros(len(middle))
    return Slabs(middle, size * side - paving.joint_m, zeros, zeros.astype(int))


def _rows(paving: Paving, centre: np.ndarray, half: float, rng: np.random.Generator) -> Slabs:
    """Unbroken joints at y = j b; slabs of random length between them."""
    b = paving.slab_m[1]
    middles, sizes = [], []
    for j in range(int((centre[1] - half) / b), int((centre[1] + half) / b)):
        x = centre[0] - half + rng.uniform(0, 1)
        while x < centre[0] + half:
            length = paving.slab_m[0] * rng.uniform(0.5, 1.5)
            middles.append((x + 0.5 * length, (j + 0.5) * b))
            sizes.append((length - paving.joint_m, b - paving.joint_m))
            x += length
    zeros = np.zeros(len(middles))
    return Slabs(np.array(middles), np.array(sizes), zeros, zeros.astype(int))


def _lattice(paving: Paving, centre: np.ndarray, half: float) -> Slabs:
    a, b = paving.slab_m
    j = np.arange(int((centre[1] - half) / b), int((centre[1] + half) / b))
    n = int(2 * half / a) + 1
    i, j = (g.ravel() for g in np.meshgrid(np.arange(n), j))
    # Each row starts at the cell that is nearest to the field's left edge, wherever its bond has moved it.
    first = np.floor((centre[0] - half) / a - j * paving.shift)
    i = i + first
    middle = np.column_stack([(i + 0.5 + j * paving.shift) * a, (j + 0.5) * b])
    size = np.tile([a - paving.joint_m, b - paving.joint_m], (len(middle), 1))
    return Slabs(middle, size, np.zeros(len(middle)), (i + j).astype(int) % 2)


def lay(paving: Paving, centre_m: np.ndarray, rng: np.random.Generator) -> Slabs:
    """Slabs of a field around a ground point, each at its exact place."""
    half = paving.half_size_m
    if paving.layout == "rows":
        return _rows(paving, centre_m, half, rng)
    if paving.layout == "herringbone":
        return _herringbone(paving, centre_m, half)
    if paving.layout == "fan":
        return _fan(paving, centre_m, half)
    if paving.layout == "rings":
        return _rings(paving, centre_m, half, rng)
    if paving.layout == "waves":
        return _waves(paving, centre_m, half, rng)
    if paving.layout == "planks":
        b = paving.slab_m[1]
        j = np.arange(int((centre_m[1] - half) / b), int((centre_m[1] + half) / b))
        middle = np.column_stack([np.full(len(j), centre_m[0]), (j + 0.5) * b])
        size = np.tile([4 * half, b - paving.joint_m], (len(j), 1))
        return Slabs(middle, size, np.zeros(len(j)), j % 2)
    return _lattice(paving, centre_m, half)


def _body(half_x: float, half_y: float, chamfer: float) -> str:
    """A slab's body about the middle of its top, up to where its texture follows."""
    box = f"<{-half_x:.5f},{-half_y:.5f},-0.04>, <{half_x:.5f},{half_y:.5f},0>"
    if not chamfer:
        return f"box {{ {box}"
    rims = [("<1,0,1>", half_x), ("<-1,0,1>", half_x), ("<0,1,1>", half_y), ("<0,-1,1>", half_y)]
    cuts = " ".join(f"plane {{ {normal}, {(half - chamfer) / np.sqrt(2):.6f} }}" for normal, half in rims)
    return f"intersection {{ box {{ {box} }} {cuts} bounded_by {{ box {{ {box} }} }}"


def boxes_text(paving: Paving, slabs: Slabs, rng: np.random.Generator, prefix: str = "Stone") -> str:
    """One box per slab, moved, lifted and turned by the jitter, its texture cut from a place of its own."""
    n = len(slabs.middle_m)
    middle = slabs.middle_m + paving.place_jitter_m * rng.standard_normal((n, 2))
    # No slab sinks under its bed.
    limit = 0.4 * paving.depth_m
    lift = np.clip(paving.height_jitter_m * rng.standard_normal(n), -limit, limit)
    turn = slabs.turn_deg + paving.turn_jitter_deg * rng.standard_normal(n)
    tone = rng.integers(0, TONES // 2 if paving.checker else TONES, n)
    tone = tone + (TONES // 2) * slabs.parity if paving.checker else tone
    cut = rng.uniform(-50, 50, (n, 3))
    parts = ["union {\n"]
    for k in range(n):
        hx, hy = 0.5 * slabs.size_m[k]
        x, y = middle[k]
        dx, dy, dz = cut[k]
        parts.append(
            f"{_body(hx, hy, paving.chamfer_m)} "
            f"texture {{ {prefix}{tone[k]} translate <{dx:.2f},{dy:.2f},{dz:.2f}> }} "
            f"rotate z*{turn[k]:.4f} translate <{x:.5f},{y:.5f},{lift[k]:.5f}> }}\n"
        )
    parts.append("}\n")
    return "".join(parts)


def joint_growth_text(paving: Paving, slabs: Slabs, rng: np.random.Generator) -> str:
    """Moss cushions along part of the joints, and joints filled flush with the slabs' own colour."""
    parts: list[str] = []
    for (x, y), (w, h) in zip(slabs.middle_m, slabs.size_m, strict=True):
        # Each slab owns the joint on its left and the joint below it.
        for along, length in (("y", h), ("x", w)):
            offset = 0.5 * ((w if along == "y" else h) + paving.joint_m)
            fate = rng.uniform()
            if fate < paving.missing:
                half_w = 0.5 * paving.joint_m + 0.001
                if along == "y":
                    box = (x - offset - half_w, y - length / 2, x - offset + half_w, y + length / 2)
                else:
                    box = (x - length / 2, y - offset - half_w, x + length / 2, y - offset + half_w)
                parts.append(
                    f"box {{ <{box[0]:.4f},{box[1]:.4f},-0.03>, <{box[2]:.4f},{box[3]:.4f},0.0004> "
                    f"texture {{ Stone{rng.integers(TONES)} }} }}\n"
                )
            elif fate < paving.missing + paving.moss:
                start, stop = np.sort(rng.uniform(-0.5, 0.5, 2)) * length
                for s in np.arange(start, stop, 0.012):
                    r = paving.joint_m * rng.uniform(0.35, 1.3)
                    side = rng.normal(0, 0.25 * paving.joint_m)
                    px, py = (x - offset + side, y + s) if along == "y" else (x + s, y - offset + side)
                    parts.append(
                        f"sphere {{ 0, 1 scale <{r:.4f},{r:.4f},{0.35 * r:.4f}> "
                        f"translate <{px:.4f},{py:.4f},0> texture {{ Moss }} }}\n"
                    )
    moss = (
        "#declare Moss = texture { pigment { bozo scale 0.02 color_map { [0 rgb <0.03,0.06,0.01>] "
        "[1 rgb <0.16,0.2,0.06>] } } finish { ambient 0.2 diffuse 0.7 } }\n"
    )
    return moss + "union {\n" + "".join(parts) + "}\n" if parts else ""
