"""POV-Ray's text: the photo's own camera, its joints, and solids on its slabs. Pure text, no I/O."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.alignment import Alignment
from autoreg.lattice import Lattice
from autoreg.layout import lay_joints, slab_side_x
from autoreg.staging import Box, Light, Solid, Staging
from autoreg.view import View

# What `Declare=Pass=n` asks of the scene.
PASS_PICTURE, PASS_SOLIDS, PASS_SHADOWED_GROUND, PASS_BARE_GROUND = range(4)


def scene_text(alignment: Alignment, staging: Staging, backdrop: str) -> str:
    """The whole scene.

    Args:
        alignment: where the camera stands, and the lattice.
        staging: what stands on the slabs.
        backdrop: file name, beside the scene, of the photo as an ideal lens would have taken it.
    """
    view = View(alignment.camera.camera, alignment.pose.cam_from_ground)
    return "\n".join(
        [
            _heading(alignment, backdrop),
            "#ifndef (Pass) #declare Pass = 0; #end",
            _camera(view),
            _backdrop(backdrop, view),
            _lattice(alignment.lattice),
            _joints(alignment.lattice),
            _light(staging.light),
            _staged(staging),
            _PASSES,
        ]
    )


def marks_text(view: View, marks_ground: Float[np.ndarray, "n 4 2"]) -> str:
    """A scene of flat white four-sided marks on the ground and nothing else, seen by the same camera."""
    marks = [
        f"polygon {{ 5, {', '.join(_vector([*corner, 0.0]) for corner in (*mark, mark[0]))} }}"
        for mark in marks_ground
    ]
    return "\n".join(
        [
            "#version 3.7;",
            "global_settings { assumed_gamma 1.0 }",
            _camera(view),
            *("union {", *marks, "pigment { rgb 1 } finish { ambient 0 diffuse 0 emission 1 }", "}", ""),
        ]
    )


def _number(value: float) -> str:
    return repr(float(value))


def _vector(values: Float[np.ndarray, " n"] | list[float]) -> str:
    return "<" + ", ".join(_number(v) for v in values) + ">"


def _heading(alignment: Alignment, backdrop: str) -> str:
    unit = "slab sides (the scale is not known)" if alignment.scale_source == "none" else "metres"
    lens = (
        "The photo's lens bends straight lines, which POV-Ray 3.7 cannot do, so the backdrop is the\n"
        "// photo with that bend taken out, through the same K. `autoreg align --render` does it the other\n"
        "// way round: it bends the rendered layer and lays it over the untouched photo (composite.png)."
        if alignment.camera.camera.has_distortion
        else "The backdrop is the photo, pixel for pixel."
    )
    fit = f"{alignment.residual.rms_px:.3f} px rms over {alignment.residual.joints} joints"
    return f"""// Written by autoreg. Render with
//   povray +Iscene.pov +Oscene.png +W{alignment.width} +H{alignment.height} +FN +A0.1 +AM2 -J
// POV-Ray warns that the camera vectors are not perpendicular: that is the off-centre principal point.
//
// Ground frame: right-handed, Z up, unit {unit}. The ground is Z = 0, the origin lies on a
// crossing of joint centre lines, X and Y run along the joints. Fit: {fit}.
// {lens}
//
// Declare=Pass=n on the command line chooses what is shown:
//   0  the backdrop, the joints (Show_Joints) and the solids. POV-Ray 3.7 has no shadow catcher, so the
//      solids cast no shadow on the backdrop here.
//   1  the solids alone, for alpha (+UA)
//   2  a white ground with the solids' shadows    3  that ground bare; 2 over 3 darkens the photo
#version 3.7;
global_settings {{ assumed_gamma 1.0 }}
#ifndef (Show_Joints) #declare Show_Joints = 1; #end
"""


def _camera(view: View) -> str:
    c, R = view.camera, view.cam_from_ground.R
    return f"""
// --- Camera -----------------------------------------------------------------------------------------
// Pixels of the photo: (0, 0) is the centre of the top-left one. Win_* choose a part of it to render.
#declare Photo_W = {c.width};
#declare Photo_H = {c.height};
#declare FX = {_number(c.fx)};
#declare FY = {_number(c.fy)};
#declare CX = {_number(c.cx)};
#declare CY = {_number(c.cy)};
#ifndef (Win_X) #declare Win_X = 0; #end
#ifndef (Win_Y) #declare Win_Y = 0; #end
#ifndef (Win_W) #declare Win_W = Photo_W; #end
#ifndef (Win_H) #declare Win_H = Photo_H; #end
#declare Eye       = {_vector(view.eye)};
#declare Axis_Right   = {_vector(R[0])};
#declare Axis_Down    = {_vector(R[1])};
#declare Axis_Forward = {_vector(R[2])};
// No look_at and no angle: both would rebuild these vectors and lose the principal point.
#declare Cam_Right = Win_W/FX*Axis_Right;
#declare Cam_Up    = -Win_H/FY*Axis_Down;
#declare Cam_Direction = Axis_Forward
  + (Win_X + (Win_W - 1)/2 - CX)/FX*Axis_Right
  + (Win_Y + (Win_H - 1)/2 - CY)/FY*Axis_Down;
camera {{ location Eye right Cam_Right up Cam_Up direction Cam_Direction }}
"""


def _backdrop(name: str, view: View) -> str:
    far = 1e3 * max(1.0, abs(float(view.eye[2])))
    return f"""
// --- Backdrop: a picture that fills the photo's frame exactly, far behind everything ----------------
#macro Backdrop()
  #local S = {_number(far)};
  #local R_ = Photo_W/FX*Axis_Right;
  #local U_ = -Photo_H/FY*Axis_Down;
  #local D_ = Axis_Forward + ((Photo_W - 1)/2 - CX)/FX*Axis_Right + ((Photo_H - 1)/2 - CY)/FY*Axis_Down;
  #local P_ = Eye + S*(D_ - R_/2 - U_/2);
  polygon {{ 5, <0, 0>, <1, 0>, <1, 1>, <0, 1>, <0, 0>
    pigment {{ image_map {{ png "{name}" map_type 0 once }} }}
    finish {{ ambient 0 diffuse 0 emission 1 }}
    no_shadow no_reflection
    matrix <S*R_.x, S*R_.y, S*R_.z, S*U_.x, S*U_.y, S*U_.z, S*D_.x, S*D_.y, S*D_.z, P_.x, P_.y, P_.z>
  }}
#end
"""


def _lattice(lattice: Lattice) -> str:
    bond = {
        "stack": "stack bond: joints run through both ways",
        "running": "running bond: row J is moved by J*Shift*A along X",
        "rows": "rows: no regular joints across them; A is only a length for Slab_Centre",
    }[lattice.kind]
    return f"""
// --- Slabs ({bond}) ---
#declare A = {_number(slab_side_x(lattice))};   // side of a slab along X
#declare B = {_number(lattice.spacing_y)};   // side of a slab along Y
#declare Shift = {_number(lattice.shift or 0.0)};
#declare Joint_Width = {_number(lattice.joint_width)};
#macro Slab_Centre(I, J) <(I + J*Shift + 0.5)*A, (J + 0.5)*B, 0> #end
// Stand something, made on Z = 0 around the origin, on slab (I, J).
#macro Stand_On_Slab(Thing, I, J) object {{ Thing translate Slab_Centre(I, J) }} #end
"""


def _joints(lattice: Lattice) -> str:
    joints = lay_joints(lattice)
    along_x = [
        f"  Joint_X({r}, {_number(s[0, 0])}, {_number(s[1, 0])})"
        for r, s in zip(joints.row, joints.along_x, strict=True)
    ]
    along_y = [
        f"  Joint_Y({_number(s[0, 0])}, {_number(s[0, 1])}, {_number(s[1, 1])})" for s in joints.along_y
    ]
    drawn = lattice.joint_width if lattice.joint_width > 0 else 0.01 * lattice.spacing_y
    return f"""
// --- Joints: thin boxes whose tops lie on the ground -------------------------------------------------
#declare Drawn_Width = {_number(drawn)};
#declare Drawn_Depth = 1e-4*B;
#macro Joint_X(J, X0, X1) box {{ <X0, J*B - Drawn_Width/2, -Drawn_Depth>, <X1, J*B + Drawn_Width/2, 0> }} #end
#macro Joint_Y(X, Y0, Y1) box {{ <X - Drawn_Width/2, Y0, -Drawn_Depth>, <X + Drawn_Width/2, Y1, 0> }} #end
#declare Joints = union {{
{chr(10).join([*along_x, *along_y]) or "  sphere { <0, 0, 0>, 1e-9 }"}
  pigment {{ rgb <1, 0.85, 0> }}
  finish {{ ambient 0 diffuse 0 emission 1 }}
  no_shadow
}}
"""


def _light(light: Light) -> str:
    return f"""
// --- Light: a far sun, and light from everywhere ------------------------------------------------------
#declare To_Sun = {_vector(light.to_sun)};
#default {{ finish {{ ambient {_number(light.ambient)} diffuse {_number(light.diffuse)} }} }}
light_source {{ 1e4*To_Sun color rgb 1 parallel point_at <0, 0, 0> }}
"""


def _staged(staging: Staging) -> str:
    solids = "\n".join(f"  {_solid(s)}" for s in staging.solids)
    i, j = staging.slab
    return f"""
// --- What stands on the paving: put your own object here ----------------------------------------------
#declare Demo_Object = union {{
{solids}
}}
#declare Staged = union {{
  Stand_On_Slab(Demo_Object, {i}, {j})
}}
"""


def _solid(solid: Solid) -> str:
    colour = f"pigment {{ rgb {_vector(list(solid.colour))} }}"
    if isinstance(solid, Box):
        half = 0.5 * solid.size
        return f"box {{ {_vector(solid.centre - half)}, {_vector(solid.centre + half)} {colour} }}"
    return f"sphere {{ {_vector(solid.centre)}, {_number(solid.radius)} {colour} }}"


_PASSES = """
// --- Passes --------------------------------------------------------------------------------------------
#if (Pass = 0)
  Backdrop()
  #if (Show_Joints) object { Joints } #end
  object { Staged }
#end
#if (Pass = 1) object { Staged } #end
#if (Pass = 2 | Pass = 3) plane { z, 0 pigment { rgb 1 } } #end
#if (Pass = 2) object { Staged no_image } #end
"""
