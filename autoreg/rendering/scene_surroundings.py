"""Light, photo and sky in POV-Ray's words: what is around the objects. Pure text, no I/O."""

from __future__ import annotations

import numpy as np

from autoreg.rendering.scene_words import number, vector
from autoreg.rendering.staging import Lamps, Staging
from autoreg.view import View


def light_text(lamps: Lamps) -> str:
    """The lamps."""
    sun, sky = lamps.on_ground
    directions = ",\n".join(f"  {vector(np.round(way, 9))}" for way in lamps.to_sky)
    return f"""
// --- Light: the sun as wide as it is, and the whole sky as lamps that cast soft shadows ---------------
// On level open ground the sun gives {sun:.2f} and the sky {sky:.2f} of the light; a sheet there that
// throws all of it back would show as Exposure (linear).
#declare Exposure = {number(lamps.exposure)};
#declare To_Sun = {vector(lamps.to_sun)};
#declare Sun = {number(lamps.sun)};
#declare Sky_Lamps = {len(lamps.to_sky)};
#declare Sky_Each = {number(lamps.sky)};
#declare Bounce = {number(lamps.bounce)};   // part of it that the ground throws back up
#declare Whitest = {number(lamps.whitest)};   // no real surface throws back all light
#default {{ finish {{ ambient 0 diffuse Whitest }} }}
#declare Far = 1e6;
light_source {{ Far*To_Sun rgb Exposure*Sun
  area_light 0.0093*Far*x, 0.0093*Far*y, 5, 5 adaptive 1 circular orient
}}
#declare Sky_Direction = array[Sky_Lamps] {{
{directions}
}}
#for (N, 0, Sky_Lamps - 1)
  light_source {{ 1e5*Sky_Direction[N] rgb Exposure*Sky_Each parallel point_at <0, 0, 0> }}
#end
// The ground, evenly bright from below; nothing stands in its way.
#for (N, 0, 11)
  #local Down_ = (N + 0.5)/12;
  #local Level_ = sqrt(1 - Down_*Down_);
  light_source {{ 1e5*<Level_*cos(2.4*N), Level_*sin(2.4*N), -Down_> rgb Exposure*Bounce/6
    parallel point_at <0, 0, 0> shadowless }}
#end
"""


def surroundings_text(name: str, view: View, staging: Staging) -> str:
    """The photo behind everything and on the ground, and the sky that mirrors show."""
    far = 1e3 * max(1.0, abs(float(view.eye[2])))
    return f"""
// --- Photo: far behind everything, and where shadows can fall also on the ground -----------------------
#macro Backdrop()
  #local S = {number(far)};
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
// As far as the shadows of all that is Staged reach.
#macro Ground_Disc()
  #local Low_ = min_extent(Staged);
  #local High_ = max_extent(Staged);
  #local Wide_ = <High_.x - Low_.x, High_.y - Low_.y, 0>;
  disc {{ <(Low_.x + High_.x)/2, (Low_.y + High_.y)/2, 0>, z,
    vlength(Wide_)/2 + {number(_shadow_per_height(staging.lamps))}*max(0, High_.z) + 1e-3
#end
// The photo thrown from the camera onto the ground: where all the light arrives it shows as it is.
#macro Photo_Ground()
  #local E1 = Eye.x; #local E2 = Eye.y; #local E3 = Eye.z;
  #local R1 = Axis_Right.x; #local R2 = Axis_Right.y; #local R3 = Axis_Right.z;
  #local D1 = Axis_Down.x; #local D2 = Axis_Down.y; #local D3 = Axis_Down.z;
  #local F1 = Axis_Forward.x; #local F2 = Axis_Forward.y; #local F3 = Axis_Forward.z;
  #local Photo_ = function {{ pigment {{ image_map {{ png "{name}" map_type 0 }} }} }}
  #local Depth_ = function(x, y, z) {{ max(1e-6, (x - E1)*F1 + (y - E2)*F2 + (z - E3)*F3) }}
  #local U_ = function(x, y, z) {{
    (FX*((x - E1)*R1 + (y - E2)*R2 + (z - E3)*R3)/Depth_(x, y, z) + CX + 0.5)/Photo_W }}
  #local V_ = function(x, y, z) {{
    1 - (FY*((x - E1)*D1 + (y - E2)*D2 + (z - E3)*D3)/Depth_(x, y, z) + CY + 0.5)/Photo_H }}
  // Out of the picture its border goes on.
  #local At_ = function(x, y, z) {{ min(1 - 1e-6, max(1e-6, x)) }}
  Ground_Disc()
    pigment {{ average pigment_map {{
      [1 function {{ Photo_(At_(U_(x,y,z),0,0), At_(V_(x,y,z),0,0), 0).red }}
         color_map {{ [0 rgb 0] [1 rgb <3, 0, 0>/Exposure] }}]
      [1 function {{ Photo_(At_(U_(x,y,z),0,0), At_(V_(x,y,z),0,0), 0).green }}
         color_map {{ [0 rgb 0] [1 rgb <0, 3, 0>/Exposure] }}]
      [1 function {{ Photo_(At_(U_(x,y,z),0,0), At_(V_(x,y,z),0,0), 0).blue }}
         color_map {{ [0 rgb 0] [1 rgb <0, 0, 3>/Exposure] }}] }} }}
    finish {{ ambient 0 diffuse 1 }}
  }}
#end
#declare Sky_Dome = sphere {{ Eye, 1e5 hollow
  pigment {{ gradient z
    color_map {{ [0.5 rgb <0.40, 0.38, 0.36>*Exposure] [0.5 rgb <0.80, 0.85, 0.90>*Exposure]
      [1.0 rgb <0.30, 0.45, 0.75>*Exposure] }}
    scale 2e5 translate Eye - 1e5*z }}
  finish {{ ambient 0 diffuse 0 emission 1 }}
  no_shadow no_image
}}
"""


def _shadow_per_height(lamps: Lamps) -> float:
    """How far the longest shadow on level ground reaches, by the height of what casts it."""
    lowest = min(float(lamps.to_sun[2]), float(lamps.to_sky[:, 2].min()))
    return 1.0 / float(np.tan(np.arcsin(lowest)))
