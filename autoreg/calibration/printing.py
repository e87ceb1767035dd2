"""A board to print: PDF or SVG at true size."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np

from autoreg.calibration.board import Board
from autoreg.errors import InputError

Format = Literal["pdf", "svg"]

_MM_PER_INCH = 25.4
# White around the squares, which the detectors need, and a line of text below.
_MARGIN_SQUARES = 1.0
_TEXT_MM = 3.0
# Sheets that printers take, portrait, in mm.
_PAPERS = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "A2": (420.0, 594.0), "A1": (594.0, 841.0)}
_LARGEST_MM = 3000.0
Rectangle = tuple[float, float, float, float]


@dataclass(frozen=True)
class Sheet:
    """Size of the printed sheet in mm, and the paper that it is (or is cut from)."""

    width_mm: float
    height_mm: float
    paper: str


def sheet_for(board: Board) -> Sheet:
    """The smallest paper that holds the board with its margin; its own size if none does.

    Raises:
        InputError: the board is larger than any printer's roll.
    """
    side = board.square * 1000
    width = (board.columns + 1 + 2 * _MARGIN_SQUARES) * side
    height = (board.rows + 1 + 2 * _MARGIN_SQUARES) * side
    if max(width, height) > _LARGEST_MM or side < 1:
        raise InputError(
            f"squares of {board.square:g} m make a board of {width:.0f} x {height:.0f} mm; give --square "
            "in metres, "
            "such as 0.025"
        )
    # A printer leaves some mm of each sheet white; the board's own margin may overlap with those.
    least = ((board.columns + 1) * side + 20, (board.rows + 1) * side + 20)
    for name, (short, long) in _PAPERS.items():
        for sheet in ((long, short), (short, long)):
            if least[0] <= sheet[0] and least[1] <= sheet[1]:
                return Sheet(*sheet, name)
    return Sheet(width, height, "custom")


def print_board(board: Board, kind: Format) -> bytes:
    """The file of a board: black rectangles at true size, and a line that says what it is."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    sheet = sheet_for(board)
    figure = Figure(figsize=(sheet.width_mm / _MM_PER_INCH, sheet.height_mm / _MM_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, sheet.width_mm), ylim=(sheet.height_mm, 0))
    axes.axis("off")
    _draw(axes, board, sheet)
    out = io.BytesIO()
    canvas = {"pdf": FigureCanvasPdf, "svg": FigureCanvasSVG}[kind](figure)
    dated = {"CreationDate": None} if kind == "pdf" else {"Date": None}
    with rc_context({"svg.hashsalt": "autoreg", "svg.fonttype": "path"}):
        canvas.print_figure(out, format=kind, metadata=dated)
    return out.getvalue()


def black_rectangles(board: Board) -> tuple[Rectangle, ...]:
    """The black parts as (x, y, width, height) in squares from the outer corner, y down; none overlap."""
    squares = [
        (float(i), float(j), 1.0, 1.0)
        for j in range(board.rows + 1)
        for i in range(board.columns + 1)
        if (i + j) % 2 == 0
    ]
    return (*squares, *(_marker_rectangles(board) if board.kind == "charuco" else ()))


def _marker_rectangles(board: Board) -> list[Rectangle]:
    """The markers' black bits, joined to runs along rows."""
    charuco = board.charuco()
    dictionary = charuco.getDictionary()
    bits = dictionary.markerSize + 2
    found: list[Rectangle] = []
    for number, corners in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True):
        x, y = np.asarray(corners)[:, :2].min(0)
        picture = dictionary.generateImageMarker(int(number), bits, borderBits=1) < 128
        bit = board.marker / bits
        for row, line in enumerate(picture):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(int), [0]])))
            found += [
                (float(x + a * bit), float(y + row * bit), float((b - a) * bit), float(bit))
                for a, b in zip(edges[::2], edges[1::2], strict=True)
            ]
    return found


def _draw(axes: object, board: Board, sheet: Sheet) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle as Patch

    side = board.square * 1000
    left = (sheet.width_mm - (board.columns + 1) * side) / 2
    top = (sheet.height_mm - (board.rows + 1) * side) / 2
    patches = [
        Patch((left + x * side, top + y * side), w * side, h * side) for x, y, w, h in black_rectangles(board)
    ]
    collection = PatchCollection(patches, facecolor="black", edgecolor="none", antialiased=False)
    axes.add_collection(collection)  # pyright: ignore
    what = f"{board.pattern} inner corners, squares of {side:g} mm"
    what += f", ChArUco {board.dictionary}, markers {board.marker:g}" if board.kind == "charuco" else ""
    text = f"{what} - print at 100 %, measure a row of squares, glue to a flat plate"
    axes.text(  # pyright: ignore
        sheet.width_mm / 2,
        sheet.height_mm - 2,
        text,
        ha="center",
        va="bottom",
        fontsize=min(_TEXT_MM / _MM_PER_INCH * 72, 1.6 * sheet.width_mm / _MM_PER_INCH * 72 / len(text)),
    )
