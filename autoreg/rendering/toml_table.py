"""Values out of a TOML file, with errors that name the key and the line."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from autoreg.errors import InputError

T = TypeVar("T")

# Beyond any scene, and small enough that no square of it overflows.
_LARGEST = 1e9


@dataclass(frozen=True)
class Table:
    """One table of a file.

    Attributes:
        content: its keys and values.
        name: what messages call the file.
        text: the whole file, in which messages find the line.
        header: the table's name; "" for the top of the file.
        number: which of the tables of this name it is, from 0.
        folder: where the files lie that it names.
    """

    content: dict[str, Any]
    name: str
    text: str
    header: str
    number: int
    folder: Path

    def error(self, key: str, words: str) -> InputError:
        """What is wrong with a key, with its line."""
        line = self._line(key)
        what = f"[[object]] {self.number + 1}" if self.header == "object" else f"[{self.header}]"
        inside = f" in {what}" if self.header else ""
        return InputError(f"{self.name} line {line}: {key}{inside} {words}")

    def known(self, keys: tuple[str, ...]) -> None:
        """Raise InputError for a key that has no meaning here."""
        for key in self.content:
            if key not in keys:
                near = difflib.get_close_matches(key, keys, 1)
                advice = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(keys)}"
                raise self.error(key, f"is not known; {advice}")

    def get(self, key: str, read: Callable[[Any], T], default: T) -> T:
        """The value of a key, or what stands for it."""
        return default if key not in self.content else self.need(key, read)

    def need(self, key: str, read: Callable[[Any], T]) -> T:
        """The value of a key, which must be there."""
        if key not in self.content:
            raise self.error(key, "is missing")
        try:
            return read(self.content[key])
        except ValueError as error:
            raise self.error(key, str(error)) from None

    def file(self, key: str) -> Path | None:
        """A file beside the scene."""
        if key not in self.content:
            return None
        path = self.folder / self.need(key, as_text)
        try:
            there = path.is_file()
        except (OSError, ValueError):
            # A name that no file can have.
            there = False
        if not there:
            raise self.error(key, f"names {path}, which does not exist or is no file")
        return path

    def _line(self, key: str) -> int:
        """The line of a key, or of the table that lacks it; TOML's parser does not tell them."""
        lines = self.text.splitlines()
        begin = 0
        if self.header:
            pattern = re.compile(rf"\s*\[{{1,2}}\s*[\"']?{self.header}[\"']?\s*\]{{1,2}}")
            headers = [n for n, line in enumerate(lines) if pattern.match(line)]
            begin = headers[min(self.number, len(headers) - 1)] if headers else 0
        for n in range(begin + bool(self.header), len(lines)):
            if self.header and re.match(r"\s*\[[\"'\w\[]", lines[n]) and "=" not in lines[n]:
                break
            if re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", lines[n]):
                return n + 1
        tables = [n for n, line in enumerate(lines) if re.match(rf"\s*\[{{1,2}}\s*{re.escape(key)}\b", line)]
        return tables[0] + 1 if not self.header and tables else begin + 1


def as_number(value: Any) -> float:
    """A finite number of a size that a scene can have."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value:
        raise ValueError(f"must be a number, got {value!r}")
    # Compared before it is made a float, which not every whole number can be.
    if abs(value) > _LARGEST:
        raise ValueError(f"must lie within {-_LARGEST:g} to {_LARGEST:g}")
    return float(value)


def as_text(value: Any) -> str:
    """A text that is not empty."""
    if not isinstance(value, str) or not value:
        raise ValueError(f"must be a text in quotes, got {value!r}")
    return value


def as_flag(value: Any) -> bool:
    """True or false."""
    if not isinstance(value, bool):
        raise ValueError(f"must be true or false, got {value!r}")
    return value


def as_table(value: Any) -> dict[str, Any]:
    """The content of a table."""
    if not isinstance(value, dict):
        raise ValueError("must be a table, such as [light]")
    return value


def as_tables(value: Any) -> list[dict[str, Any]]:
    """The contents of all tables of one name."""
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ValueError("must be written as [[object]], once for each")
    return value


def numbers(count: int) -> Callable[[Any], tuple[float, ...]]:
    """What reads so many numbers in brackets."""

    def read(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise ValueError(f"must be {count} numbers in brackets, got {value!r}")
        return tuple(as_number(part) for part in value)

    return read


def pair(value: Any) -> tuple[float, float]:
    """Two numbers in brackets."""
    x, y = numbers(2)(value)
    return x, y


def integers(count: int) -> Callable[[Any], tuple[int, ...]]:
    """What reads so many whole numbers in brackets."""

    def read(value: Any) -> tuple[int, ...]:
        parts = numbers(count)(value)
        if any(part != int(part) for part in parts):
            raise ValueError(f"must be {count} whole numbers in brackets, got {value!r}")
        return tuple(int(part) for part in parts)

    return read


def one_of(names: tuple[str, ...]) -> Callable[[Any], str]:
    """What reads one of these texts, and has a guess for any other."""

    def read(value: Any) -> str:
        if value not in names:
            near = difflib.get_close_matches(str(value), names, 1)
            advice = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(names)}"
            raise ValueError(f"{value!r} is not known; {advice}")
        return value

    return read
