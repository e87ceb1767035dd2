"""Numbers and vectors in POV-Ray's words."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def number(value: float) -> str:
    """A number for people to read: ten digits, which are a nanometre and a millionth of a pixel."""
    return f"{value:.10g}"


def vector(values: Float[np.ndarray, " n"] | list[float] | tuple[float, ...]) -> str:
    """A vector, or a colour."""
    return "<" + ", ".join(number(v) for v in values) + ">"
