"""How joints meet at the crossings of a stack bond: those of slabs cross, those of a module's stones do not.

Stones of several sizes whose sides are multiples of one length have all their joints on a lattice. About half
of its sides are there, in an order that neither chance nor what hides joints brings about: no joint ends but
at another one, and hardly any two cross.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from autoreg.ground.sides import ALONG_X
from autoreg.paving.presence import Presence


class Meetings(NamedTuple):
    """Crossings all four sides of which were looked at, counted by the sides that are there.

    At `crosses` all are, at `tees` three, along `x_only` and `y_only` the two of one joint, which passes
    through, and at `corners` one of either joint.
    """

    crosses: int
    tees: int
    x_only: int
    y_only: int
    corners: int

    @property
    def through(self) -> int:
        """Crossings that a joint passes through."""
        return self.crosses + self.tees + self.x_only + self.y_only

    @property
    def uncrossed(self) -> float:
        """Share of them at which no other joint crosses it."""
        return 1.0 - self.crosses / max(1, self.through)


def meetings(presence: Presence) -> Meetings:
    """How the joints of a stack bond meet."""
    sides, along_x = presence.sides, presence.sides.family == ALONG_X
    # Columns and rows of the crossings where sides begin that run along X and along Y.
    begin = np.where(along_x, [sides.cell, sides.line], [sides.line, sides.cell])
    begin = begin - begin.min(1, initial=0)[:, None] + 1
    # Whether the sides are there; those that are not known count for so much that they spoil any sum.
    known = np.full((2, *(begin.max(1, initial=0) + 1)), 9)
    known[np.where(along_x, 0, 1), begin[0], begin[1]] = presence.there
    x = known[0, 1:, 1:] + known[0, :-1, 1:]
    y = known[1, 1:, 1:] + known[1, 1:, :-1]
    whole = (x <= 2) & (y <= 2)
    count = np.bincount(3 * x[whole] + y[whole], minlength=9).reshape(3, 3).tolist()
    return Meetings(count[2][2], count[1][2] + count[2][1], count[2][0], count[0][2], count[1][1])
