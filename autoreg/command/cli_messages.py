"""What a run says to people on stderr: its steps as they are taken, and how it ended."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autoreg.errors import InputError

if TYPE_CHECKING:
    from autoreg.alignment import Alignment
    from autoreg.jobs.job import Listener, Outcome

# Focal lengths that differ by less are not what is wrong with a camera.
ABOUT_THE_SAME = 0.02


def tell(text: str) -> None:
    """A line on stderr."""
    print(text, file=sys.stderr)


def hand_over(text: str, place: Path | None = None) -> None:
    """What was asked for on stdout, with its own line ends; nothing where stdout is closed (`>&-`).

    Args:
        text: what was asked for.
        place: the folder in which it stands besides.

    Raises:
        InputError: stdout takes nothing, because its disk is full or its reader has gone.
    """
    try:
        print(text, end="", flush=True)
    except OSError as error:
        # What stdout still holds would fail again when the process ends.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        elsewhere = "" if place is None else f"; the results are in {place}"
        raise InputError(f"stdout cannot be written: {error.strerror or error}{elsewhere}") from error


def tell_outcome(outcome: Outcome) -> None:
    """How an alignment ended: the answer or why there is none, what to beware of, what was written."""
    refusal, alignment = outcome.refusal, outcome.alignment
    if refusal is not None:
        tell(f"refused ({refusal.code}): {refusal.message}")
        if refusal.measured is not None:
            limit = "" if refusal.limit is None else f", limit {refusal.limit:.4g}"
            tell(f"  measured {refusal.measured:.4g}{limit}")
    if alignment is not None:
        for warning in alignment.warnings:
            tell(f"warning: {warning}")
        camera = alignment.camera
        if camera.consistent is False:
            _tell_inconsistent(camera.camera.fx, camera.focal_from_photo_px, camera.focal_from_photo_sigma_px)
        tell(_summary(alignment))
    for path in outcome.written:
        tell(f"wrote {path}")
    tell_check(outcome.report)
    if outcome.render_error is not None:
        tell(f"error: the render failed: {outcome.render_error}")


def tell_check(report: dict[str, Any]) -> None:
    """One line: how well the rendered camera is the photo's."""
    check = (report.get("render") or {}).get("check")
    if check is not None:
        tell(
            f"rendered: joints in the layer lie {check['rms_px']:.3f} px rms ({check['max_px']:.3f} at most) "
            "from their computed place"
        )


def _tell_inconsistent(given_px: float, found_px: float | None, sigma_px: float | None) -> None:
    """The loud word: a wrong camera gives a pose that looks fine and is not."""
    found = "" if found_px is None else f" They ask for a focal length of {found_px:.0f} px"
    found += "" if not found or sigma_px is None else f" (± {sigma_px:.0f})"
    found += f"; the camera says {given_px:.0f} px." if found else ""
    if found_px is not None and abs(found_px / given_px - 1) < ABOUT_THE_SAME:
        found += " It is its principal point, or its lens distortion, that does not suit them."
    tell("*" * 78)
    tell(f"WARNING: the photo's own joints contradict the given camera.{found}")
    tell("The pose below rests on that camera and is probably wrong. Check that the camera file belongs to")
    tell("this photo (same camera, zoom, focus and crop), or leave --camera out.")
    tell("*" * 78)


def _summary(alignment: Alignment) -> str:
    """One line: the paving, the camera's height, and how well they fit."""
    lattice, residual = alignment.lattice, alignment.residual
    known = alignment.scale_source != "none"
    unit = " m" if known else " slab sides"
    sides = [f"{side:.4g}" for side in (lattice.spacing_x, lattice.spacing_y) if side is not None]
    pose = alignment.pose
    height, turn_deg = float(pose.cam_from_ground.origin_in_a[2]), math.degrees(pose.sigma_turn)
    sigma = "" if alignment.scale_source == "camera_height" else f" ± {pose.sigma_height:.1g}"
    return (
        f"aligned: {lattice.kind} of {' x '.join(sides)}{unit}, camera {height:.4g}{sigma}"
        f"{unit} above the ground and turned to ± {turn_deg:.1g}°, "
        f"{residual.joints} joints at {residual.rms_px:.2f} px rms"
    )


@contextmanager
def listener_on_stderr() -> Generator[Listener]:
    """Steps as a spinner if stderr is a terminal, else none; notes always."""
    from autoreg.jobs.job import Listener

    if not sys.stderr.isatty():
        yield Listener(note=lambda text: tell(f"note: {text}"), doing=lambda text: None)
        return
    from rich.console import Console
    from rich.text import Text

    console = Console(stderr=True)
    with console.status("") as status:
        step = ""

        # As Text, because file names may hold what rich takes for markup.
        def doing(text: str) -> None:
            nonlocal step
            step = text
            status.update(Text(f"{text} ..."))

        def progress(part: float) -> None:
            done = round(30 * part)
            status.update(Text(f"{step} {'━' * done}{'─' * (30 - done)} {100 * part:3.0f} %"))

        yield Listener(
            note=lambda text: console.print(Text(f"note: {text}"), soft_wrap=True),
            doing=doing,
            progress=progress,
        )
