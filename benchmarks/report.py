"""The results for people: a table on the terminal, and Markdown with the plots and what is not good yet."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from importlib import metadata

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from benchmarks.gate import Judgement
from benchmarks.metrics import Metric
from benchmarks.plots import file_of
from benchmarks.result import Result, Table
from benchmarks.suites import NAMES

PACKAGES = ("autoreg", "numpy", "opencv-python-headless", "jax", "jaxopt", "scipy", "poselib")
MOST_DIGITS = 9
BAD = "bold red"
STYLES = {"worse": BAD, "missing": BAD, "not measured": BAD, "better": "green", "new": "yellow"}


def number(value: float | None) -> str:
    """A figure with as many digits as say something."""
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def measured(m: Metric, value: float | None) -> str:
    """A metric's figure, with as many digits besides as show on which side of the goal it lies."""
    text, digits = number(value), 3
    while value is not None and m.reached(float(text)) != m.reached(value) and digits < MOST_DIGITS:
        digits += 1
        text = f"{value:.{digits}g}"
    return text


def machine() -> tuple[tuple[str, str], ...]:
    """What the figures were taken on; the load says how far times can be believed."""
    versions: list[str] = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            versions.append(f"{name} is not installed")
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return (
        ("date", time.strftime("%Y-%m-%d")),
        ("processors", str(os.cpu_count())),
        ("load when the run began", load),
        ("system", f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"),
        ("packages", ", ".join(versions)),
    )


def print_report(results: Sequence[Result], judged: Sequence[Judgement], console: Console) -> None:
    """The tables of every suite, and each figure with goal, baseline and the command that repeats it."""
    for result in results:
        console.rule(Text(f"{result.suite}  ({result.seconds:.0f} s)"))
        if result.skipped is not None:
            console.print(Text(f"skipped: {result.skipped}"))
        for table in result.tables:
            console.print(_rich(table))
        mine = [j for j in judged if j.metric.suite == result.suite]
        if mine:
            console.print(_figures(mine))
        for note in result.notes:
            console.print(Text(f"- {note}"), soft_wrap=True)
        if result.skipped is None:
            console.print(Text(f"again: {result.command}", style="dim"), soft_wrap=True)


def _rich(table: Table) -> RichTable:
    made = RichTable(title=Text(table.title), title_justify="left", box=None, pad_edge=False)
    for n, column in enumerate(table.columns):
        made.add_column(Text(column), justify="right" if n else "left")
    for row in table.rows:
        made.add_row(*(Text(cell) for cell in row))
    return made


def _figures(judged: Sequence[Judgement]) -> RichTable:
    made = RichTable(title="figures", title_justify="left", pad_edge=False)
    for column in ("figure", "value", "unit", "goal", "reached", "baseline", "gate"):
        made.add_column(column, justify="right" if column in ("value", "baseline") else "left")
    for j in judged:
        m, verdict = j.metric, Text(j.verdict, style=STYLES.get(j.verdict, ""))
        made.add_row(
            Text(m.label),
            measured(m, j.value),
            m.unit,
            m.goal_text(),
            _reached(j),
            number(j.baseline),
            verdict,
        )
    return made


def _reached(j: Judgement) -> str:
    reached = None if j.value is None else j.metric.reached(j.value)
    return "" if reached is None else "yes" if reached else "NO"


def markdown(
    results: Sequence[Result],
    judged: Sequence[Judgement],
    machine: Sequence[tuple[str, str]],
    images: str = "images",
) -> str:
    """The report as Markdown, its plots in the folder `images`."""
    lines = [
        "# How good autoreg is",
        "",
        "Made by `python -m benchmarks --docs`; do not edit. Every figure has a metric in "
        "`benchmarks/metrics.py` with "
        "its goal and the gate's tolerance; `--gate` compares with `benchmarks/baseline.json`.",
        "",
    ]
    lines += how_they_ran(results)
    lines += ["## What is not good yet", "", *not_good_yet(results, judged), ""]
    for result in results:
        lines += _section(result, [j for j in judged if j.metric.suite == result.suite], images)
    lines += ["## Where", "", *(f"- {name}: {value}" for name, value in machine), ""]
    return "\n".join(lines)


def how_they_ran(results: Sequence[Result]) -> list[str]:
    """Which suites ran in full, which in the short form, and which with another number of seeds."""
    ran = [result for result in results if result.skipped is None]
    short = [r.suite for r in ran if r.quick]
    other = [r.suite for r in ran if not r.quick and "--seeds" in r.command]
    full = [r.suite for r in ran if r.suite not in (*short, *other)]
    said = (
        ("in full", full),
        ("with fewer or more seeds than the full run's, as the command beside each says", other),
        ("with `--quick`, few seeds and small pictures", short),
    )
    lines = [f"- Ran {how}: {', '.join(names)}." for how, names in said if names]
    away = [name for name in NAMES if name not in [result.suite for result in results]]
    return [*lines, *([f"- Not run: {', '.join(away)}."] if away else []), ""]


def not_good_yet(results: Sequence[Result], judged: Sequence[Judgement]) -> list[str]:
    """The goals that are missed and by how much, and what was not measured."""
    missed = [j for j in judged if j.value is not None and j.metric.reached(j.value) is False]
    lines = [
        f"- {j.metric.suite}: {_label(j.metric)} is {measured(j.metric, j.value)}{_unit(j.metric)}; "
        f"the goal is {j.metric.goal_text()}{_unit(j.metric)}."
        for j in missed
    ]
    lines += [f"- {r.suite} was not measured: {r.skipped}." for r in results if r.skipped is not None]
    with_goal = [j for j in judged if j.value is not None and j.metric.goal is not None]
    if not lines:
        return [f"All {len(with_goal)} goals are reached."]
    return [f"{len(missed)} of {len(with_goal)} goals are missed:", "", *lines]


def _label(m: Metric) -> str:
    return m.label.removeprefix("... ")


def _unit(m: Metric) -> str:
    return f" {m.unit}" if m.unit else ""


def _section(result: Result, judged: Sequence[Judgement], images: str) -> list[str]:
    lines = [f"## {result.suite}", ""]
    if result.about:
        lines += [result.about, ""]
    if result.skipped is not None:
        return [*lines, f"Skipped: {result.skipped}.", ""]
    rows = tuple(
        (j.metric.label, measured(j.metric, j.value) + _unit(j.metric), j.metric.goal_text(), _reached(j))
        for j in judged
        if j.value is not None
    )
    if rows:
        lines += _rows(("figure", "value", "goal", "reached"), rows)
    for table in result.tables:
        lines += [f"**{table.title}**", "", *_rows(table.columns, table.rows)]
    for plot in result.plots:
        lines += [f"![{plot.title}]({images}/{file_of(result, plot)})", ""]
    for picture in result.pictures:
        lines += [f"`{picture.file}` in the folder of results: {picture.caption}.", ""]
    lines += [f"- {note}" for note in result.notes]
    lines += [""] if result.notes else []
    code = f"; {result.code}" if result.code else ""
    return [*lines, f"`{result.command}` ({result.seconds:.0f} s{code})", ""]


def _rows(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    return [line(columns), "|" + "---|" * len(columns), *(line(row) for row in rows), ""]
