"""Whether figures are as good as those of the committed baseline."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.metrics import METRICS, Metric, metric
from benchmarks.result import Result

BASELINE = Path(__file__).with_name("baseline.json")

Verdict = Literal["as good", "better", "worse", "missing", "not measured", "new", "not gated"]
FAILING: tuple[Verdict, ...] = ("worse", "missing")


@dataclass(frozen=True)
class Judgement:
    """One figure beside its baseline; `value` or `baseline` is None where there is none.

    `skipped` says why its suite did not run, and `excused` whether that is because its data are not here.
    """

    metric: Metric
    value: float | None
    baseline: float | None
    verdict: Verdict
    skipped: str = ""
    excused: bool = False

    @property
    def failed(self) -> bool:
        """Whether the gate shuts."""
        return self.verdict in FAILING or (self.verdict == "not measured" and not self.excused)

    def sentence(self) -> str:
        """What is wrong, or what there is to know."""
        m = self.metric
        if self.verdict == "missing":
            return f"{m.key}: the baseline has {self.baseline:.4g}, this run has no such figure"
        if self.verdict == "not measured":
            return f"{m.key}: not measured, the baseline has {self.baseline:.4g}: {self.skipped}"
        if self.verdict == "new":
            return f"{m.key}: not in the baseline; --update-baseline puts it there"
        allowed = f"{100 * m.relative:g} %" if m.relative else ""
        allowed += f"{' + ' if allowed and m.absolute else ''}{m.absolute:g}" if m.absolute else ""
        return (
            f"{m.key}: {self.value:.4g} {m.unit} against {self.baseline:.4g} in the baseline "
            f"({m.better} is better, tolerance {allowed or 'none'}): {self.verdict}"
        )


def mode_of(quick: bool) -> str:
    """Name of a kind of run in the baseline: the short one has figures of its own."""
    return "quick" if quick else "full"


def read_baseline(path: Path, quick: bool) -> dict[str, float]:
    """The baseline's figures by key; empty where there is no file."""
    if not path.is_file():
        return {}
    return {k: float(v) for k, v in json.loads(path.read_text()).get(mode_of(quick), {}).items()}


def write_baseline(path: Path, results: Sequence[Result], quick: bool) -> None:
    """Put the figures of these results into the baseline; those of other suites and runs stay."""
    content = json.loads(path.read_text()) if path.is_file() else {}
    kept = {
        key: value
        for key, value in content.get(mode_of(quick), {}).items()
        if not any(r.suite == key.split(".")[0] and r.skipped is None for r in results)
    }
    fresh = {
        figure.key: float(f"{figure.value:.6g}")
        for result in results
        for figure in result.figures
        if _looked_at(metric(figure.key), quick)
    }
    together = kept | fresh
    order = [m.key for m in METRICS]
    content[mode_of(quick)] = {key: together[key] for key in order if key in together}
    path.write_text(json.dumps(content, indent=1) + "\n")


def judge(results: Sequence[Result], baseline: dict[str, float], quick: bool) -> tuple[Judgement, ...]:
    """A judgement of every metric that these suites or the baseline have, in the list's order.

    What the baseline has and a suite that was skipped should have measured is "not measured". That shuts the
    gate, but not where the data were never put into their folder: a checkout alone cannot measure it.
    """
    by_suite = {result.suite: result for result in results}
    judged: list[Judgement] = []
    for m in METRICS:
        result = by_suite.get(m.suite)
        if result is None:
            continue
        value, before = result.value(m.key), baseline.get(m.key)
        if value is None and before is None:
            continue
        if result.skipped is not None:
            judged.append(Judgement(m, None, before, "not measured", result.skipped, result.absent))
            continue
        judged.append(Judgement(m, value, before, _verdict(m, value, before, quick)))
    return tuple(judged)


def _looked_at(m: Metric, quick: bool) -> bool:
    return m.gated == "always" or (m.gated == "full" and not quick)


def _verdict(m: Metric, value: float | None, before: float | None, quick: bool) -> Verdict:
    if not _looked_at(m, quick):
        return "not gated"
    if value is None:
        return "missing"
    if before is None:
        return "new"
    # A figure that is no number is no figure to be content with.
    if not math.isfinite(value) or m.worse(value, before) > 0:
        return "worse"
    return "better" if m.worse(before, value) > 0 else "as good"
