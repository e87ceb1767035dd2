"""The commands about cameras: calibrate, inspect and board."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from autoreg.command.cli_messages import hand_over, tell
from autoreg.command.cli_render import path_named
from autoreg.errors import InputError, Refusal

if TYPE_CHECKING:
    from autoreg.calibration.inspection import Inspection
    from autoreg.calibration.photos import Progress
    from autoreg.calibration.result import Calibration

ExitCodes = Callable[[], AbstractContextManager[None]]

_Charuco = Annotated[
    bool, typer.Option("--charuco", help="The board has ArUco markers in its white squares.")
]
_Dictionary = Annotated[str, typer.Option(metavar="NAME", help="ArUco dictionary, such as 5X5_250.")]
_Marker = Annotated[float, typer.Option(metavar="PART", help="Side of a marker as a part of the square's.")]
_DEFAULT_DICTIONARY, _DEFAULT_MARKER = "5X5_250", 0.7


def add_calibration_commands(app: typer.Typer, exit_codes: ExitCodes) -> None:
    """Register the commands.

    Args:
        app: where.
        exit_codes: the context in which failures become messages and exit codes.
    """

    @app.command()
    def calibrate(  # pyright: ignore[reportUnusedFunction]
        photos: Annotated[
            list[str],
            typer.Argument(metavar="PHOTOS", help="Photos of the board: files, folders, 'boards/*.jpg'."),
        ],
        pattern: Annotated[
            str, typer.Option(metavar="CxR", help="Inner corners along a row x column: 9x6; or auto.")
        ] = "auto",
        square: Annotated[
            float | None,
            typer.Option(metavar="METRES", help="Side of a square; changes no result but the record."),
        ] = None,
        output: Annotated[
            Path,
            typer.Option("-o", "--output", parser=path_named("-o"), metavar="FILE", help="The camera file."),
        ] = Path("camera.json"),
        report: Annotated[
            Path | None,
            typer.Option(
                parser=path_named("--report"), metavar="DIR", help="Folder for a report with plots."
            ),
        ] = None,
        sheet: Annotated[
            Literal["flat", "bent"], typer.Option(help="bent: estimate the sheet's shape with the camera.")
        ] = "flat",
        charuco: _Charuco = False,
        dictionary: _Dictionary = _DEFAULT_DICTIONARY,
        marker: _Marker = _DEFAULT_MARKER,
        as_json: Annotated[bool, typer.Option("--json", help="Print the camera file on stdout.")] = False,
    ) -> None:
        """Calibrate a camera from PHOTOS of a chessboard, and say whether to trust it.

        Writes the camera as autoreg's JSON, and beside it as OpenCV's and ROS's YAML.
        Exit codes: 0 good or usable, 2 bad input, 3 do not use (or no camera at all).
        """
        with exit_codes():
            _calibrate(photos, pattern, square, output, report, sheet, charuco, dictionary, marker, as_json)

    @app.command()
    def inspect(  # pyright: ignore[reportUnusedFunction]
        camera: Annotated[
            Path,
            typer.Argument(
                parser=path_named("CAMERA"), metavar="CAMERA", help="A camera file in any known format."
            ),
        ],
        photo: Annotated[
            Path | None,
            typer.Option(
                parser=path_named("--photo"),
                metavar="FILE",
                help="A photo that the camera is said to have taken.",
            ),
        ] = None,
        as_json: Annotated[
            bool, typer.Option("--json", help="Print the findings as JSON on stdout.")
        ] = False,
    ) -> None:
        """Say what a CAMERA file claims and what is odd about it.

        Exit codes: 0 read, whatever was found, 2 bad input.
        """
        with exit_codes():
            from autoreg.calibration.claims import read_claims
            from autoreg.calibration.inspection import inspect_camera

            found = inspect_camera(read_claims(camera), photo)
            hand_over(_inspection_json(found) if as_json else _inspection_text(found))

    @app.command()
    def board(  # pyright: ignore[reportUnusedFunction]
        pattern: Annotated[
            str, typer.Option(metavar="CxR", help="Inner corners along a row x column.")
        ] = "9x6",
        square: Annotated[float, typer.Option(metavar="METRES", help="Side of a square.")] = 0.025,
        output: Annotated[
            Path | None,
            typer.Option(
                "-o", "--output", parser=path_named("-o"), metavar="FILE", help="A .pdf or .svg file."
            ),
        ] = None,
        charuco: _Charuco = False,
        dictionary: _Dictionary = _DEFAULT_DICTIONARY,
        marker: _Marker = _DEFAULT_MARKER,
    ) -> None:
        """Write a calibration board to print at true size, as PDF or SVG."""
        with exit_codes():
            _print_board(pattern, square, output, charuco, dictionary, marker)


def _calibrate(
    photos: list[str],
    pattern: str,
    square: float | None,
    output: Path,
    report: Path | None,
    sheet: Literal["flat", "bent"],
    charuco: bool,
    dictionary: str,
    marker: float,
    as_json: bool,
) -> None:
    import autoreg
    from autoreg.calibration.html_report import write_report
    from autoreg.calibration.pipeline import calibrate
    from autoreg.calibration.record import write_camera_files
    from autoreg.jobs.outputs import usable_folder

    if output.is_dir():
        raise InputError(
            f"{output} is a folder; give the camera file's name, such as -o {output}/camera.json"
        )
    usable_folder(output.parent)
    if output.is_file() and not _begins_as_json(output):
        raise InputError(
            f"{output} is there already and is no camera file of autoreg; give another name with -o, such as "
            "-o camera.json"
        )
    if report is not None:
        usable_folder(report)
    with _progress() as progress:
        found = calibrate(
            photos,
            pattern,
            square=square,
            charuco=charuco,
            dictionary=dictionary,
            marker=marker,
            sheet=sheet,
            progress=progress,
        )
    output.parent.mkdir(parents=True, exist_ok=True)
    written = list(write_camera_files(found, output, autoreg.__version__))
    if report is not None:
        written += write_report(found, report, autoreg.__version__)[:1]
    tell(summary(found))
    for path in written:
        tell(f"wrote {path}")
    if as_json:
        hand_over(output.read_text(encoding="utf-8"), output.parent)
    if found.verdict.grade == "do not use":
        raise typer.Exit(Refusal.exit_code)


def _begins_as_json(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(64).lstrip().startswith(b"{")


@contextmanager
def _progress() -> Generator[Progress | None]:
    """A bar if stderr is a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("looking for boards"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def summary(found: Calibration) -> str:
    """What a person wants to know of a calibration, in a few lines."""
    camera, sd = found.camera, found.precision.std_devs
    count = len(found.data)
    lines = [f"left out {out.name}: {out.reason}" for out in found.left_out]
    lines += [f"note: {note}" for note in found.notes]
    lines += [
        f"{count} views of a {found.board.pattern} board, {camera.width} x {camera.height} px, lens model "
        f"{found.model.name}",
        f"  fx {camera.fx:9.2f} ± {sd[0]:.2f}   cx {camera.cx:9.2f} ± {sd[2]:.2f}   (1 sigma, px)",
        f"  fy {camera.fy:9.2f} ± {sd[1]:.2f}   cy {camera.cy:9.2f} ± {sd[3]:.2f}",
        f"  OpenCV's RMS {found.rms_px:.3f} px; mean over views of |residuals|/N "
        f"{found.mean_l2_over_n_px:.4f}",
        f"  directions uncertain by {found.uncertainty.median_px:.2f} px in the median over the picture",
    ]
    if found.halves is not None:
        lines.append(
            f"  two halves of the views differ by {found.halves.difference.median_px:.2f} px in the median"
        )
    lines.append(f"verdict: {found.verdict.grade}")
    lines += [f"  - {reason}" for reason in found.verdict.reasons]
    if found.verdict.advice:
        lines += ["to do better:", *(f"  - {advice}" for advice in found.verdict.advice)]
    return "\n".join(lines)


def _inspection_text(found: Inspection) -> str:
    claims, focal = found.claims, found.focal
    lines = [f"source: {claims.source}"] if claims.source else []
    size = "unknown size" if claims.width is None else f"{claims.width:.0f} x {claims.height or 0:.0f} px"
    stated = {"fx": claims.fx, "fy": claims.fy, "f": claims.focal_px, "cx": claims.cx, "cy": claims.cy}
    shown = "  ".join(
        f"{name} {value:g}" + (f" ± {claims.std_devs[name]:.2g}" if name in claims.std_devs else "")
        for name, value in stated.items()
        if value is not None
    )
    lines.append(f"claims: {size}  {shown}")
    terms = {name: value for name, value in claims.coefficients.items() if value}
    if terms:
        lines.append("distortion: " + "  ".join(f"{name} {value:g}" for name, value in terms.items()))
    if focal is not None:
        across, down, diagonal = focal.angles_deg
        lines.append(f"focal length for {focal.width:.0f} x {focal.height:.0f}: {focal.px:.1f} px")
        lines.append(f"  = angles of view {across:.2f}° across, {down:.2f}° down, {diagonal:.2f}° diagonal")
        lines.append(f"  = {focal.equivalent_mm:.1f} mm in 35 mm equivalent (by the diagonal)")
        if focal.mm is not None and focal.sensor_mm is not None and focal.pixel_um is not None:
            lines.append(
                f"  = {focal.mm:g} mm on a sensor of {focal.sensor_mm[0]:.2f} x {focal.sensor_mm[1]:.2f} mm "
                f"(pixels of {focal.pixel_um:.2f} µm)"
            )
        else:
            lines.append("  in mm: unknown, since no EXIF says the focal length in mm")
    if found.exif_words is not None:
        lines.append(f"the photo's EXIF: {found.exif_words.removeprefix('EXIF: ')}")
    lines += [f"  {support.sentence}" for support in found.supports]
    lines += [f"{oddity.weight}: {oddity.text}" for oddity in found.oddities]
    if not any(oddity.weight != "note" for oddity in found.oddities):
        lines.append("nothing odd was found")
    return "\n".join(lines) + "\n"


def _inspection_json(found: Inspection) -> str:
    focal = found.focal
    content = {
        "contradictory": found.contradictory,
        "oddities": [{"weight": oddity.weight, "text": oddity.text} for oddity in found.oddities],
        "focal": None
        if focal is None
        else {
            "px": focal.px,
            "mm": focal.mm,
            "equivalent_35mm": focal.equivalent_mm,
            "angles_deg": dict(zip(("across", "down", "diagonal"), focal.angles_deg, strict=True)),
            "pixel_um": focal.pixel_um,
            "sensor_mm": focal.sensor_mm,
        },
        "exif": {"focal_px": found.exif_focal_px, "said": found.exif_words},
        "supports": [
            {"claimed": s.claimed, "exif": s.exif, "apart": s.apart, "word": s.word} for s in found.supports
        ],
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _print_board(
    pattern: str, square: float, output: Path | None, charuco: bool, dictionary: str, marker: float
) -> None:
    from autoreg.calibration.board import Board, parse_pattern
    from autoreg.calibration.printing import print_board, sheet_for
    from autoreg.jobs.outputs import usable_folder, write_whole

    size = parse_pattern(pattern)
    if size is None:
        raise InputError("--pattern auto counts corners in photos; to print, give the number, such as 9x6")
    kind = "charuco" if charuco else "chessboard"
    made = Board(*size, square, True, kind, dictionary, marker)
    path = output or Path(f"{kind}-{made.pattern}-{square * 1000:g}mm.pdf")
    suffix = path.suffix.lower()
    if suffix not in (".pdf", ".svg"):
        raise InputError(f"the board is written as .pdf or .svg, not {path.name!r}; choose one of these")
    usable_folder(path.parent)
    content = print_board(made, "pdf" if suffix == ".pdf" else "svg")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, content)
    sheet = sheet_for(made)
    tell(f"wrote {path}: {sheet.width_mm:.0f} x {sheet.height_mm:.0f} mm ({sheet.paper}); print it at 100 %")
