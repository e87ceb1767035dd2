"""Options that several commands share: files and folders, and those of the final render."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperCommand

from autoreg.jobs.options import EXIF, parse_lens, parse_sun, parse_timeout

if TYPE_CHECKING:
    from autoreg.jobs.render_job import Wish

Engine = Literal["auto", "povray", "preview"]


def path_named(option: str) -> Callable[[str | Path], Path]:
    """What reads the path of an option, or its default; an empty one would be the working folder."""

    def read(text: str | Path) -> Path:
        if not str(text).strip():
            raise typer.BadParameter(f"{option} is empty; give a path (is a variable of the shell unset?)")
        return Path(text)

    return read


EngineOption = Annotated[
    Engine | None, typer.Option(help="What renders: auto is POV-Ray if installed, else the preview.")
]
SceneOption = Annotated[
    Path | None,
    typer.Option(
        parser=path_named("--scene"),
        metavar="FILE",
        help="What stands on the paving, in TOML (docs/rendering.md).",
    ),
]
DemoOption = Annotated[bool, typer.Option("--demo-object", help="Put demo objects onto the paving.")]
SunOption = Annotated[
    str | None,
    typer.Option(metavar="AZ,EL", help="Sun in degrees: azimuth from the ground's X towards Y, elevation."),
]
LinesOption = Annotated[bool, typer.Option("--lines", help="Draw lines on the joints.")]
DofOption = Annotated[
    str | None,
    typer.Option(metavar="[F[,MM]]", help="Depth of field: f-number and focal length, else by EXIF."),
]
TimeoutOption = Annotated[
    float, typer.Option(metavar="SECONDS", help="POV-Ray is stopped if one pass takes longer.")
]


# What begins like a number is the value of --dof; anything else is the next option, or a file.
_LENS = re.compile(r"[-+]?\.?\d.*|[fF]/\.?\d[\d.,]*")


class OptionalValues(TyperCommand):
    """A command whose --dof may stand without a value, which its parser does not know."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The arguments, --dof made complete."""
        return super().parse_args(ctx, [*_completed(args)])


def _completed(args: list[str]) -> list[str]:
    """The arguments with --dof and its value in one word: one with a sign would be taken for an option."""
    done: list[str] = []
    numbers = iter(range(len(args)))
    for n in numbers:
        word, following = args[n], args[n + 1] if n + 1 < len(args) else ""
        if word == "--":
            return [*done, *args[n:]]
        if word == "--dof":
            has_value = _LENS.fullmatch(following) is not None
            word = f"--dof={following if has_value else EXIF}"
            if has_value:
                next(numbers)
        done.append(word)
    return done


def parse_wish(
    scene: Path | None, demo: bool, sun: str | None, lines: bool, dof: str | None, timeout: float
) -> Wish:
    """What the options ask for.

    Raises:
        InputError: one of them is wrong.
    """
    sun_deg = None if sun is None else parse_sun(sun)
    numbers = None if dof is None else parse_lens(dof)
    timeout_s = parse_timeout(timeout)
    from autoreg.jobs.render_job import Lens, Wish

    return Wish(scene, demo, sun_deg, lines, None if numbers is None else Lens(*numbers), timeout_s)
