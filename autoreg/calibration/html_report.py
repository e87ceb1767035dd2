"""The report on a calibration as one file that any browser shows."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from autoreg.calibration.models import INTRINSICS
from autoreg.calibration.plots import plots_of
from autoreg.calibration.result import Calibration
from autoreg.jobs.outputs import write_whole

REPORT_NAME = "calibration.html"

_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222 }
body { max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 } td, th { padding: .2rem .8rem; text-align: right }
td:first-child, th:first-child { text-align: left } tr { border-bottom: 1px solid #ddd }
td { font-variant-numeric: tabular-nums }
figure { margin: 1.5rem 0 } img { max-width: 100% } figcaption { color: #555; font-size: .9rem }
.verdict { padding: .8rem 1.2rem; border-left: .6rem solid; background: #f6f6f6 }
.pair { display: flex; gap: 1rem; align-items: flex-end } .pair figure { flex: 1; margin: 0 }
.good { border-color: #009e73 } .usable { border-color: #e69f00 } .no { border-color: #d55e00 }
"""

_CAPTIONS = {
    "coverage": "Where corners were seen: the next photos should show the board where it is white. "
    "Outside the valid region the lens model extrapolates.",
    "tilts": "How the board leaned, one dot for each photo. It should lean by 20° to 45°, in all directions.",
    "uncertainty": "How far off the direction of a pixel may be: one standard deviation, in its worst "
    "direction, "
    "for points far away. The outline is the valid region.",
    "halves": "Two halves of the views calibrated apart: how far their projections differ, over the picture. "
    "Expect about twice the map before this one.",
    "residuals": "Measured minus projected corners. Neighbours that point the same way share an error: a "
    "bent sheet, or a lens that the model does not describe.",
    "views": "How well each view fits; those left out are judged by what the others foretell.",
    "models": "Lens models, judged by views they were not fitted to. Green: the one chosen, with every "
    "term that those views do not speak against; a term that is missing does more harm than one too many.",
    "sheet": "Heights of the corners off the plane, if the sheet's shape is estimated too.",
}


# What tells which photos to take next stands beside the verdict; the rest comes after the figures.
_NEXT_PHOTOS = ("coverage", "tilts")
_MEANING = {
    "good": "Use it",
    "usable": "Use it if the errors below do not matter to you, or take the photos that are asked for below",
    "do not use": "Its figures are not to be trusted; take the photos that are asked for below",
}


def write_report(calibration: Calibration, folder: Path, version: str) -> tuple[Path, ...]:
    """The files written: the plots as PNG, and one HTML file that holds them all."""
    folder.mkdir(parents=True, exist_ok=True)
    plots = plots_of(calibration)
    written = [write_whole(folder / f"{name}.png", png) for name, png in plots.items()]
    page = report_html(calibration, plots, version)
    return write_whole(folder / REPORT_NAME, page.encode()), *written


def report_html(calibration: Calibration, plots: Mapping[str, bytes], version: str) -> str:
    """The report's text, with the plots inside."""
    sections = [
        f"<h1>Calibration of {calibration.camera.width} x {calibration.camera.height}</h1>",
        _verdict(calibration),
        "<div class='pair'>" + "".join(_figure(name, plots[name]) for name in _NEXT_PHOTOS) + "</div>",
        "<h2>Camera</h2>",
        _intrinsics(calibration),
        "<h2>How well it fits</h2>",
        _figures(calibration),
        *(_figure(name, plots[name]) for name in _CAPTIONS if name in plots and name not in _NEXT_PHOTOS),
        "<h2>Photos</h2>",
        _photos(calibration),
        f"<p>Made by autoreg {escape(version)}.</p>",
    ]
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'><title>Camera calibration</title>"
        f"<style>{_STYLE}</style></head><body>\n" + "\n".join(sections) + "\n</body></html>\n"
    )


def _verdict(calibration: Calibration) -> str:
    verdict = calibration.verdict
    style = {"good": "good", "usable": "usable"}.get(verdict.grade, "no")
    text = f"<div class='verdict {style}'><strong>Verdict: {escape(verdict.grade)}.</strong> "
    text += f"{_MEANING[verdict.grade]}. {_accuracy(calibration)}"
    if verdict.reasons:
        text += _list(verdict.reasons)
    if verdict.advice:
        text += "<p>To do better:</p>" + _list(verdict.advice)
    return text + "</div>"


def _accuracy(calibration: Calibration) -> str:
    """What the camera is good for, in one sentence."""
    camera, sd = calibration.camera, calibration.precision.std_devs
    focal = 100 * max(sd[0] / camera.fx, sd[1] / camera.fy)
    return (
        f"It says where a pixel looks to ±{calibration.uncertainty.median_px:.2g} px in the median over the "
        f"picture, and the focal length to ±{focal:.2g} % (1 sigma)."
    )


def _intrinsics(calibration: Calibration) -> str:
    values, sd = calibration.fit.state.intrinsics, calibration.precision.std_devs
    free = calibration.fit.free[: len(INTRINSICS)]
    rows = [
        (name, *_with_deviation(value, deviation))
        for name, value, deviation, is_free in zip(INTRINSICS, values, sd, free, strict=True)
        if is_free
    ]
    model = escape(calibration.model.name)
    return f"<p>Lens model: {model}.</p>" + _table(("", "value", "standard deviation", "95 % interval"), rows)


def _with_deviation(value: float, deviation: float) -> tuple[str, str, str]:
    """A value, its standard deviation and its interval, to the deviation's second digit."""
    places = 6
    if 0 < deviation < np.inf:
        places = int(np.clip(1 - np.floor(np.log10(deviation)), 0, 9))
    low, high = value - 1.96 * deviation, value + 1.96 * deviation
    return f"{value:.{places}f}", f"{deviation:.{places}f}", f"{low:.{places}f} … {high:.{places}f}"


def _figures(calibration: Calibration) -> str:
    rows = [
        ("OpenCV's RMS, over all corners", f"{calibration.rms_px:.4f} px"),
        (
            "mean over views of |residuals|₂ / N (the OpenCV tutorial's “mean error”; no distance)",
            f"{calibration.mean_l2_over_n_px:.4f}",
        ),
        ("standard deviation of a corner's coordinate", f"{calibration.fit.sigma_px:.4f} px"),
        ("views scatter against corners (dispersion)", f"{calibration.precision.dispersion:.2f}"),
        (
            "direction of a pixel, median over the picture (1 sigma)",
            f"{calibration.uncertainty.median_px:.2f} px",
        ),
        ("picture covered by boards", f"{100 * calibration.coverage.area:.0f} %"),
        ("scatter along the sheet's normal against across", f"{np.sqrt(calibration.flatness.ratio):.2f}"),
    ]
    if calibration.halves is not None:
        rows.insert(
            5,
            (
                "two halves differ, median over the picture",
                f"{calibration.halves.difference.median_px:.2f} px",
            ),
        )
    return _table(("", ""), rows)


def _photos(calibration: Calibration) -> str:
    rows = [
        (name, f"{rms:.3f} px", f"{tilt:.0f}°")
        for name, rms, tilt in zip(
            calibration.data.names, calibration.fit.view_rms_px, calibration.coverage.tilts_deg, strict=True
        )
    ]
    text = _table(("photo", "RMS", "tilt"), rows)
    if calibration.left_out:
        text += "<p>Left out:</p>" + _list(f"{out.name}: {out.reason}" for out in calibration.left_out)
    return text + (_list(calibration.notes) if calibration.notes else "")


def _figure(name: str, png: bytes) -> str:
    caption = escape(_CAPTIONS[name])
    data = base64.b64encode(png).decode()
    image = f"<img alt='{caption}' src='data:image/png;base64,{data}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _list(lines: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>" if any(head) else ""
    body = ("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return "<table>" + top + "".join(body) + "</table>"
