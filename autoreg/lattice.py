"""The slab lattice on the ground: spacing, phase and bond."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

LatticeKind = Literal["stack", "running", "rows"]


@dataclass(frozen=True)
class Lattice:
    """The joints of a paved field, in the ground frame (whose origin is a joint crossing).

    Joints along X lie at y = j * spacing_y. Cross joints of row j (between y = j and j + 1 spacings)
    lie at x = (i + j * shift) * spacing_x. A "rows" lattice has no period along X: `spacing_x` and
    `shift` are None.
    """

    kind: LatticeKind
    spacing_x: float | None
    spacing_y: float
    shift: float | None
    joint_width: float
    extent: Float[np.ndarray, "n 2"]
