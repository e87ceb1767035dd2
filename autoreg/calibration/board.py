"""The calibration board: its inner corners, their places on the sheet, and its markers if it has any."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral, Real
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int

from autoreg.errors import InputError

Kind = Literal["chessboard", "charuco"]

MIN_CORNERS, MAX_CORNERS = 3, 40
DEFAULT_DICTIONARY = "5X5_250"
DEFAULT_MARKER = 0.7


@dataclass(frozen=True)
class Board:
    """A flat board of alternating squares; corner (i, j) lies at (i, j) * square on the sheet, Z away.

    X runs along the rows of corners and Y down the columns, as one looks at the sheet, so Z points into it:
    the frame of a board that faces the camera is turned like the camera's own.

    Attributes:
        columns: inner corners along a row.
        rows: inner corners along a column.
        square: side of a square, in metres if it is known, else 1.
        square_known: whether `square` is in metres.
        kind: plain squares, or squares with ArUco markers in the white ones.
        dictionary: the markers' ArUco dictionary, such as "5X5_250".
        marker: side of a marker as a part of the square's.
    """

    columns: int
    rows: int
    square: float = 1.0
    square_known: bool = False
    kind: Kind = "chessboard"
    dictionary: str = DEFAULT_DICTIONARY
    marker: float = DEFAULT_MARKER

    def __post_init__(self) -> None:
        for name in ("columns", "rows", "square", "marker"):
            value = getattr(self, name)
            if not isinstance(value, Real):
                raise ValueError(f"{name} must be a number, such as square=0.025 (metres), got {value!r}")
        for name in ("columns", "rows"):
            if not MIN_CORNERS <= getattr(self, name) <= MAX_CORNERS:
                raise InputError(
                    f"the pattern {self.columns}x{self.rows} is out of range: a board has from "
                    f"{MIN_CORNERS} to "
                    f"{MAX_CORNERS} inner corners (where four squares meet) each way"
                )
        if not (np.isfinite(self.square) and self.square > 0):
            raise InputError(f"the side of a square must be a positive length, got {self.square}")
        if not 0.3 <= self.marker <= 0.95:
            raise InputError(f"the marker must take from 0.3 to 0.95 of the square's side, got {self.marker}")

    @property
    def pattern(self) -> str:
        """The board's size as people write it: inner corners along a row x along a column."""
        return f"{self.columns}x{self.rows}"

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Places of the inner corners on the flat sheet, row by row."""
        i, j = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.column_stack([i.ravel(), j.ravel(), 0 * i.ravel()]) * float(self.square)

    @cached_property
    def centred(self) -> Float[np.ndarray, "n 2"]:
        """The corners' places with the sheet's middle at 0, in half lengths of the longer side."""
        reach = (max(self.columns, self.rows) - 1) / 2 * self.square
        middle = np.array([self.columns - 1, self.rows - 1]) / 2 * self.square
        return (self.points[:, :2] - middle) / reach

    @property
    def diagonal(self) -> float:
        """Distance between opposite inner corners, in the unit of `square`."""
        return float(np.hypot(self.columns - 1, self.rows - 1) * self.square)

    def charuco(self, *, legacy: bool = False) -> cv2.aruco.CharucoBoard:
        """OpenCV's board of the same layout; `legacy` is the one that OpenCV drew before 4.6."""
        name = f"DICT_{self.dictionary.upper()}"
        number = getattr(cv2.aruco, name, None)
        if not isinstance(number, int):
            known = sorted(k[5:] for k in dir(cv2.aruco) if k.startswith("DICT_"))
            raise InputError(
                f"the ArUco dictionary {self.dictionary!r} is unknown; use one of {', '.join(known)}"
            )
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        needed = (self.columns + 1) * (self.rows + 1) // 2
        if needed > len(dictionary.bytesList):
            raise InputError(
                f"a {self.pattern} board needs {needed} markers but {self.dictionary} has only "
                f"{len(dictionary.bytesList)}; use a larger dictionary"
            )
        board = cv2.aruco.CharucoBoard((self.columns + 1, self.rows + 1), 1.0, self.marker, dictionary)
        if legacy:
            board.setLegacyPattern(True)
        return board


@dataclass(frozen=True)
class BoardView:
    """The corners of a board that one photo shows.

    Attributes:
        name: the photo's name, as messages quote it.
        ids: which of the board's corners they are.
        corners_px: where they are in the photo.
    """

    name: str
    ids: Int[np.ndarray, " n"]
    corners_px: Float[np.ndarray, "n 2"]


def parse_pattern(text: object) -> tuple[int, int] | None:
    """Inner corners along a row and a column from a text such as 9x6, or the two numbers; None for "auto".

    Raises:
        InputError: the text is neither, or no board has so many.
        ValueError: it is no text and no two whole numbers.
    """
    if not isinstance(text, str):
        if not isinstance(text, Sequence) or len(text) != 2 or not all(isinstance(n, Integral) for n in text):
            raise ValueError(f'pattern must be text such as "9x6", or (9, 6), got {text!r}')
        return parse_pattern(f"{text[0]}x{text[1]}")
    if text.strip().lower() == "auto":
        return None
    match = re.fullmatch(r"\s*(\d{1,3})\s*[xX×,]\s*(\d{1,3})\s*", text)
    if match is None:
        raise InputError(
            f"the pattern must read COLUMNSxROWS in inner corners (where four squares meet), such as 9x6, or "
            f"auto; got {text!r}"
        )
    columns, rows = int(match[1]), int(match[2])
    Board(columns, rows)
    return columns, rows
