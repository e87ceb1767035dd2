"""What was measured: the corners of all views, side by side, with their places on the sheet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.calibration.board import Board, BoardView

# Views whose corners are no further apart than this part of the board's size show it in the same place: they
# share the errors of sheet and lens, and are no more independent than one.
_REPEATS = 0.02


@dataclass(frozen=True)
class Data:
    """The corners of all views, padded to the same number per view; padding has weight 0.

    Attributes:
        names: the views' names.
        places: the corners' places on the flat sheet.
        basis: heights of the corners per unit of each way in which the sheet may be bent.
        px: where the corners were measured.
        present: which entries are corners.
        ids: which of the board's corners they are.
        standpoint: a number for each view; views that repeat one another, the board having hardly moved,
            share it.
    """

    names: tuple[str, ...]
    places: Float[np.ndarray, "v n 3"]
    basis: Float[np.ndarray, "v n s"]
    px: Float[np.ndarray, "v n 2"]
    present: Bool[np.ndarray, "v n"]
    ids: Int[np.ndarray, "v n"]
    standpoint: Int[np.ndarray, " v"]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def standpoints(self) -> int:
        """Number of standpoints from which the board was seen; the number of views, but for repeats."""
        return len(np.unique(self.standpoint))

    @property
    def sizes_px(self) -> Float[np.ndarray, " v"]:
        """Size of the board in each view: the diagonal of its corners' bounding box."""
        low = np.where(self.present[..., None], self.px, np.inf).min(1)
        high = np.where(self.present[..., None], self.px, -np.inf).max(1)
        return np.linalg.norm(high - low, axis=1)

    def part(self, which: Sequence[int] | np.ndarray) -> Data:
        """The data of some views."""
        which = np.asarray(which, int)
        names = tuple(self.names[i] for i in which)
        arrays = (self.places, self.basis, self.px, self.present, self.ids, self.standpoint)
        return Data(names, *(array[which] for array in arrays))


def data_of(views: Sequence[BoardView], board: Board) -> Data:
    """The adjustment's data of views of a board."""
    most = max(len(view.ids) for view in views)
    count = len(views)
    ids = np.zeros((count, most), int)
    px = np.zeros((count, most, 2))
    present = np.zeros((count, most), bool)
    for k, view in enumerate(views):
        n = len(view.ids)
        ids[k, :n], px[k, :n], present[k, :n] = view.ids, view.corners_px, True
        ids[k, n:] = view.ids[0]
    basis = bending(board, np.unique(ids))
    names = tuple(view.name for view in views)
    return Data(names, board.points[ids], basis[ids], px, present, ids, _standpoints(views))


def _standpoints(views: Sequence[BoardView]) -> Int[np.ndarray, " v"]:
    """A number for each view: that of the first view which it repeats, or its own."""
    standpoint = np.arange(len(views))
    for k, view in enumerate(views):
        for j in range(k):
            if standpoint[j] == j and moved(views[j], view) < _REPEATS:
                standpoint[k] = j
                break
    return standpoint


def moved(one: BoardView, other: BoardView) -> float:
    """RMS distance between the corners that two views share, as a part of the board's size; infinite if none.

    The size is the diagonal of the corners' bounding box.
    """
    shared, of_one, of_other = np.intersect1d(one.ids, other.ids, assume_unique=True, return_indices=True)
    if len(shared) < 4:
        return np.inf
    a, b = one.corners_px[of_one], other.corners_px[of_other]
    size = float(np.linalg.norm(np.ptp(a, axis=0)))
    return float(np.sqrt(np.mean(((a - b) ** 2).sum(1)))) / max(size, 1e-9)


def bending(board: Board, seen: Int[np.ndarray, " n"]) -> Float[np.ndarray, "corners s"]:
    """Heights of the board's corners in every independent way of being off one plane, of unit length each.

    A height at each corner, less what moving and tilting the sheet does. Corners that no view shows stay.
    """
    plane = np.column_stack([np.ones(len(seen)), board.centred[seen]])
    complement = np.linalg.qr(plane, mode="complete")[0][:, plane.shape[1] :]
    basis = np.zeros((board.corners, complement.shape[1]))
    basis[seen] = board.square * complement
    return basis
