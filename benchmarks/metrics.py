"""The one list of what is measured. The report, the plots' goals and the gate read it, and nothing else.

A metric says what its number means; a figure is such a number. Tolerances are for the gate: how much worse
than the committed baseline a figure may be.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Better = Literal["lower", "higher", "inside"]
# When the gate looks at a metric: figures that depend on the machine say little in a short run.
Gated = Literal["always", "full", "never"]


@dataclass(frozen=True)
class Metric:
    """What a number means.

    Attributes:
        key: suite and name, "limit.ratio".
        label: words for people.
        unit: of the number; empty for a plain ratio.
        better: which way is better; "inside" means within the goal's two bounds.
        goal: what it has to reach; two bounds for "inside"; None where it is only told.
        relative: the gate's tolerance, as a share of the baseline.
        absolute: the gate's tolerance in the metric's own unit; both are added.
        gated: when the gate looks at it.
    """

    key: str
    label: str
    unit: str = ""
    better: Better = "lower"
    goal: float | tuple[float, float] | None = None
    relative: float = 0.1
    absolute: float = 0.0
    gated: Gated = "always"

    def __post_init__(self) -> None:
        if "." not in self.key:
            raise ValueError(f"key: wants suite.name, got {self.key!r}")
        if (self.better == "inside") != isinstance(self.goal, tuple):
            raise ValueError(f"{self.key}: 'inside' and a goal of two bounds go together, got {self.goal}")
        if self.relative < 0 or self.absolute < 0:
            raise ValueError(f"{self.key}: tolerances cannot be negative")

    @property
    def suite(self) -> str:
        """Name of the suite that measures it."""
        return self.key.split(".", 1)[0]

    def badness(self, value: float) -> float:
        """A number that grows as the figure gets worse; for "inside" the distance from the bounds."""
        if isinstance(self.goal, tuple):
            return max(self.goal[0] - value, value - self.goal[1], 0.0)
        return -value if self.better == "higher" else value

    def reached(self, value: float) -> bool | None:
        """Whether a figure reaches the goal; None where there is none."""
        if self.goal is None:
            return None
        if isinstance(self.goal, tuple):
            return self.badness(value) == 0.0
        return self.badness(value) <= self.badness(self.goal)

    def worse(self, value: float, baseline: float) -> float:
        """By how much a figure is worse than the baseline beyond the tolerance; at most 0 if it is not."""
        allowed = self.relative * abs(baseline) + self.absolute
        return self.badness(value) - self.badness(baseline) - allowed

    def goal_text(self) -> str:
        """The goal in words."""
        if self.goal is None:
            return ""
        if isinstance(self.goal, tuple):
            return f"{self.goal[0]:g} to {self.goal[1]:g}"
        return f"at {'least' if self.better == 'higher' else 'most'} {self.goal:g}"


@dataclass(frozen=True)
class Figure:
    """One measured number."""

    key: str
    value: float


# Figures of exact error are functions of fixed seeds: only rounding differs between machines, and a tenth is
# a change of the program. Ratios of times differ by a third between machines, and more on a busy one.
TIMES = 0.5

METRICS: tuple[Metric, ...] = (
    # refine
    Metric("refine.rotation", "rotation error of the last stage, median", "deg", relative=0.15),
    Metric("refine.crossings", "crossings' error of the last stage, median", "px", relative=0.15),
    Metric("refine.rotation_ratio", "rotation error over the best peer's", goal=1 / 3, relative=0.2),
    Metric("refine.crossings_ratio", "crossings' error over the best peer's", goal=1 / 3, relative=0.2),
    Metric("refine.solve_ms", "one solve of 300 segments in a vmapped batch", "ms", gated="never"),
    Metric(
        "refine.solve_ratio",
        "time of that solve over the fastest peer's",
        goal=5.0,
        relative=TIMES,
        gated="full",
    ),
    # limit
    Metric("limit.ratio", "RMSE over the Cramér-Rao bound, median of the moderate grid", goal=1.3),
    Metric("limit.ratio_crossings", "the same for the crossings, median of the moderate grid", goal=1.3),
    Metric("limit.worst", "RMSE over the bound, worst parameter anywhere", goal=2.0, relative=0.2),
    Metric("limit.lost", "fits that were lost", "%", goal=0.0, absolute=0.0),
    # truth
    Metric(
        "truth.pose", "95 % regions of the pose that hold the truth", "%", "inside", (93.0, 97.0), 0.0, 3.0
    ),
    Metric("truth.rotation", "... of the rotation alone", "%", "inside", (93.0, 97.0), 0.0, 3.0),
    Metric(
        "truth.even", "... of the pose, slabs where they ought to be", "%", "inside", (93.0, 97.0), 0.0, 4.0
    ),
    Metric("truth.uneven", "... of the pose, slabs with jitter", "%", "inside", (93.0, 97.0), 0.0, 4.0),
    Metric(
        "truth.focal",
        "95 % intervals of the focal length from the photo",
        "%",
        "inside",
        (93.0, 97.0),
        0.0,
        4.0,
    ),
    Metric("truth.alarms", "true cameras that are called wrong", "%", goal=0.5, absolute=1.0),
    # robust
    Metric("robust.wrong", "photos aligned wrongly, without a word", "%", goal=0.5, absolute=0.5),
    Metric("robust.success", "photos aligned rightly, over the whole grid", "%", "higher", absolute=2.0),
    Metric("robust.refused", "photos refused", "%", absolute=3.0),
    # vanishing
    Metric("vanishing.auc1", "York Urban, AUC at 1°", better="higher", relative=0.02),
    Metric("vanishing.auc3", "York Urban, AUC at 3°", "", "higher", 0.70, 0.01),
    Metric("vanishing.auc5", "York Urban, AUC at 5°", better="higher", relative=0.01),
    Metric("vanishing.auc10", "York Urban, AUC at 10°", "", "higher", 0.90, 0.01),
    Metric("vanishing.rotation", "York Urban, rotation, median", "deg", goal=0.85, relative=0.03),
    Metric("vanishing.lead", "AUC at 3° above the best peer's of this run", "", "higher", 0.0, 0.0, 0.02),
    Metric("vanishing.time", "the stage alone over one LSD pass", goal=0.3, relative=TIMES, gated="full"),
    Metric("vanishing.with_segments", "segments and frame over one LSD pass", relative=TIMES, gated="full"),
    # thesis
    Metric("thesis.rms", "rendered lines off the true joints, worst photo", "px", goal=0.5, relative=0.15),
    Metric("thesis.gain", "error of the best hand tuning over autoreg's, median", "", "higher", relative=0.2),
    Metric(
        "thesis.minutes",
        "minutes of hand work saved on a photo, median, by the stated model",
        "min",
        "higher",
    ),
    # speed
    Metric(
        "speed.align_2mp",
        "align in process over decode + one LSD pass, 2 MP",
        goal=1.8,
        relative=TIMES,
        gated="full",
    ),
    Metric("speed.align_13mp", "... 13.5 MP", goal=0.6, relative=TIMES, gated="full"),
    Metric("speed.align_50mp", "... 50 MP", relative=TIMES, gated="full"),
    Metric(
        "speed.command_2mp",
        "warm command over its floor program, 2 MP",
        goal=1.4,
        relative=TIMES,
        gated="full",
    ),
    Metric("speed.command_13mp", "... 13.5 MP", goal=1.4, relative=TIMES, gated="full"),
    Metric("speed.command_50mp", "... 50 MP", relative=TIMES, gated="full"),
    Metric(
        "speed.cold_2mp",
        "first command, nothing cached, over the floor program, 2 MP",
        relative=TIMES,
        gated="full",
    ),
    Metric("speed.memory_2mp", "peak memory of the command, 2 MP", "GB", relative=0.2, gated="full"),
    Metric("speed.memory_13mp", "... 13.5 MP", "GB", goal=1.2, gated="full"),
    Metric("speed.memory_50mp", "... 50 MP", "GB", goal=3.0, gated="full"),
    Metric(
        "speed.many",
        "64 photos of 2 MP in one process, times faster than 64 commands",
        "",
        "higher",
        3.0,
        TIMES,
        gated="full",
    ),
    Metric(
        "speed.beside",
        "... by one call of `run_jobs` in two processes",
        "",
        "higher",
        3.0,
        TIMES,
        gated="full",
    ),
    Metric("speed.align_s", "align in process, 2 MP", "s", gated="never"),
    # scenes
    Metric("scenes.right", "ray-traced pavings that are right", "%", "higher", 95.0, absolute=2.0),
    Metric("scenes.wrong", "scenes aligned wrongly, without a word", "%", goal=0.0, absolute=0.5),
    Metric(
        "scenes.refused", "grounds without a lattice that are refused", "%", "higher", 100.0, absolute=0.0
    ),
    Metric("scenes.turn", "error of the rotation, median", "deg", goal=0.02, relative=0.2),
    Metric("scenes.crossings", "error of the crossings, median", "px", goal=0.3, relative=0.2),
    Metric(
        "scenes.pose", "95 % regions of the pose that hold the truth", "%", "inside", (93.0, 97.0), 0.0, 3.0
    ),
    Metric("scenes.rotation", "... of the rotation alone", "%", "inside", (93.0, 97.0), 0.0, 3.0),
    # boards
    Metric("boards.right", "real boards and floors within 0.3° and 2 %", "%", "higher", 92.0, absolute=2.0),
    Metric("boards.wrong", "... more than 1° or 2 % off, without a word", goal=0.0, relative=0.0),
    Metric("boards.alarms", "right cameras that are called wrong", goal=0.0, relative=0.0),
    Metric("boards.turn", "error of the rotation, median of the aligned", "deg", relative=0.2),
    Metric("boards.height", "error of the height, worst of the aligned", "%", goal=2.0, absolute=0.5),
    # real
    Metric("real.wrong", "photos aligned as what they are known not to be", "", goal=0.0, relative=0.0),
    Metric("real.aligned", "paved photos aligned as expected", "", "higher", relative=0.0),
    Metric("real.rms", "joints off their lines, RMS, worst photo", "‰ of the diagonal", relative=0.25),
    Metric("real.refused", "pictures of other things that are refused", "", "higher", relative=0.0),
    # variants
    Metric(
        "variants.contradicted", "answers that contradict the unchanged photo's", "%", goal=0.0, absolute=0.5
    ),
    Metric("variants.kept", "aligned photos that are aligned alike, changed", "%", "higher", absolute=2.0),
)


def metric(key: str) -> Metric:
    """The metric of a key.

    Raises:
        KeyError: there is none; a suite may only report what the list names.
    """
    for found in METRICS:
        if found.key == key:
            return found
    raise KeyError(f"{key}: not in benchmarks/metrics.py; every figure needs a metric")
