"""POV-Ray textures: stone in a few tones, beds, lawn, and grounds that are a pattern only."""

from __future__ import annotations

import numpy as np

from .scene import Paving

Colour = tuple[float, float, float]
TONES = 24
FINISH = "finish { ambient 0.26 diffuse 0.68 }"


def rgb(colour: Colour, factor: float = 1.0) -> str:
    """A colour in POV-Ray's words."""
    r, g, b = (max(0.0, min(1.0, factor * c)) for c in colour)
    return f"rgb <{r:.4f},{g:.4f},{b:.4f}>"


def stone(name: str, colour: Colour, paving: Paving, factor: float) -> str:
    """Stone of one tone: veins of the size of a hand over fine grain."""
    v = paving.veins
    veins = (
        f"{paving.pattern} scale {paving.grain_m:.4f} "
        f"color_map {{ [0 {rgb(colour, factor * (1 - v))}] [0.5 {rgb(colour, factor)}] "
        f"[1 {rgb(colour, factor * (1 + v))}] }}"
    )
    grain = (
        f"bozo scale 0.006 color_map {{ [0 {rgb(colour, factor * (1 - 1.5 * v))}] "
        f"[1 {rgb(colour, factor * (1 + 1.5 * v))}] }}"
    )
    stain = (
        f"bozo scale 0.7 warp {{ turbulence 0.5 }} color_map {{ [0 {rgb(colour, factor * (1 - 0.6 * v))}] "
        f"[1 {rgb(colour, factor * (1 + 0.4 * v))}] }}"
    )
    mix = f"average pigment_map {{ [2 {veins}] [1 {grain}] [1 {stain}] }}"
    return f"#declare {name} = texture {{ pigment {{ {mix} }} {FINISH} }}\n"


def tone_factors(paving: Paving, rng: np.random.Generator) -> np.ndarray:
    """Relative tones from which each slab draws one."""
    tones = 1 + paving.tone_spread * rng.standard_normal(TONES)
    # In a chessboard the first half of the tones is dark, the second light.
    return np.where(np.arange(TONES) < TONES // 2, 0.25, 1.15) * tones if paving.checker else tones


def bed(colour: Colour) -> str:
    """Sand or mortar of the joints."""
    return (
        f"texture {{ pigment {{ bozo scale 0.02 color_map {{ [0 {rgb(colour, 0.8)}] "
        f"[1 {rgb(colour, 1.2)}] }} }} "
        "finish { ambient 0.2 diffuse 0.65 } }"
    )


def lawn() -> str:
    """Grass as a texture, uneven at three scales."""
    blade = (
        "granite scale <0.02,0.02,0.02> color_map { [0 rgb <0.02,0.05,0.01>] [0.5 rgb <0.08,0.17,0.03>] "
        "[1 rgb <0.25,0.35,0.1>] }"
    )
    patch = "bozo scale 0.5 color_map { [0 rgb <0.05,0.13,0.02>] [1 rgb <0.14,0.22,0.05>] }"
    tuft = "wrinkles scale 0.05 color_map { [0 rgb <0.03,0.08,0.01>] [1 rgb <0.2,0.3,0.08>] }"
    mix = f"average pigment_map {{ [2 {blade}] [1 {patch}] [1 {tuft}] }}"
    return f"texture {{ pigment {{ {mix} }} normal {{ granite 0.6 scale 0.05 }} {FINISH} }}"


def water_film(part: float) -> str:
    """A film of water over part of the ground: darker, and mirroring sky and sun."""
    dry = "pigment { rgbt 1 } finish { diffuse 0 ambient 0 }"
    wet = (
        "pigment { rgbt <0.6,0.6,0.6,0.62> } "
        "finish { ambient 0 diffuse 0 specular 0.6 roughness 0.004 reflection { 0.03, 0.6 falloff 4 } }"
    )
    edge = 0.75 - 0.5 * part
    pattern = (
        f"bozo scale 0.9 warp {{ turbulence 0.4 }} "
        f"texture_map {{ [{edge - 0.03:.3f} {dry}] [{edge + 0.03:.3f} {wet}] }}"
    )
    return f"plane {{ z, 0.003 texture {{ {pattern} }} no_shadow }}\n"


def patternless(layout: str, colour: Colour, scale: float) -> str:
    """Grounds that are one texture: crazy paving, gravel, asphalt, lawn, brick wall."""
    if layout == "grass":
        return lawn()
    if layout == "crazy":
        stones = f"bozo scale {scale:.3f} color_map {{ [0 {rgb(colour, 0.8)}] [1 {rgb(colour, 1.2)}] }}"
        cracks = (
            f"crackle form <-1,1,0> metric 2 scale {scale:.3f} pigment_map {{ [0.055 rgb <0.09,0.085,0.08>] "
            f"[0.075 average pigment_map {{ [1 granite scale 0.1 color_map {{ [0 {rgb(colour, 0.85)}] "
            f"[1 {rgb(colour, 1.15)}] }}] [1 {stones}] }}] }}"
        )
        return f"texture {{ pigment {{ {cracks} }} {FINISH} }}"
    fine = 0.012 if layout == "gravel" else 0.004
    light, dark = (1.5, 0.4) if layout == "gravel" else (0.8, 0.25)
    pebbles = (
        f"crackle scale {fine} color_map {{ [0 {rgb(colour, dark)}] [0.4 {rgb(colour, light)}] "
        f"[1 {rgb(colour, 1.1)}] }}"
    )
    blotch = f"bozo scale 0.6 color_map {{ [0 {rgb(colour, 0.6)}] [1 {rgb(colour, 1.0)}] }}"
    speck = f"cells scale {fine} color_map {{ [0 {rgb(colour, dark)}] [1 {rgb(colour, light)}] }}"
    mix = f"average pigment_map {{ [2 {pebbles}] [1 {blotch}] [1 {speck}] }}"
    return f"texture {{ pigment {{ {mix} }} normal {{ crackle 0.8 scale {fine} }} {FINISH} }}"
