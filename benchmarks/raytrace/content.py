"""The text of a scene for POV-Ray: camera, light, paving, and what stands on it and around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.synthetic import ground_points

from .scene import Paving, Scene
from .slabs import Slabs, boxes_text, joint_growth_text, lay
from .textures import bed, lawn, patternless, rgb, stone, tone_factors, water_film

MAX_SLABS = 9000


def _vector(v: np.ndarray) -> str:
    return "<" + ",".join(f"{c:.12g}" for c in v) + ">"


def camera_text(camera: Camera, cam_from_ground: Rigid) -> str:
    """POV-Ray's camera; its skew `direction` is the principal point away from the middle."""
    right, down, forward = cam_from_ground.R
    w, h, fx, fy = camera.width, camera.height, camera.fx, camera.fy
    direction = forward + ((w - 1) / 2 - camera.cx) / fx * right + ((h - 1) / 2 - camera.cy) / fy * down
    return (
        f"camera {{ location {_vector(cam_from_ground.origin_in_a)} right {_vector(w / fx * right)} "
        f"up {_vector(-h / fy * down)} direction {_vector(direction)} }}\n"
    )


def _sun(scene: Scene) -> np.ndarray:
    e, a = np.deg2rad([scene.sun_elevation_deg, scene.sun_azimuth_deg])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def _seen_point(scene: Scene, rng: np.random.Generator, far_m: float) -> np.ndarray:
    """A random ground point that the picture shows, no farther from the camera than `far_m`."""
    eye = scene.cam_from_ground.origin_in_a
    size = [scene.camera.width, scene.camera.height]
    pixels = rng.uniform(0.05, 0.95, (400, 2)) * size
    points = ground_points(pixels, scene.camera.K, scene.cam_from_ground)
    near = points[np.linalg.norm(points - eye[:2], axis=1) < far_m]
    return near[0] if len(near) else eye[:2]


def _visible(scene: Scene, camera: Camera, slabs: Slabs) -> np.ndarray:
    """Which slabs the picture may show, with a margin."""
    half = 0.5 * slabs.size_m
    inside = np.zeros(len(slabs.middle_m), bool)
    for sx, sy in [(0, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1)]:
        corner = np.column_stack([slabs.middle_m + half * [sx, sy], np.zeros(len(half))])
        at = scene.cam_from_ground.apply(corner)
        x, y = at[:, 0] / np.maximum(at[:, 2], 1e-6), at[:, 1] / np.maximum(at[:, 2], 1e-6)
        u, v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
        mx, my = 0.1 * camera.width, 0.1 * camera.height
        inside |= (
            (at[:, 2] > 0.05) & (u > -mx) & (u < camera.width + mx) & (v > -my) & (v < camera.height + my)
        )
    foot = scene.cam_from_ground.origin_in_a[:2]
    return inside | (np.linalg.norm(slabs.middle_m - foot, axis=1) < 0.6)


def _stones(paving: Paving, rng: np.random.Generator, prefix: str = "Stone") -> str:
    return "".join(
        stone(f"{prefix}{k}", paving.albedo, paving, float(f))
        for k, f in enumerate(tone_factors(paving, rng))
    )


def _border(scene: Scene, slabs: Slabs, centre: np.ndarray, rng: np.random.Generator) -> tuple[Slabs, str]:
    """The main field cut off at a straight joint, and what lies beyond."""
    axis = int(rng.integers(2))
    cut_px = rng.choice([0.15, 0.85]) * scene.camera.width, 0.55 * scene.camera.height
    cut = ground_points(np.array([cut_px]), scene.camera.K, scene.cam_from_ground)[0]
    if np.isnan(cut).any():
        return slabs, ""
    pitch = scene.paving.slab_m[axis]
    cut_m = round(cut[axis] / pitch) * pitch
    side = np.sign(centre[axis] - cut_m) or 1.0
    main = slabs.keep(side * (slabs.middle_m[:, axis] - cut_m) > 0)
    if scene.border == "lawn":
        first, second = [0.0, 0.0], [0.0, 0.0]
        first[axis], second[axis] = cut_m, cut_m - side * 40
        first[1 - axis], second[1 - axis] = centre[1 - axis] - 40, centre[1 - axis] + 40
        low, high = np.minimum(first, second), np.maximum(first, second)
        return main, f"box {{ <{low[0]},{low[1]},-0.1>, <{high[0]},{high[1]},0.02> {lawn()} }}\n"
    other = replace(
        scene.paving,
        slab_m=(0.2, 0.1),
        shift=0.5,
        joint_m=0.005,
        checker=False,
        albedo=(0.35, 0.2, 0.15),
        half_size_m=min(7.0, scene.paving.half_size_m),
    )
    around = lay(other, np.array([*cut]), rng)
    around = around.keep(side * (around.middle_m[:, axis] - cut_m) < -0.055)
    around = around.keep(_visible(scene, scene.camera, around))
    return main, _stones(other, rng, "Brick") + boxes_text(other, around, rng, "Brick")


def _occluders(scene: Scene, rng: np.random.Generator) -> str:
    """Things outside the picture that throw their shadows into it."""
    sun = _sun(scene)
    reach = 3.5 * scene.cam_from_ground.origin_in_a[2] + 2
    parts: list[str] = []
    for thing in scene.shadows:
        target = np.array([*_seen_point(scene, rng, reach), 0.0])
        if thing == "tree":
            middle = target + sun * (4.0 / sun[2])
            balls = middle + rng.normal(0, 0.55, (260, 3))
            parts += [f"sphere {{ {_vector(p)}, {rng.uniform(0.05, 0.2):.3f} }}" for p in balls]
            foot = np.array([middle[0], middle[1], 0.0])
            parts.append(f"cylinder {{ {_vector(foot)}, {_vector(middle)}, 0.12 }}")
        elif thing == "pole":
            top = target + sun * (2.5 / sun[2])
            parts.append(f"cylinder {{ <{top[0]:.3f},{top[1]:.3f},0>, {_vector(top)}, 0.05 }}")
        elif thing == "fence":
            angle = rng.uniform(0, np.pi)
            along = np.array([np.cos(angle), np.sin(angle), 0.0])
            base = target + sun * (1.0 / sun[2])
            for k in range(-12, 13):
                foot = base + along * 0.13 * k
                foot[2] = 0.3
                parts.append(
                    f"cylinder {{ {_vector(foot)}, {_vector(foot + np.array([0, 0, 1.2]))}, 0.025 }}"
                )
        else:
            corner = target + sun * (3.0 / sun[2])
            turn = rng.uniform(0, 90)
            parts.append(
                f"box {{ <0,0,0>, <4,2,{corner[2]:.2f}> rotate z*{turn:.1f} "
                f"translate <{corner[0]:.2f},{corner[1]:.2f},0> }}"
            )
    if not parts:
        return ""
    return "union {\n" + "\n".join(parts) + "\npigment { rgb 0.2 } no_image no_reflection }\n"


def _objects(scene: Scene, rng: np.random.Generator) -> str:
    """Boxes, balls and posts that stand on the paving, and fallen leaves."""
    height = scene.cam_from_ground.origin_in_a[2]
    parts: list[str] = []
    for _ in range(scene.clutter):
        x, y = _seen_point(scene, rng, 4 * height)
        s = rng.uniform(0.04, 0.13) * height
        colour = rgb(tuple(rng.uniform(0.05, 0.8, 3)))
        shape = rng.integers(3)
        if shape == 0:
            a, b, c = s * rng.uniform(0.5, 1.6, 3)
            turn = 90 * rng.uniform()
            body = f"box {{ <{-a:.3f},{-b:.3f},0>, <{a:.3f},{b:.3f},{2 * c:.3f}> rotate z*{turn:.1f}"
        elif shape == 1:
            body = f"sphere {{ <0,0,{s:.3f}>, {s:.3f}"
        else:
            body = f"cylinder {{ 0, <0,0,{4 * s:.3f}>, {0.4 * s:.3f}"
        parts.append(
            f"{body} translate <{x:.3f},{y:.3f},0> pigment {{ {colour} }} "
            "finish { ambient 0.25 diffuse 0.7 } }"
        )
    for _ in range(scene.leaves):
        x, y = _seen_point(scene, rng, 3 * height)
        a, b = rng.uniform(0.01, 0.035), rng.uniform(0.008, 0.02)
        colour = rgb((rng.uniform(0.15, 0.6), rng.uniform(0.1, 0.3), 0.03))
        parts.append(
            f"sphere {{ 0, 1 scale <{a:.3f},{b:.3f},0.003> rotate x*{rng.uniform(-12, 12):.1f} "
            f"rotate z*{rng.uniform(0, 360):.1f} translate <{x:.3f},{y:.3f},0.004> pigment {{ {colour} }} "
            "finish { ambient 0.25 diffuse 0.7 } }"
        )
    return "\n".join(parts) + "\n"


def _house(scene: Scene, rng: np.random.Generator) -> str:
    """A brick front with windows across the far end of the paving, parallel to its joints."""
    eye, ahead = scene.cam_from_ground.origin_in_a, scene.cam_from_ground.R[2]
    quarter = round(np.rad2deg(np.arctan2(ahead[1], ahead[0])) / 90)
    brick = (
        "brick color rgb <0.45,0.43,0.4> color rgb <0.4,0.16,0.1> brick_size <0.24,0.075,0.12> mortar 0.012 "
        "rotate x*90 rotate z*90"
    )
    distance = rng.uniform(2.2, 4.0) * eye[2]
    panes = "".join(
        f"box {{ <-0.06,{y - 0.6:.2f},0.9>, <0.05,{y + 0.6:.2f},2.3> pigment {{ rgb <0.08,0.1,0.13> }} "
        "finish { reflection 0.2 } }\n"
        for y in np.arange(-12, 13, 3) + rng.uniform(-1, 1)
    )
    return (
        f"union {{ box {{ <0,-20,0>, <0.4,20,6> pigment {{ {brick} }} "
        f"finish {{ ambient 0.3 diffuse 0.6 }} }}\n{panes}"
        f"translate x*{distance:.3f} rotate z*{90 * quarter} translate <{eye[0]:.3f},{eye[1]:.3f},0> }}\n"
    )


def scene_text(scene: Scene, camera: Camera) -> str:
    """The whole scene for POV-Ray, seen through an undistorted camera."""
    rng = np.random.default_rng([scene.seed, 7])
    paving = scene.paving
    sun = _sun(scene)
    parts = [
        "#version 3.7;\nglobal_settings { assumed_gamma 1.0 }\n",
        camera_text(camera, scene.cam_from_ground),
        "sky_sphere { pigment { gradient z "
        "color_map { [0 rgb <0.75,0.8,0.86>] [0.6 rgb <0.35,0.52,0.8>] } } }\n",
        f"light_source {{ {_vector(sun * 1000)} rgb <1.05,1.0,0.92> parallel point_at 0 }}\n",
    ]
    if paving.layout == "wall":
        brick = (
            "brick color rgb <0.5,0.48,0.45> color rgb <0.42,0.2,0.13> "
            "brick_size <0.24,0.075,0.12> mortar 0.01 rotate x*90"
        )
        parts.append(
            f"box {{ <-20,0,0>, <20,0.4,9> pigment {{ {brick} }} normal {{ granite 0.3 scale 0.05 }} "
            "finish { ambient 0.35 diffuse 0.6 } }\n"
            f"plane {{ z, 0 pigment {{ {rgb(scene.surround)} }} }}\n"
        )
        return "".join(parts)
    centre = _field_centre(scene)
    if paving.layout in ("crazy", "gravel", "asphalt", "grass"):
        parts.append(f"plane {{ z, 0 {patternless(paving.layout, paving.albedo, paving.slab_m[0])} }}\n")
    else:
        slabs, beyond = lay(paving, centre, rng), ""
        slabs = slabs.keep(_visible(scene, camera, slabs))
        if len(slabs.middle_m) > MAX_SLABS:
            # Far slabs cost the most and show the least.
            order = np.argsort(np.linalg.norm(slabs.middle_m - scene.cam_from_ground.origin_in_a[:2], axis=1))
            slabs = slabs.keep(np.isin(np.arange(len(order)), order[:MAX_SLABS]))
        if scene.border != "none":
            slabs, beyond = _border(scene, slabs, centre, rng)
        low, high = slabs.middle_m.min(0) - 0.02, slabs.middle_m.max(0) + 0.02
        half = 0.5 * slabs.size_m.max(0)
        low, high = low - half, high + half
        parts += [
            _stones(paving, rng),
            boxes_text(paving, slabs, rng),
            beyond,
            joint_growth_text(paving, slabs, rng),
            f"box {{ <{low[0]:.3f},{low[1]:.3f},-0.2>, <{high[0]:.3f},{high[1]:.3f},{-paving.depth_m}> "
            f"{bed(paving.bed_albedo)} }}\n",
            f"plane {{ z, -0.03 {bed(scene.surround)} }}\n",
        ]
    if paving.wet > 0:
        parts.append(water_film(paving.wet))
    parts += [_occluders(scene, rng), _objects(scene, rng)]
    if scene.house:
        parts.append(_house(scene, rng))
    return "".join(parts)


def _field_centre(scene: Scene) -> np.ndarray:
    """The paved field's middle: ahead of the camera, so that no paving is laid behind its back."""
    eye, ahead = scene.cam_from_ground.origin_in_a, scene.cam_from_ground.R[2]
    level = float(np.linalg.norm(ahead[:2]))
    if level < 1e-6:
        return eye[:2]
    reach = min(eye[2] * level / max(-ahead[2], 0.05), 0.75 * scene.paving.half_size_m)
    return eye[:2] + ahead[:2] / level * reach
