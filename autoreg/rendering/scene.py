"""POV-Ray's text: the photo's own camera, its joints, its light and its objects. Pure text, no I/O."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from autoreg.alignment import Alignment
from autoreg.lattice import Lattice
from autoreg.layout import lay_joints, slab_side_x
from autoreg.rendering.depth_of_field import Focus
from autoreg.rendering.scene_objects import objects_text, reflects
from autoreg.rendering.scene_surroundings import light_text, surroundings_text
from autoreg.rendering.scene_words import number, vector
from autoreg.rendering.staging import Staging
from autoreg.view import View

# What `Declare=Pass=n` asks of the scene.
PASS_PICTURE, PASS_SOLIDS, PASS_SHADOWED_GROUND, PASS_BARE_GROUND, PASS_MARKS = range(5)
MARKS_NAME = "scene-marks.inc"


@dataclass(frozen=True)
class SceneFiles:
    """scene.pov and what it names.

    Attributes:
        text: scene.pov.
        backdrop: name of the photo, as an ideal lens would have taken it.
        includes: name and text of each file of triangles.
        images: name beside the scene, and source, of each picture that lies on an object.
        reflects: whether the backdrop shows in an object, so that it is needed to draw them.
    """

    text: str
    backdrop: str
    includes: tuple[tuple[str, str], ...]
    images: tuple[tuple[str, Path], ...]
    reflects: bool


def scene_files(alignment: Alignment, staging: Staging, backdrop: str) -> SceneFiles:
    """The whole scene.

    Args:
        alignment: where the camera stands, and the lattice.
        staging: what stands on the slabs.
        backdrop: file name, beside the scene, of the photo as an ideal lens would have taken it.
    """
    view = View(alignment.camera.camera, alignment.pose.cam_from_ground)
    objects = objects_text(staging)
    text = "\n".join(
        [
            _heading(alignment, staging, reflects(staging)),
            _camera(view, staging.focus),
            _lattice(alignment.lattice),
            _joints(alignment.lattice, staging),
            light_text(staging.lamps),
            surroundings_text(backdrop, view, staging),
            objects.text,
            _PASSES,
        ]
    )
    return SceneFiles(text, backdrop, objects.includes, objects.images, reflects(staging))


def marks_text(marks_ground: Float[np.ndarray, "n 4 2"]) -> str:
    """Flat white four-sided marks on the ground, which the scene's own camera shows in their own pass."""
    marks = [
        f"polygon {{ 5, {', '.join(vector([*corner, 0.0]) for corner in (*mark, mark[0]))} }}"
        for mark in marks_ground
    ]
    return "\n".join(
        ["union {", *marks, "pigment { rgb 1 } finish { ambient 0 diffuse 0 emission 1 }", "}", ""]
    )


def _heading(alignment: Alignment, staging: Staging, mirrors: bool) -> str:
    unit = "slab sides (the scale is not known)" if alignment.scale_source == "none" else "metres"
    lens = (
        "The photo's lens bends straight lines, which POV-Ray 3.7 cannot do, so the backdrop is the\n"
        "// photo with that bend taken out, through the same K. `autoreg render` does it the other way\n"
        "// round: it bends the rendered layer and lays it over the untouched photo (composite.png)."
        if alignment.camera.camera.has_distortion
        else "The backdrop is the photo, pixel for pixel."
    )
    fit = f"{alignment.residual.rms_px:.3f} px rms over {alignment.residual.joints} joints"
    return f"""// Written by autoreg. Render with
//   povray +Iscene.pov +Oscene.png +W{alignment.width} +H{alignment.height} +FN +A0.1 -J
// POV-Ray warns that the camera vectors are not perpendicular: that is the off-centre principal point.
//
// Ground frame: right-handed, Z up, unit {unit}. The ground is Z = 0, the origin lies on a
// crossing of joint centre lines, X and Y run along the joints. Fit: {fit}.
// {lens}
//
// Declare=Pass=n on the command line chooses what is shown:
//   0  the photo with the objects and their shadows on it
//   1  the objects alone, for alpha (+UA)
//   2  a white ground with the objects' shadows    3  that ground bare; 2 over 3 darkens the photo
//   9  nothing: `#declare Pass = 9; #include "scene.pov"` gives your own scene the camera, the light
//      and the macros that stand things on slabs
#version 3.7;
global_settings {{ assumed_gamma 1.0 max_trace_level 8 }}
#ifndef (Pass) #declare Pass = 0; #end
#ifndef (Show_Joints) #declare Show_Joints = {int(staging.joints)}; #end       // lines on the joints
#ifndef (Catch_Shadows) #declare Catch_Shadows = 1; #end   // 0: pass 0 is faster, without shadows
#ifndef (Reflections) #declare Reflections = {int(mirrors)}; #end       // the surroundings, to be mirrored
"""


def _camera(view: View, focus: Focus | None) -> str:
    c, R = view.camera, view.cam_from_ground.R
    blur, shift, lens = ("", "", "") if focus is None else _depth_of_field(focus)
    return f"""
// --- Camera -----------------------------------------------------------------------------------------
// Pixels of the photo: (0, 0) is the centre of the top-left one. Win_* choose a part of it to render.
#declare Photo_W = {c.width};
#declare Photo_H = {c.height};
#declare FX = {number(c.fx)};
#declare FY = {number(c.fy)};
#declare CX = {number(c.cx)};
#declare CY = {number(c.cy)};
#ifndef (Win_X) #declare Win_X = 0; #end
#ifndef (Win_Y) #declare Win_Y = 0; #end
#ifndef (Win_W) #declare Win_W = Photo_W; #end
#ifndef (Win_H) #declare Win_H = Photo_H; #end
#declare Eye       = {vector(view.eye)};
#declare Axis_Right   = {vector(R[0])};
#declare Axis_Down    = {vector(R[1])};
#declare Axis_Forward = {vector(R[2])};
// No look_at and no angle: both would rebuild these vectors and lose the principal point.
#declare Cam_Right = Win_W/FX*Axis_Right;
#declare Cam_Up    = -Win_H/FY*Axis_Down;
{blur}#declare Cam_Direction = Axis_Forward
  + (Win_X + (Win_W - 1)/2 - CX{shift})/FX*Axis_Right
  + (Win_Y + (Win_H - 1)/2 - CY{shift})/FY*Axis_Down;
camera {{ location Eye right Cam_Right up Cam_Up direction Cam_Direction{lens} }}
"""


def _depth_of_field(focus: Focus) -> tuple[str, str, str]:
    """Its constants, what it adds to the picture's place, and its part of the camera statement."""
    constants = f"""
// Depth of field: the opening of the lens in the scene's unit, and what it is focused on.
#declare Aperture = {number(focus.aperture_m)};
#declare Focus_On = {vector(focus.point)};
// For the objects alone: the photo has its own blur already, and shadows on the ground get theirs later.
#ifndef (Depth_Of_Field) #declare Depth_Of_Field = (Pass != 0 & Pass != 2 & Pass != 3); #end
// With focal blur POV-Ray samples each pixel 1/32 up and left of where it does without (measured): this
// moves the picture back.
#declare Blur_Shift = Depth_Of_Field/32;
"""
    lens = """
  // Measured: POV-Ray's lens has half the opening that it is told, and is focused at the distance, not at
  // the depth, of its focal_point.
  #if (Depth_Of_Field)
    aperture 2*Aperture focal_point Eye + vdot(Focus_On - Eye, Axis_Forward)*Cam_Direction
    blur_samples 10, 100 confidence 0.95 variance 1/10000
  #end
"""
    return constants, " + Blur_Shift", lens


def _lattice(lattice: Lattice) -> str:
    bond = {
        "stack": "stack bond: joints run through both ways",
        "running": "running bond: row J is moved by J*Shift*A along X",
        "rows": "rows: no regular joints across them; A is only a length for Slab_Centre",
    }[lattice.kind]
    return f"""
// --- Slabs ({bond}) ---
#declare A = {number(slab_side_x(lattice))};   // side of a slab along X
#declare B = {number(lattice.spacing_y)};   // side of a slab along Y
#declare Shift = {number(lattice.shift or 0.0)};
#declare Joint_Width = {number(lattice.joint_width)};
#macro Slab_Centre(I, J) <(I + J*Shift + 0.5)*A, (J + 0.5)*B, 0> #end
// Stand something, made on Z = 0 around the origin, on slab (I, J).
#macro Stand_On_Slab(Thing, I, J) object {{ Thing translate Slab_Centre(I, J) }} #end
// The same, turned by Turn degrees from X towards Y and moved by a vector (its Z is a height).
#macro Put_On_Slab(Thing, I, J, Move, Turn)
  object {{ Thing rotate Turn*z translate Slab_Centre(I, J) + Move }}
#end
// At a point <X, Y> of the ground.
#macro Stand_At(Thing, Point, Lift, Turn)
  object {{ Thing rotate Turn*z translate <Point.u, Point.v, Lift> }}
#end
// The ground point that shows at pixel (U, V) of the backdrop.
#macro Ground_Under(U, V)
  #local Ray_ = Axis_Forward + (U - CX)/FX*Axis_Right + (V - CY)/FY*Axis_Down;
  (Eye - Eye.z/Ray_.z*Ray_)
#end
"""


def _joints(lattice: Lattice, staging: Staging) -> str:
    joints = lay_joints(lattice)
    along_x = [
        f"  Joint_X({r}, {number(s[0, 0])}, {number(s[1, 0])})"
        for r, s in zip(joints.row, joints.along_x, strict=True)
    ]
    along_y = [f"  Joint_Y({number(s[0, 0])}, {number(s[0, 1])}, {number(s[1, 1])})" for s in joints.along_y]
    return f"""
// --- Joints: thin boxes whose tops lie on the ground -------------------------------------------------
#declare Drawn_Width = {number(drawn_joint_width(lattice))};
#declare Drawn_Depth = 1e-4*B;
#macro Joint_X(J, X0, X1) box {{ <X0, J*B - Drawn_Width/2, -Drawn_Depth>, <X1, J*B + Drawn_Width/2, 0> }} #end
#macro Joint_Y(X, Y0, Y1) box {{ <X - Drawn_Width/2, Y0, -Drawn_Depth>, <X + Drawn_Width/2, Y1, 0> }} #end
#declare Joints = union {{
{chr(10).join([*along_x, *along_y]) or "  sphere { -1e6*z, 1e-6 }"}
  pigment {{ rgb {vector(staging.joint_colour)} }}
  finish {{ ambient 0 diffuse 0 emission 1 }}
  no_shadow
}}
"""


def drawn_joint_width(lattice: Lattice) -> float:
    """Width of the lines on the joints."""
    return lattice.joint_width if lattice.joint_width > 0 else 0.01 * lattice.spacing_y


_PASSES = f"""
// --- Passes --------------------------------------------------------------------------------------------
#if (Pass = 0)
  Backdrop()
  #if (Catch_Shadows) Photo_Ground() #end
  #if (Show_Joints) object {{ Joints }} #end
  object {{ Staged }}
  #if (Reflections) object {{ Sky_Dome }} #end
#end
#if (Pass = 1)
  object {{ Staged }}
  #if (Show_Joints) object {{ Joints }} #end
  #if (Reflections) object {{ Photo_Ground() no_image }} object {{ Sky_Dome }} #end
#end
#if (Pass = 2 | Pass = 3)
  Ground_Disc() pigment {{ rgb 0.8/Exposure }} finish {{ ambient 0 diffuse 1 }} }}
#end
#if (Pass = 2) object {{ Staged no_image }} #end
#if (Pass = {PASS_MARKS})
  #include "{MARKS_NAME}"   // autoreg's own check of this camera; the file is there while it runs
#end
"""
