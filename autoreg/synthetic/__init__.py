"""Photos of paving with exact truth, drawn by numpy alone."""

from autoreg.synthetic.poses import ground_points, look_at_ground
from autoreg.synthetic.render import clean_grey, render_paving
from autoreg.synthetic.scene import SyntheticPhoto, SyntheticScene

__all__ = [
    "SyntheticPhoto",
    "SyntheticScene",
    "clean_grey",
    "ground_points",
    "look_at_ground",
    "render_paving",
]
