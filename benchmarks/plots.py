"""The plots of the results, by matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure as Canvas

from benchmarks.result import Plot, Result


def draw(plot: Plot, path: Path) -> Path:
    """The path of a plot's PNG."""
    canvas = Canvas(figsize=(6.4, 3.8), layout="constrained")
    axes = canvas.subplots()
    for series, marker in zip(plot.series, "osv^Dx*+" * len(plot.series), strict=False):
        axes.plot(series.x, series.y, marker=marker, markersize=4, linewidth=1.3, label=series.label)
    if plot.goal is not None:
        axes.axhline(plot.goal, color="0.4", linestyle="--", linewidth=1, label=f"goal {plot.goal:g}")
    if plot.log_x:
        axes.set_xscale("log")
    if plot.log_y:
        axes.set_yscale("log")
    axes.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label)
    axes.grid(alpha=0.25)
    if len(plot.series) + (plot.goal is not None) > 1:
        axes.legend(fontsize="small")
    # Without a date in it, the same curves are the same file.
    canvas.savefig(path, dpi=110, metadata={"Software": None})
    return path


def draw_all(results: Sequence[Result], folder: Path) -> tuple[Path, ...]:
    """The paths of every plot of the results, in a folder that is made if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    return tuple(draw(plot, folder / file_of(result, plot)) for result in results for plot in result.plots)


def file_of(result: Result, plot: Plot) -> str:
    """The file's name of a plot."""
    return f"bench-{result.suite}-{plot.name}.png"
