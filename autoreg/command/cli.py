"""The command line. Results go to files, `--json` to stdout, and everything for people to stderr."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from autoreg.command.calibration_commands import add_calibration_commands
from autoreg.command.cli_messages import hand_over, listener_on_stderr, tell, tell_check, tell_outcome
from autoreg.command.cli_render import (
    DemoOption,
    DofOption,
    EngineOption,
    LinesOption,
    OptionalValues,
    SceneOption,
    SunOption,
    TimeoutOption,
    parse_wish,
    path_named,
)
from autoreg.errors import INTERRUPTED, AutoregError, InputError
from autoreg.jobs.options import parse_crop, parse_height, parse_slab

if TYPE_CHECKING:
    from autoreg.jobs.job import Job

# What an interrupted command gives each of its threads to end what they import or compile.
PATIENCE_S = 8.0

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Align a camera to photographed paving, so that a computer-generated object can stand on it.",
)

_FolderOption = Annotated[
    Path | None,
    typer.Option("-o", "--output", parser=path_named("-o"), metavar="DIR", help="Folder of results."),
]


@app.command("align", cls=OptionalValues)
def align_command(
    photo: Annotated[
        Path,
        typer.Argument(
            parser=path_named("PHOTO"),
            metavar="PHOTO",
            help="The photo; put -- before a name that begins with -.",
        ),
    ],
    camera: Annotated[
        Path | None,
        typer.Option(
            parser=path_named("--camera"),
            metavar="FILE",
            help="Camera: own JSON, OpenCV or ROS YAML, COLMAP.",
        ),
    ] = None,
    crop: Annotated[
        str | None, typer.Option(metavar="X,Y,W,H", help="Part of the calibrated frame that the photo shows.")
    ] = None,
    slab: Annotated[
        str | None,
        typer.Option(metavar="AxB", help="Sides of a slab in metres, from joint to joint: 0.6x0.4."),
    ] = None,
    camera_height: Annotated[
        str | None, typer.Option(metavar="METRES", help="Camera's height above the ground: 1.55.")
    ] = None,
    ground: Annotated[
        bool, typer.Option("--ground", help="The paving is ground even where it may be a wall's.")
    ] = False,
    output: _FolderOption = None,
    render: Annotated[
        bool, typer.Option("--render", help="Also write render.png and composite.png.")
    ] = False,
    engine: EngineOption = None,
    scene: SceneOption = None,
    demo_object: DemoOption = False,
    sun: SunOption = None,
    lines: LinesOption = False,
    dof: DofOption = None,
    timeout: TimeoutOption = 1800.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print alignment.json on stdout.")] = False,
) -> None:
    """Align the camera of PHOTO to the paving in it.

    Writes alignment.json, overlay.png and scene.pov into DIR (by default the photo's name + .autoreg).
    Exit codes: 0 aligned, 2 bad input, 3 refused, 4 render failed.
    """
    with _exit_codes():
        if slab is not None and camera_height is not None:
            raise InputError("--slab and --camera-height both give the scale; give one of them")
        if crop is not None and camera is None:
            raise InputError(
                "--crop says how the photo was cut from the calibrated frame, so it needs --camera"
            )
        # Whoever says what the picture shall show wants to see it; the engine alone may be a leftover.
        render = render or demo_object or lines or any(o is not None for o in (scene, sun, dof))
        if engine is not None and not render:
            raise InputError("--engine chooses what renders, so it needs --render")
        wish = parse_wish(scene, demo_object, sun, lines, dof, timeout)
        from autoreg.jobs.job import Job

        job = Job(
            photo=photo,
            folder=output if output is not None else Path(f"{photo.name}.autoreg"),
            camera=camera,
            crop=None if crop is None else parse_crop(crop),
            slab=None if slab is None else parse_slab(slab),
            camera_height=None if camera_height is None else parse_height(camera_height),
            ground=ground,
            engine=(engine or "auto") if render else None,
            wish=wish,
        )
        _run(job, as_json=as_json)


@app.command("render", cls=OptionalValues)
def render_command(
    alignment: Annotated[
        Path,
        typer.Argument(
            parser=path_named("ALIGNMENT"),
            metavar="ALIGNMENT",
            help="The alignment.json of an aligned photo.",
        ),
    ],
    scene: SceneOption = None,
    demo_object: DemoOption = False,
    sun: SunOption = None,
    lines: LinesOption = False,
    dof: DofOption = None,
    engine: EngineOption = None,
    photo: Annotated[
        Path | None,
        typer.Option(
            parser=path_named("--photo"), metavar="FILE", help="The photo, if it is no longer where it was."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", parser=path_named("-o"), metavar="DIR", help="Folder, else ALIGNMENT's."
        ),
    ] = None,
    timeout: TimeoutOption = 1800.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print alignment.json on stdout.")] = False,
) -> None:
    """Put objects onto an aligned photo.

    Writes scene.pov, render.png and composite.png, and what the render says into alignment.json. Without
    --scene, demo objects stand there. Exit codes: 0 rendered, 2 bad input, 4 render failed.
    """
    with _exit_codes():
        wish = parse_wish(scene, demo_object, sun, lines, dof, timeout)
        from autoreg.jobs.render_job import RenderJob, run_render

        job = RenderJob(alignment, wish, engine or "auto", photo, output)
        with listener_on_stderr() as listener:
            outcome = run_render(job, listener.doing, listener.progress, listener.note)
        for path in outcome.written:
            tell(f"wrote {path}")
        tell_check(outcome.report)
        if outcome.error is not None:
            tell(f"error: the render failed: {outcome.error}")
        if as_json:
            from autoreg.jobs.report import report_text

            hand_over(report_text(outcome.report), outcome.written[-1].parent)
        if outcome.error is not None:
            raise typer.Exit(outcome.error.exit_code)


@app.command()
def demo(output: _FolderOption = None) -> None:
    """Align and render the picture that autoreg brings along.

    The results go to the folder autoreg-demo, unless -o names another one.
    """
    with _exit_codes():
        from autoreg.jobs.job import demo_job

        _run(demo_job(output or Path("autoreg-demo"), "auto"), as_json=False)


@app.command()
def doctor() -> None:
    """Say which parts are installed, and try the whole on a small picture; exit code 0 if it works."""
    with _exit_codes():
        from autoreg.command.doctor import examine

        if not examine(print):
            raise typer.Exit(1)


def _show_version(wanted: bool) -> bool:
    if wanted:
        import autoreg

        print(f"autoreg {autoreg.__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options that stand before the command."""


def main() -> None:
    """Run the command line; it ends the process with the contract's exit codes."""
    # A polite kill or a closed terminal ends a run as Ctrl-C does: other programs are stopped, and nothing is
    # half written. With nohup a closed terminal is ignored.
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    # Ctrl-C may come before a command has begun, and while its threads are waited for.
    try:
        try:
            app(prog_name="autoreg")
        except SystemExit as end:
            if end.code != INTERRUPTED:
                _joined_threads()
                raise
            _leave_interrupted()
    except KeyboardInterrupt:
        _leave_interrupted()


def _joined_threads(patience_s: float | None = None) -> bool:
    """Wait for other threads: what they import or compile must not be broken off by the interpreter's end.

    For each as long as that; whether all of them have ended.
    """
    others = [t for t in threading.enumerate() if t is not threading.current_thread() and not t.daemon]
    for thread in others:
        thread.join(patience_s)
    return not any(thread.is_alive() for thread in others)


def _leave_interrupted() -> NoReturn:
    """End an interrupted process, at once where a thread waits for ever for an import that was broken off."""
    if not _joined_threads(PATIENCE_S):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(INTERRUPTED)
    sys.exit(INTERRUPTED)


@contextmanager
def _exit_codes() -> Generator[None]:
    """Foreseen failures become a message on stderr and an exit code."""
    try:
        yield
    except AutoregError as error:
        tell(f"error: {error}")
        raise typer.Exit(error.exit_code) from None
    except OSError as error:
        # The disk is full, a folder vanished, a file may not be read: the system's words say it best.
        tell(f"error: {error}")
        raise typer.Exit(InputError.exit_code) from None
    except KeyboardInterrupt:
        tell("interrupted; every file that was written is whole")
        raise typer.Exit(INTERRUPTED) from None


add_calibration_commands(app, _exit_codes)


def _run(job: Job, *, as_json: bool) -> None:
    """Run a job, tell how it ended, and exit with its code."""
    from autoreg.jobs.job import run_job
    from autoreg.jobs.report import report_text

    with listener_on_stderr() as listener:
        outcome = run_job(job, listener)
    tell_outcome(outcome)
    if as_json:
        hand_over(report_text(outcome.report), job.folder)
    failure = outcome.refusal or outcome.render_error
    if failure is not None:
        raise typer.Exit(failure.exit_code)
