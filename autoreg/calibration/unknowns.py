"""What is sought: intrinsics, one pose per view, the sheet's bend; and which of them may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from autoreg.calibration.models import COUNT, Intrinsics


@dataclass(frozen=True)
class State:
    """Values of the unknowns: intrinsics, poses as (rotation vector, translation), the sheet's bend."""

    intrinsics: Intrinsics
    poses: Float[np.ndarray, "v 6"]
    shape: Float[np.ndarray, " s"]

    @property
    def normals(self) -> Float[np.ndarray, "v 3"]:
        """Normal of each view's board, in the camera's axes."""
        return np.array([np.asarray(cv2.Rodrigues(pose[:3])[0])[:, 2] for pose in self.poses])

    def part(self, which: Sequence[int] | np.ndarray) -> State:
        """The state of some views."""
        return replace(self, poses=self.poses[np.asarray(which, int)])


@dataclass(frozen=True)
class Freedom:
    """Which of the common unknowns may move, and how far they are thought to.

    Attributes:
        intrinsics: which of the intrinsics.
        shape: whether the sheet may be bent, the same in every view.
        prior: what is known of the intrinsics beforehand: the standard deviation of each around 0; infinite
            where nothing is known.
    """

    intrinsics: Bool[np.ndarray, "12"]
    shape: bool = False
    prior: Float[np.ndarray, "12"] = field(default_factory=lambda: np.full(COUNT, np.inf))
