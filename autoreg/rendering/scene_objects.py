"""Objects and materials in POV-Ray's words. Pure text, no I/O."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from autoreg.rendering.objects import (
    FINISHES,
    Box,
    Cone,
    Cylinder,
    Material,
    OnSlab,
    Sphere,
    Torus,
    UnderPixel,
)
from autoreg.rendering.scene_words import number, vector
from autoreg.rendering.staging import Solid, Staging
from autoreg.rendering.surface import Surface

# What POV-Ray's own finish.inc and metals.inc say: the program may be installed without its include files.
_FINISHES = {
    "Dull": "specular 0.5 roughness 0.15",
    "Shiny": "specular 1 roughness 0.001",
    "Phong_Dull": "phong 0.5 phong_size 1",
    "Phong_Shiny": "phong 1 phong_size 200",
    "Glossy": "specular 1 roughness 0.0001 reflection 0.13",
    "Phong_Glossy": "phong 1 phong_size 300 reflection 0.13",
    "Luminous": "ambient 1 diffuse 0",
    "Mirror": "ambient 0 diffuse 0 reflection 1",
    "F_MetalA": "ambient 0.35 brilliance 2 diffuse 0.3 metallic specular 0.8 roughness 1/20 reflection 0.1",
    "F_MetalB": "ambient 0.3 brilliance 3 diffuse 0.4 metallic specular 0.7 roughness 1/60 reflection 0.25",
    "F_MetalC": "ambient 0.25 brilliance 4 diffuse 0.5 metallic specular 0.8 roughness 1/80 reflection 0.5",
    "F_MetalD": "ambient 0.15 brilliance 5 diffuse 0.6 metallic specular 0.8 roughness 1/100 reflection 0.65",
    "F_MetalE": "ambient 0.1 brilliance 6 diffuse 0.7 metallic specular 0.8 roughness 1/120 reflection 0.8",
}


@dataclass(frozen=True)
class ObjectsText:
    """The objects' part of a scene.

    Attributes:
        text: their declarations, and the union `Staged` of all of them at their places.
        includes: name and text of each file of triangles that it includes.
        images: name beside the scene, and source, of each picture that lies on an object.
    """

    text: str
    includes: tuple[tuple[str, str], ...]
    images: tuple[tuple[str, Path], ...]


def objects_text(staging: Staging) -> ObjectsText:
    """All objects of a staging."""
    used = {solid.source.material.finish for solid in staging.solids}
    lines = [finish_text(name) for name in FINISHES if name in used]
    includes: list[tuple[str, str]] = []
    images: list[tuple[str, Path]] = []
    placed: list[str] = []
    for name, solid in zip(_identifiers(staging.solids), staging.solids, strict=True):
        material, image = solid.source.material, None
        if material.image is not None:
            image = f"scene-{name.lower()}.png"
            images.append((image, material.image))
        body = None if image is not None else _primitive(solid)
        if body is None:
            file = f"scene-{name.lower()}.inc"
            includes.append((file, mesh_text(f"{name}_Mesh", solid.pictured_surface)))
            lines.append(f'#include "{file}"')
            body = f"object {{ {name}_Mesh"
        lines.append(f"#declare {name} = {body} {_material(material, image)} }}")
        placed.append(f"  {_placed(name, solid)}")
    # An empty union is an error in POV-Ray.
    lines += ["#declare Staged = union {", *(placed or ["  sphere { -1e6*z, 1e-6 }  // nothing"]), "}"]
    head = (
        "\n// --- What stands on the paving: put your own objects here "
        "-----------------------------------------\n"
        "// Each is made standing on Z = 0 around the origin, then placed by one of the macros above.\n"
    )
    return ObjectsText(head + "\n".join(lines) + "\n", tuple(includes), tuple(images))


def finish_text(name: str) -> str:
    """The declaration of one of `FINISHES`."""
    return f"#declare {name} = finish {{ {_FINISHES[name]} }}"


def mesh_text(name: str, surface: Surface) -> str:
    """A mesh2 of triangles; corners and normals that several triangles share are written once."""
    points, faces = np.unique(surface.corners.reshape(-1, 3), axis=0, return_inverse=True)
    normals, normal_faces = np.unique(surface.normals.reshape(-1, 3), axis=0, return_inverse=True)
    blocks = [_block("vertex_vectors", points), _block("normal_vectors", normals)]
    uv_faces = None
    if surface.uv is not None:
        uv, uv_faces = np.unique(surface.uv.reshape(-1, 2), axis=0, return_inverse=True)
        blocks.append(_block("uv_vectors", uv))
    blocks.append(_block("face_indices", faces.reshape(-1, 3)))
    blocks.append(_block("normal_indices", normal_faces.reshape(-1, 3)))
    if uv_faces is not None:
        blocks.append(_block("uv_indices", uv_faces.reshape(-1, 3)))
    return f"// Written by autoreg.\n#declare {name} = mesh2 {{\n" + "\n".join(blocks) + "\n}\n"


def reflects(staging: Staging) -> bool:
    """Whether anything may mirror its surroundings."""
    return any(
        f is not None and (f.endswith(("Glossy", "Mirror")) or f.startswith("F_Metal"))
        for f in (s.source.material.finish for s in staging.solids)
    )


def _block(keyword: str, rows: np.ndarray) -> str:
    whole = np.issubdtype(rows.dtype, np.integer)
    form = ",".join(["%d" if whole else "%.9g"] * rows.shape[1])
    body = ",\n".join(f"<{form % tuple(row)}>" for row in rows.tolist())
    return f"  {keyword} {{ {len(rows)},\n{body}\n  }}"


def _identifiers(solids: tuple[Solid, ...]) -> list[str]:
    """A name for each that POV-Ray takes, unlike all others and any word of its own."""
    taken: set[str] = set()
    names: list[str] = []
    for solid in solids:
        stem = "Thing_" + (re.sub(r"[^A-Za-z0-9]+", "_", solid.source.name).strip("_")[:24] or "unnamed")
        name, n = stem, 2
        while name.lower() in taken:
            name, n = f"{stem}_{n}", n + 1
        taken.add(name.lower())
        names.append(name)
    return names


def _primitive(solid: Solid) -> str | None:
    """POV-Ray's own shape, its brace still open; None for what it has only as triangles."""
    match solid.source.shape:
        case Box((x, y, z)):
            return f"box {{ {vector([-x / 2, -y / 2, 0.0])}, {vector([x / 2, y / 2, z])}"
        case Sphere(radius):
            return f"sphere {{ {vector([0.0, 0.0, radius])}, {number(radius)}"
        case Cylinder(radius, height):
            return f"cylinder {{ <0, 0, 0>, {vector([0.0, 0.0, height])}, {number(radius)}"
        case Cone(radius, height, top):
            return f"cone {{ <0, 0, 0>, {number(radius)}, {vector([0.0, 0.0, height])}, {number(top)}"
        case Torus(radius, tube):
            return f"torus {{ {number(radius)}, {number(tube)} rotate 90*x translate {number(tube)}*z"
        case _:
            return None


def _material(material: Material, image: str | None) -> str:
    if image is None:
        pigment = f"pigment {{ rgb {vector([round(part, 4) for part in material.colour])} }}"
    else:
        pigment = f'uv_mapping pigment {{ image_map {{ png "{image}" interpolate 2 }} }}'
    return pigment if material.finish is None else f"{pigment} finish {{ {material.finish} }}"


def _placed(name: str, solid: Solid) -> str:
    """The macro call that puts a declared object at its place."""
    source, place = solid.source, solid.source.place
    turn, lift = number(source.turn_deg), number(source.lift_m)
    if isinstance(place, OnSlab):
        if place.offset_m == (0.0, 0.0) and not source.turn_deg and not source.lift_m:
            return f"Stand_On_Slab({name}, {place.i}, {place.j})"
        x, y = place.offset_m
        return f"Put_On_Slab({name}, {place.i}, {place.j}, {vector([x, y, source.lift_m])}, {turn})"
    note = f"  // under pixel ({place.u_px:g}, {place.v_px:g})" if isinstance(place, UnderPixel) else ""
    return f"Stand_At({name}, {vector([*solid.foot[:2]])}, {lift}, {turn}){note}"
