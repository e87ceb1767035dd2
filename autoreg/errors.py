"""The ways in which a run ends without an aligned pose, each with its exit code."""

from __future__ import annotations

from typing import Any

# How a command ends that was interrupted.
INTERRUPTED = 130


class AutoregError(Exception):
    """Base of every failure that autoreg foresees; the message holds cause, measured value and next step."""

    exit_code = 2


class InputError(AutoregError):
    """The input cannot be used: a missing file, a broken camera, a contradiction in the options."""

    exit_code = 2


class Refusal(AutoregError):
    """The photo does not carry the answer.

    Attributes:
        code: machine-readable reason (`no_lattice`, `one_direction`, `too_few_joints`, `ambiguous`,
            `not_ground`, ...).
        message: the sentence for people.
        measured: what was measured, in the unit that the message names, or None.
        limit: what it had to reach, in the same unit, or None.
    """

    exit_code = 3

    def __init__(
        self, code: str, message: str, *, measured: float | None = None, limit: float | None = None
    ) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.measured = measured
        self.limit = limit

    def __reduce__(self) -> tuple[Any, ...]:
        # By its message alone, as exceptions are pickled else, it could not be made again in another process.
        return type(self), (self.code, self.message), self.__dict__


class RenderError(AutoregError):
    """The picture could not be rendered, or the engine that was asked for is missing."""

    exit_code = 4
