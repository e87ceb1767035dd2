"""The hand tuning that autoreg replaces, against autoreg: pixels, and minutes of a person's work."""

from __future__ import annotations

import shutil

import numpy as np

from benchmarks.hand_tuning import VALIDATIONS, Compared, compare
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.result import Result, Table

# The model of the work by hand: each line has two knobs, a turn and a shift; each knob wants some trials,
# and each trial a look at a rendered picture. These are assumptions, not measurements.
KNOBS, TRIALS, TRIAL_S = 2, 5, 20.0
# Whoever turns all lines of a family together has four knobs in all.
FAMILIES = 2


def minutes_by_hand(lines: int, *, together: bool) -> float:
    """Minutes that the model says: all lines of a family at one turn, or each line by itself."""
    return KNOBS * (FAMILIES if together else lines) * TRIALS * TRIAL_S / 60.0


def run(options: Options) -> Result:
    """All five photos; in the short run the one that is smallest."""
    if shutil.which("povray") is None:
        return Result("thesis", skipped="POV-Ray is not installed, and it draws the photos")
    folder = options.cache("thesis")
    compared = [compare(v, folder) for v in (VALIDATIONS[-1:] if options.quick else VALIDATIONS)]
    found = [c for c in compared if isinstance(c, Compared)]
    refused = tuple(c for c in compared if isinstance(c, str))
    if not found:
        return Result("thesis", skipped="; ".join(refused))
    saved = [minutes_by_hand(c.lines, together=False) - c.seconds / 60.0 for c in found]
    return Result(
        "thesis",
        about=(
            "Ray-traced photos with irregular slabs (0.8 mm). Lines that `align` and the renderer put on the "
            "joints, untouched, against the best that lines placed by hand reach with a camera "
            "guessed as one "
            "does in POV-Ray: a turn about the vertical and a shift sideways, found by search."
        ),
        figures=(
            Figure("thesis.rms", max(c.rms_px for c in found)),
            Figure("thesis.gain", float(np.median([c.each_free_px / c.rms_px for c in found]))),
            Figure("thesis.minutes", float(np.median(saved))),
        ),
        tables=(_table(found),),
        notes=(
            f"Minutes by hand are a model: {KNOBS} knobs for each line, {TRIALS} trials for each knob, "
            f"{TRIAL_S:g} s to render and look at each; nobody was timed.",
            *refused,
        ),
    )


def _table(found: list[Compared]) -> Table:
    rows = tuple(
        (
            c.name,
            f"{c.size[0]} x {c.size[1]}",
            f"{c.rms_px:.3f}",
            f"{c.worst_px:.2f}",
            "" if c.check_px is None else f"{c.check_px:.4f}",
            str(c.lines),
            f"{c.one_turn_px:.1f}",
            f"{c.each_free_px:.1f}",
            f"{minutes_by_hand(c.lines, together=True):.0f}",
            f"{minutes_by_hand(c.lines, together=False):.0f}",
            f"{c.seconds / 60.0:.2f}",
        )
        for c in found
    )
    columns = (
        "photo", "size", "autoreg, px rms", "at most", "render check", "lines", "by hand, one turn",
        "by hand, each free", "minutes, one turn", "minutes, each free", "minutes, autoreg",
    )  # fmt: skip
    return Table("Distance of the lines from the true joints", columns, rows)
