"""Pictures of a calibration: coverage, residuals, uncertainty, halves, views, models, sheet."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from autoreg.calibration.projection_map import PictureMap
from autoreg.calibration.result import Calibration

# Few colours, told apart by everyone (Okabe and Ito).
_BLUE, _ORANGE, _GREEN, _GREY = "#0072b2", "#d55e00", "#009e73", "#888888"
_DPI = 110
_SIZE_IN = (7.2, 5.0)
_ARROW_PARTS = 0.04


def plots_of(calibration: Calibration) -> dict[str, bytes]:
    """PNG pictures by name, in the order in which a report shows them."""
    drawn: dict[str, Callable[[Any], None]] = {
        "coverage": lambda axes: _coverage(axes, calibration),
        "uncertainty": lambda axes: _map(
            axes, calibration.uncertainty, calibration, "px (1 sigma, worst way)"
        ),
        "residuals": lambda axes: _residuals(axes, calibration),
        "views": lambda axes: _views(axes, calibration),
        "tilts": lambda axes: _tilts(axes, calibration),
        "models": lambda axes: _models(axes, calibration),
    }
    halves = calibration.halves
    if halves is not None:
        drawn["halves"] = lambda axes: _map(axes, halves.difference, calibration, "px apart (RMS of splits)")
    if calibration.flatness.bent_fit is not None:
        drawn["sheet"] = lambda axes: _sheet(axes, calibration)
    return {name: _png(draw) for name, draw in drawn.items()}


def _png(draw: Callable[[Any], None]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_IN, dpi=_DPI, layout="constrained")
    draw(figure.add_subplot())
    out = io.BytesIO()
    FigureCanvasAgg(figure).print_png(out)
    return out.getvalue()


def _frame(axes: Any, calibration: Calibration) -> None:
    """Axes in the picture's pixels."""
    axes.set(xlim=(-0.5, calibration.camera.width - 0.5), ylim=(calibration.camera.height - 0.5, -0.5))
    axes.set_aspect("equal")
    axes.set(xlabel="u (px)", ylabel="v (px)")


def _closed(points: np.ndarray) -> np.ndarray:
    return np.vstack([points, points[:1]])


def _coverage(axes: Any, calibration: Calibration) -> None:
    data, camera = calibration.data, calibration.camera
    for k in range(len(data)):
        corners = data.px[k][data.present[k]]
        hull = cv2.convexHull(corners.astype(np.float32)).reshape(-1, 2)
        axes.fill(*hull.T, color=_BLUE, alpha=0.08, linewidth=0)
        axes.plot(*corners.T, ".", color=_BLUE, markersize=2)
    axes.plot(*_closed(calibration.coverage.hull_px).T, color=_GREEN, label="valid region")
    axes.plot(camera.cx, camera.cy, "+", color=_ORANGE, markersize=14, label="principal point")
    axes.legend(loc="upper right")
    _frame(axes, calibration)


def _map(axes: Any, values: PictureMap, calibration: Calibration, unit: str) -> None:
    finite = values.px[np.isfinite(values.px)]
    if len(finite) == 0:
        axes.text(0.5, 0.5, "no value anywhere", transform=axes.transAxes, ha="center")
        return
    top = max(float(np.quantile(finite, 0.98)), 1e-6)
    shown = axes.contourf(
        values.u, values.v, values.px, np.linspace(0, top, 13), cmap="viridis", extend="max"
    )
    axes.figure.colorbar(shown, ax=axes, label=unit)
    axes.plot(*_closed(calibration.coverage.hull_px).T, color="white", linewidth=1)
    _frame(axes, calibration)


def _residuals(axes: Any, calibration: Calibration) -> None:
    data, residuals = calibration.data, calibration.fit.residuals_px
    here = data.present
    length = np.quantile(np.linalg.norm(residuals[here], axis=1), 0.95)
    scale = _ARROW_PARTS * calibration.camera.width / max(length, 1e-12)
    for k in range(len(data)):
        start, arrow = data.px[k][here[k]], residuals[k][here[k]] * scale
        axes.plot(*np.stack([start, start + arrow], 1).transpose(2, 1, 0), color=_BLUE, linewidth=0.6)
    axes.set_title(f"measured minus projected, {scale:.0f} times enlarged", fontsize=10)
    _frame(axes, calibration)


def _views(axes: Any, calibration: Calibration) -> None:
    rms, names = calibration.fit.view_rms_px, calibration.data.names
    left_out = {bad.name: bad.held_out_px for bad in calibration.bad}
    axes.barh(range(len(names)), rms, color=_BLUE, label="took part (RMS)")
    if left_out:
        axes.barh(
            range(len(names), len(names) + len(left_out)),
            list(left_out.values()),
            color=_ORANGE,
            label="left out (RMS when foretold)",
        )
    labels = [*names, *left_out]
    if len(labels) <= 60:
        axes.set_yticks(range(len(labels)), labels, fontsize=min(9, 260 / len(labels)))
    axes.invert_yaxis()
    axes.axvline(calibration.rms_px, color=_GREY, linestyle="--", label="OpenCV's RMS")
    axes.set_xlabel("px")
    axes.legend(loc="lower right", fontsize=8)


def _tilts(axes: Any, calibration: Calibration) -> None:
    normals = calibration.fit.state.normals
    sideways = normals[:, :2] * np.sign(normals[:, 2:])
    angle = np.degrees(np.arcsin(np.clip(np.linalg.norm(sideways, axis=1), 0, 1)))
    unit = sideways / np.maximum(np.linalg.norm(sideways, axis=1, keepdims=True), 1e-12)
    for ring in (15, 30, 45, 60):
        turn = np.linspace(0, 2 * np.pi, 90)
        axes.plot(ring * np.cos(turn), ring * np.sin(turn), color=_GREY, linewidth=0.5)
        axes.annotate(f"{ring}°", (ring, 0), fontsize=8, color=_GREY)
    axes.plot(*(unit * angle[:, None]).T, "o", color=_BLUE)
    axes.set(xlim=(-65, 65), ylim=(65, -65), xlabel="leaning right (°)", ylabel="leaning down (°)")
    axes.set_aspect("equal")


def _models(axes: Any, calibration: Calibration) -> None:
    trials = calibration.trials
    colours = [_GREEN if trial.model == calibration.model else _BLUE for trial in trials]
    bars = axes.bar(
        [trial.model.name for trial in trials], [trial.score_px for trial in trials], color=colours
    )
    axes.bar_label(bars, [f"{trial.score_px:.3f}" for trial in trials], fontsize=8)
    axes.set_ylabel("RMS of views held out (px)")
    axes.set_ylim(0, 1.25 * float(np.median([trial.score_px for trial in trials])))
    axes.tick_params(axis="x", labelrotation=20)


def _sheet(axes: Any, calibration: Calibration) -> None:
    board, fit = calibration.board, calibration.flatness.bent_fit
    assert fit is not None
    heights = np.full(board.corners, np.nan)
    data = calibration.data
    found = data.basis @ fit.state.shape / board.square
    for k in range(len(data)):
        heights[data.ids[k][data.present[k]]] = found[k][data.present[k]]
    shown = axes.imshow(heights.reshape(board.rows, board.columns), cmap="coolwarm")
    axes.figure.colorbar(shown, ax=axes, label="height off the plane (squares)")
    axes.set(xlabel="corner along a row", ylabel="row")
