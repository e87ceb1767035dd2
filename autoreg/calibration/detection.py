"""Find a board in a picture: coarse at low resolution, exact at full resolution."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from autoreg.calibration.board import Board
from autoreg.calibration.corners import (
    WINDOW,
    in_board_order,
    nearest_spacing,
    refine,
    sides_that_go_on,
    trouble,
)
from autoreg.image import PixelScale, pyramid

Gray = UInt8[np.ndarray, "h w"]

# Pixels of the reduced pictures that are searched, one after the other: most boards are found in the first.
_SEARCHED = (1_000_000, 4_000_000)
# Fewer corners than this fix no pose with anything to spare.
_LEAST_CHARUCO = 8
_QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE
# Neighbours differ by up to 0.14 of the picture's spread in photos of boards, and by 0.25 to 1.4 in dithered
# pictures and in noise.
_SPECKLED = 0.2


@dataclass(frozen=True)
class Detection:
    """What the search for a board in one picture gave.

    Attributes:
        ids: which of the board's corners were found; empty if none.
        corners_px: where they are.
        reason: why there are none, or None.
        goes_on: whether corners go on beyond the left, right, top and bottom side of the pattern.
    """

    ids: Int[np.ndarray, " n"]
    corners_px: Float[np.ndarray, "n 2"]
    reason: str | None = None
    goes_on: tuple[bool, bool, bool, bool] = (False, False, False, False)

    @property
    def found(self) -> bool:
        """Whether there are corners."""
        return self.reason is None


def nothing(reason: str) -> Detection:
    """The detection of a picture without a board."""
    return Detection(np.zeros(0, int), np.zeros((0, 2)), reason)


def find_board(gray: Gray, board: Board) -> Detection:
    """The board's corners in a picture, to sub-pixel, or the reason why there are none."""
    return _find_charuco(gray, board) if board.kind == "charuco" else _find_chessboard(gray, board)


def _find_chessboard(gray: Gray, board: Board) -> Detection:
    problem: str | None = None
    for candidate in _candidates(gray, board):
        grid = candidate.reshape(board.rows, board.columns, 2)
        refined, moved = _sharpened(gray, grid)
        problem = trouble(refined, moved, gray.shape[1], gray.shape[0])
        if problem is None:
            grid = in_board_order(gray, refined)
            corners = np.ascontiguousarray(grid.reshape(-1, 2))
            return Detection(np.arange(board.corners), corners, None, sides_that_go_on(gray, grid))
    return nothing(f"no board with {board.pattern} inner corners was found" if problem is None else problem)


def _sharpened(gray: Gray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The refined grid, and how far each corner moved."""
    spacing = nearest_spacing(grid)
    refined = refine(gray, grid.reshape(-1, 2), spacing.ravel()).reshape(grid.shape)
    return refined, np.linalg.norm(refined - grid, axis=-1)


def _candidates(gray: Gray, board: Board) -> Generator[Float[np.ndarray, "n 2"]]:
    """Rough corners in the photo's pixels, from the quickest search to the most thorough."""
    size = (board.columns, board.rows)
    searched: set[tuple[int, ...]] = set()
    for pixels in _SEARCHED:
        small, scale = pyramid(gray, pixels)
        if small.shape in searched:
            continue
        searched.add(small.shape)
        searches: tuple[Callable[[Gray], tuple[bool, np.ndarray]], ...] = (
            lambda picture: cv2.findChessboardCorners(picture, size, flags=_QUICK),
            lambda picture: cv2.findChessboardCornersSB(picture, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE),
        )
        # The first takes every speck for a square and joins them all, which may take hours.
        for search in searches[_is_speckled(small) :]:
            found, corners = search(small)
            if found and np.size(corners) == 2 * board.corners:
                yield _in_photo(small, np.asarray(corners, float).reshape(-1, 2), scale, board)


def _is_speckled(picture: Gray) -> bool:
    """Whether neighbouring pixels differ as they do in no photo that is in focus or out of it."""
    steps = cv2.absdiff(picture[:, 1:], picture[:, :-1])
    return float(steps.mean()) > _SPECKLED * float(picture.std())


def _in_photo(
    small: Gray, corners: Float[np.ndarray, "n 2"], scale: PixelScale, board: Board
) -> Float[np.ndarray, "n 2"]:
    """The corners in the photo, refined in the reduced picture first: so the photo's windows catch them."""
    grid = corners.reshape(board.rows, board.columns, 2)
    if scale.factor_x > 1:
        refined, moved = _sharpened(small, grid)
        # Where the refinement ran away, the detector's own answer is the better start.
        grid = np.where((moved < 0.3 * nearest_spacing(grid))[..., None], refined, grid)
    return scale.to_photo(grid.reshape(-1, 2))


def _find_charuco(gray: Gray, board: Board) -> Detection:
    most = markers = 0
    for pixels in _SEARCHED:
        small, scale = pyramid(gray, pixels)
        for legacy in (False, True):
            detector = cv2.aruco.CharucoDetector(board.charuco(legacy=legacy))
            corners, ids, _, seen = detector.detectBoard(small)
            ids = np.ravel(np.asarray(ids, object)).astype(float)
            ids = ids[np.isfinite(ids)].astype(int)
            most, markers = max(most, len(ids)), max(markers, _count(seen))
            if len(ids) >= _LEAST_CHARUCO:
                rough = scale.to_photo(np.asarray(corners, float).reshape(-1, 2))
                return _exact_charuco(gray, board, ids, rough)
        if scale.factor_x == 1:
            break
    return nothing(_why_no_charuco(gray, board, most, markers))


def _why_no_charuco(gray: Gray, board: Board, corners: int, markers: int) -> str:
    """Why a ChArUco board was not found, though so many of its corners and so many markers were."""
    if corners:
        return f"only {corners} corners of the ChArUco board were found, of at least {_LEAST_CHARUCO}"
    if markers:
        return (
            f"{markers} markers of {board.dictionary} were found, but not where a board of {board.pattern} "
            "inner corners has them; check --pattern and --dictionary"
        )
    # A marker is no marker in a mirror: a chessboard does not tell left from right, this board does.
    mirrored = cv2.flip(pyramid(gray, _SEARCHED[0])[0], 1)
    ids = cv2.aruco.CharucoDetector(board.charuco()).detectBoard(mirrored)[1]
    if _count(ids) >= _LEAST_CHARUCO:
        return "the photo is mirrored; switch that off in the camera, or mirror the file back"
    return f"no marker of a ChArUco board ({board.dictionary}) was found"


def _count(found: object) -> int:
    """How many of something OpenCV found; it answers None, or an empty array, where it finds nothing."""
    return 0 if found is None else int(np.size(np.asarray(found)))


def _exact_charuco(
    gray: Gray, board: Board, ids: Int[np.ndarray, " n"], rough_px: Float[np.ndarray, "n 2"]
) -> Detection:
    places = board.points[ids, :2]
    if min(len(np.unique(places[:, 0])), len(np.unique(places[:, 1]))) < 2:
        return nothing(f"the {len(ids)} corners found lie in one row")
    # Markers stand near the corners: the window may reach to them, not into them.
    H = np.asarray(cv2.findHomography(places, rough_px, cv2.RANSAC, 5.0)[0], float)
    if H.shape != (3, 3):
        return nothing("the corners found are no flat board's")
    along, across = np.array([board.square, 0.0]), np.array([0.0, board.square])
    side = np.minimum(
        *(np.linalg.norm(_mapped(H, places + way) - _mapped(H, places), axis=1) for way in (along, across))
    )
    # `refine` takes a part of the spacing as its window; this makes it end well before the markers begin.
    gap = (1 - board.marker) / 2 * side
    refined = refine(gray, rough_px, 0.75 * gap / WINDOW)
    moved = np.linalg.norm(refined - rough_px, axis=1)
    good = (moved < 0.15 * side) & np.isfinite(refined).all(1)
    if good.sum() < _LEAST_CHARUCO:
        return nothing("the corners are too blurred to be placed")
    return Detection(ids[good], refined[good])


def _mapped(H: np.ndarray, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Places of the sheet in the picture by a homography."""
    return np.asarray(cv2.perspectiveTransform(places.reshape(-1, 1, 2), H)).reshape(-1, 2)
