"""What it costs: ratios to decoding and one LSD pass, and of the command to a program that does only that."""

from __future__ import annotations

import compileall
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from autoreg.camera import Camera
from autoreg.synthetic import SyntheticScene, clean_grey, look_at_ground
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.processes import ROOT, Ran, run_timed
from benchmarks.result import Plot, Result, Series, Table
from benchmarks.speed_child import SLAB_M, STAGES

CHILD = ("-m", "benchmarks.speed_child")
STRIP_ROWS = 400
MANY, MANY_COMMANDS = 64, 6


@dataclass(frozen=True)
class Size:
    """A size of photo by its name in the metrics."""

    name: str
    width: int
    height: int

    @property
    def megapixels(self) -> float:
        """Its size."""
        return self.width * self.height / 1e6


SIZES = (Size("2mp", 1640, 1230), Size("13mp", 4240, 3180), Size("50mp", 8160, 6120))


def scene_of(size: Size, side_m: float = SLAB_M[0], seed: int = 1) -> SyntheticScene:
    """A terrace in plain light."""
    turn = 20.0 + 7.0 * seed % 50
    return SyntheticScene(
        camera=Camera.from_focal(size.width, size.height, 0.85 * size.width),
        cam_from_ground=look_at_ground(pitch_deg=36.0, height_m=1.6, heading_deg=turn, foot_m=(0.1, 0.2)),
        spacing_m=(side_m, side_m),
        colour=False,
        samples=2 if size.megapixels < 3 else 1,
        seed=seed,
    )


def write_photo(scene: SyntheticScene, folder: Path, name: str) -> Path:
    """The photo as a file, drawn in strips so that memory stays small; kept if it is there."""
    path, camera = folder / f"{name}.jpg", scene.camera
    numbers = {k: getattr(camera, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps({**numbers, "dist": []}))
    if path.is_file():
        return path
    rng = np.random.default_rng(scene.seed)
    strips: list[np.ndarray] = []
    for top in range(0, camera.height, STRIP_ROWS):
        rows = min(STRIP_ROWS, camera.height - top)
        part = Camera(camera.width, rows, camera.fx, camera.fy, camera.cx, camera.cy - top)
        grey = clean_grey(replace(scene, camera=part))
        grey += scene.noise_grey * rng.standard_normal(grey.shape)
        strips.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
    cv2.imwrite(str(path), np.concatenate(strips), [cv2.IMWRITE_JPEG_QUALITY, 92])
    return path


@dataclass(frozen=True)
class Times:
    """What was measured at one size."""

    size: Size
    seconds: dict[str, float]
    ended: str
    joints: int
    segments: int
    floor: Ran
    command: Ran
    cold: Ran | None

    @property
    def over_lsd(self) -> float:
        """Align over decoding and one LSD pass, in process."""
        return self.seconds["align"] / (self.seconds["decode"] + self.seconds["lsd"])


def measure(size: Size, options: Options, *, cold: bool) -> Times:
    """Everything at one size, in processes of its own."""
    folder = options.cache(f"speed-{size.name}")
    photo = write_photo(scene_of(size), folder, "terrace")
    repeats = 1 if options.quick else 3
    inside = run_timed([*CHILD, "align", str(photo), str(folder / "camera.json"), str(repeats)]).answer()
    floors = [run_timed([*CHILD, "floor", str(photo)]) for _ in range(repeats)]
    with tempfile.TemporaryDirectory() as place:
        words = ["-m", "autoreg", "align", str(photo), "--camera", str(folder / "camera.json")]
        words += ["--slab", f"{SLAB_M[0]}x{SLAB_M[1]}", "-o", f"{place}/out"]
        own_cache = {"XDG_CACHE_HOME": f"{place}/cache"}
        # The first run fills the cache of what was compiled.
        first = run_timed(words, own_cache)
        commands = [run_timed(words, own_cache) for _ in range(repeats)]
    return Times(
        size,
        inside["seconds"],
        inside["ended"],
        inside["joints"],
        inside["segments"],
        min(floors, key=lambda r: r.seconds),
        min(commands, key=lambda r: r.seconds),
        first if cold else None,
    )


def run(options: Options) -> Result:
    """Every size; in the short run 2 megapixels alone."""
    # As installers do: a command that compiled every module anew would be no user's.
    compileall.compile_dir(ROOT / "autoreg", quiet=2)
    sizes = SIZES[:1] if options.quick else SIZES
    times = [measure(size, options, cold=size is SIZES[0]) for size in sizes]
    figures: list[Figure] = [Figure("speed.align_s", times[0].seconds["align"])]
    for t in times:
        figures += [
            Figure(f"speed.align_{t.size.name}", t.over_lsd),
            Figure(f"speed.command_{t.size.name}", t.command.seconds / t.floor.seconds),
            Figure(f"speed.memory_{t.size.name}", t.command.peak_gb),
        ]
        if t.cold is not None:
            figures.append(Figure("speed.cold_2mp", t.cold.seconds / t.floor.seconds))
    tables = [_table(times)]
    notes = [
        "Seconds on the clock: on a machine that does other work too, believe the ratios, and those little."
    ]
    with tempfile.TemporaryDirectory() as cache:
        compile_s, fetch_s = (run_timed([*CHILD, "solver", cache]).answer()["seconds"] for _ in range(2))
    notes.append(
        f"The solver's step compiles in {compile_s:.2f} s, and comes from the cache in {fetch_s:.2f} s."
    )
    if not options.quick:
        ratios, said = _many(options)
        figures += [Figure("speed.many", ratios[0]), Figure("speed.beside", ratios[1])]
        notes.append(said)
        tables.append(_growth(options))
    plots = (_plot(times),) if len(times) > 1 else ()
    return Result(
        "speed",
        about=(
            "A drawn terrace as a JPEG. In process: `align` over decoding and one LSD pass of "
            "OpenCV's own settings. "
            "The command: a fresh process over a floor program that imports cv2 and jax, decodes, and "
            "runs that "
            "pass. The best of some repeats; peak memory is the process's largest resident set."
        ),
        figures=tuple(figures),
        tables=tuple(tables),
        plots=plots,
        notes=tuple(notes),
    )


def _table(times: list[Times]) -> Table:
    rows = tuple(
        (
            f"{t.size.megapixels:.1f}",
            t.ended,
            str(t.joints),
            f"{t.seconds['decode']:.2f}",
            f"{t.seconds['lsd']:.2f}",
            f"{t.seconds['align']:.2f}",
            *(f"{t.seconds.get(name, 0.0):.2f}" for name in STAGES),
            f"{t.floor.seconds:.2f}",
            f"{t.command.seconds:.2f}",
            "" if t.cold is None else f"{t.cold.seconds:.2f}",
            f"{t.command.processor_s / t.floor.processor_s:.2f}",
            f"{t.command.peak_gb:.2f}",
        )
        for t in times
    )
    stages = tuple(name.strip("_") for name in STAGES)
    columns = (
        "MP",
        "ended",
        "joints",
        "decode",
        "LSD",
        "align",
        *stages,
        "floor",
        "warm",
        "cold",
        "processor ratio",
        "GB",
    )
    return Table("Seconds by size of the photo", columns, rows)


def _plot(times: list[Times]) -> Plot:
    x = tuple(t.size.megapixels for t in times)
    series = (
        Series("decode + LSD", x, tuple(t.seconds["decode"] + t.seconds["lsd"] for t in times)),
        Series("align", x, tuple(t.seconds["align"] for t in times)),
        Series("floor program", x, tuple(t.floor.seconds for t in times)),
        Series("command, warm", x, tuple(t.command.seconds for t in times)),
    )
    return Plot("size", "Time by size of the photo", "megapixels", "seconds", series, log_x=True, log_y=True)


def _many(options: Options) -> tuple[tuple[float, float], str]:
    """How many times faster a photo is among many than by a command of its own.

    Among those of one process with two threads, and among those that `run_jobs` gives to two processes.
    """
    folder = options.cache("speed-many")
    for seed in range(MANY):
        write_photo(scene_of(SIZES[0], seed=seed + 1), folder, f"photo-{seed:02}")
    with tempfile.TemporaryDirectory() as place:
        own_cache = {"XDG_CACHE_HOME": f"{place}/cache"}
        words = ["--camera", str(folder / "camera.json"), "--slab", str(SLAB_M[0]), "-o", f"{place}/one"]
        photos = sorted(folder.glob("*.jpg"))[:MANY_COMMANDS]
        commands = [["-m", "autoreg", "align", str(photo), *words] for photo in photos]
        # The first run fills the cache of what was compiled, for all the others.
        run_timed(commands[0], own_cache)
        ways = [
            run_timed([*CHILD, way, str(folder), f"{place}/{way}"], own_cache) for way in ("many", "beside")
        ]
        alone = [run_timed(command, own_cache).seconds for command in commands]
    answers = [way.answer() for way in ways]
    threads, processes = (way.seconds / answer["photos"] for way, answer in zip(ways, answers, strict=True))
    command = float(np.mean(alone))
    by_threads, by_processes = (answer["aligned"] for answer in answers)
    said = (
        f"{MANY} photos in one process of two threads: {threads:.2f} s each ({by_threads} aligned); by "
        f"`run_jobs` in two processes {processes:.2f} s each ({by_processes} aligned); by commands one after "
        f"the other {command:.2f} s each, from {len(alone)} of them."
    )
    return (command / threads, command / processes), said


def _growth(options: Options) -> Table:
    """Time by the number of segments and joints, at 2 megapixels."""
    rows: list[tuple[str, ...]] = []
    for side in (0.8, 0.4, 0.2):
        folder = options.cache(f"speed-side-{side}")
        photo = write_photo(scene_of(SIZES[0], side_m=side), folder, "terrace")
        found = run_timed([*CHILD, "align", str(photo), str(folder / "camera.json"), "2"]).answer()
        seconds = found["seconds"]
        rows.append(
            (
                f"{side:g}",
                found["ended"],
                str(found["segments"]),
                str(found["joints"]),
                f"{seconds['lsd']:.2f}",
                f"{seconds['align']:.2f}",
                f"{seconds['align'] / (seconds['decode'] + seconds['lsd']):.2f}",
            )
        )
    columns = ("slab side, m", "ended", "segments", "joints", "LSD", "align", "ratio")
    return Table("Seconds by the number of joints, 2 MP", columns, tuple(rows))
