"""Irregular slabs: the mixed model of their places, reliefs and widths, and how sure the pose is."""
