"""What a suite hands back: figures, tables, plots and sentences, and how they are kept as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.metrics import Figure, metric


@dataclass(frozen=True)
class Table:
    """Rows of words and numbers, for people."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Series:
    """One curve."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]


@dataclass(frozen=True)
class Plot:
    """Curves over one quantity; `goal` is drawn as a line across."""

    name: str
    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    goal: float | None = None
    log_x: bool = False
    log_y: bool = False


@dataclass(frozen=True)
class Picture:
    """A picture that a suite wrote into the folder of results, with what it shows."""

    file: str
    caption: str


@dataclass(frozen=True)
class Result:
    """What a suite found.

    Attributes:
        suite: its name.
        about: what was done, in a sentence or two.
        figures: numbers; each has its metric.
        tables: the same in detail.
        plots: curves.
        pictures: pictures.
        notes: what a reader has to know to judge the figures.
        skipped: why it did not run, or None.
        absent: whether that is because its data were never put into the folder they are looked for in.
        seconds: how long it took.
        command: the command that measures these figures again.
        quick: whether it was the short run.
        code: which code was measured, and when.
    """

    suite: str
    about: str = ""
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[Plot, ...] = ()
    pictures: tuple[Picture, ...] = ()
    notes: tuple[str, ...] = ()
    skipped: str | None = None
    absent: bool = False
    seconds: float = 0.0
    command: str = ""
    quick: bool = False
    code: str = ""

    def __post_init__(self) -> None:
        for figure in self.figures:
            if metric(figure.key).suite != self.suite:
                raise ValueError(f"{figure.key}: is not of the suite {self.suite}")

    def value(self, key: str) -> float | None:
        """The figure of a key, or None."""
        return next((figure.value for figure in self.figures if figure.key == key), None)


def to_json(results: Sequence[Result], machine: Sequence[tuple[str, str]]) -> str:
    """All results as a JSON text."""
    body = {"machine": dict(machine), "results": [asdict(result) for result in results]}
    return json.dumps(body, indent=1, ensure_ascii=False) + "\n"


def read_results(path: Path) -> tuple[Result, ...]:
    """The results of a file that `to_json` wrote; none if there is no such file."""
    if not path.is_file():
        return ()
    return tuple(_result(entry) for entry in json.loads(path.read_text())["results"])


def _result(entry: dict[str, Any]) -> Result:
    fields: dict[str, Any] = entry | {
        "figures": tuple(Figure(**f) for f in entry["figures"]),
        "tables": tuple(
            Table(t["title"], tuple(t["columns"]), tuple(tuple(row) for row in t["rows"]))
            for t in entry["tables"]
        ),
        "plots": tuple(_plot(p) for p in entry["plots"]),
        "pictures": tuple(Picture(**p) for p in entry["pictures"]),
        "notes": tuple(entry["notes"]),
    }
    return Result(**fields)


def _plot(entry: dict[str, Any]) -> Plot:
    series: dict[str, Any] = {"series": tuple(_series(s) for s in entry["series"])}
    return Plot(**(entry | series))


def _series(entry: dict[str, Any]) -> Series:
    return Series(entry["label"], tuple(entry["x"]), tuple(entry["y"]))
