"""One run of the command: a photo's file in, a folder of results out."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib import import_module, resources
from numbers import Integral, Real
from pathlib import Path
from types import NoneType
from typing import Any, get_args

from autoreg.alignment import Alignment
from autoreg.errors import InputError, Refusal, RenderError
from autoreg.ground.sight import see
from autoreg.image import load_photo
from autoreg.jobs.outputs import (
    OVERLAY_NAME,
    REPORT_NAME,
    as_paths,
    kept_apart,
    places_free,
    results_in,
    usable_folder,
    whole_run,
    write_png,
)
from autoreg.jobs.overlay import overlay_picture
from autoreg.jobs.render_job import Wish, make_plan, read_wish, render_into, write_report, write_scene
from autoreg.jobs.report import Report, aligned_report, refused_report, render_report
from autoreg.jobs.told_camera import told_camera
from autoreg.rendering.objects import Scene
from autoreg.rendering.render import EngineName

# The picture that autoreg brings along, and the sides of the slabs in it.
DEMO_NAME, DEMO_SLAB_M = "terrace", (0.5, 0.5)
# Heights above the ground from which people and drones take photos, in metres.
_USUAL_M = (0.1, 100.0)
# ... and what is said of others, by what told the scale.
_WONDERED = {
    "slab": "slabs of this size put the camera {:.3g} metres above the ground; --slab is in metres, so check "
    "it: 60 cm by 40 cm are 0.6x0.4",
    "camera_height": "few photos are taken from {:.3g} metres above the ground; --camera-height is in "
    "metres, so check it: 165 cm are 1.65",
}


@dataclass(frozen=True)
class Listener:
    """Who is told about a run.

    Attributes:
        note: gets sentences that a person has to read.
        doing: gets the name of each step as it begins.
        progress: gets the part of a long step that is done, 0 to 1.
    """

    note: Callable[[str], None]
    doing: Callable[[str], None]
    progress: Callable[[float], None] = lambda part: None


@dataclass(frozen=True)
class Job:
    """What one run was asked for; files and folders may be given as text.

    Attributes:
        photo: the photo's file.
        folder: where the results go; made if missing.
        camera: the camera's file, if there is one.
        crop: x, y, w, h of the part of the calibrated frame that the photo shows.
        slab: the slab's two sides in metres, in either order.
        camera_height: the camera's height above the ground in metres.
        ground: whether what may be a wall's joints are taken for the ground's.
        engine: what renders, or None for no render.
        wish: what the scene shows, and how.
    """

    photo: Path
    folder: Path
    camera: Path | None = None
    crop: tuple[int, int, int, int] | None = None
    slab: tuple[float, float] | None = None
    camera_height: float | None = None
    ground: bool = False
    engine: EngineName | None = None
    wish: Wish = field(default_factory=Wish)

    def __post_init__(self) -> None:
        as_paths(self, "photo", "folder", "camera")


@dataclass(frozen=True)
class Outcome:
    """How a run ended; `alignment` is None if the photo was refused."""

    report: Report
    alignment: Alignment | None
    refusal: Refusal | None
    render_error: RenderError | None
    written: tuple[Path, ...]


def demo_job(folder: Path, engine: EngineName | None) -> Job:
    """The run on the picture that autoreg brings along."""
    data = Path(str(resources.files("autoreg").joinpath("data")))
    camera = data / f"{DEMO_NAME}.camera.json"
    return Job(data / f"{DEMO_NAME}.jpg", folder, camera, slab=DEMO_SLAB_M, engine=engine)


def run_job(job: Job, listener: Listener) -> Outcome:
    """The outcome of a run, whose results are then in the folder.

    Nothing is written before the photo is aligned or refused, and an earlier run's results stay until all new
    ones are there; the report is written again with what the render adds.

    Args:
        job: what to do.
        listener: is told what is being done.

    Raises:
        InputError: the photo, the camera or the folder cannot be used, or the job holds what no job can;
            nothing was written.
    """
    _assert_sound(job)
    usable_folder(job.folder)
    outputs = results_in(job.folder)
    places_free(outputs)
    kept_apart((job.photo, job.camera, job.wish.scene), outputs)
    scene = read_wish(job.wish)
    ended = threading.Event()
    # No daemon: a process that ends while XLA compiles in such a thread is aborted. The command waits for it.
    threading.Thread(target=_warm_up, args=(ended,)).start()
    try:
        return _aligned(job, scene, listener)
    finally:
        ended.set()


def _assert_sound(job: Any) -> None:
    """Raise unless a job's values are of their kinds, which a program can get wrong and no command.

    Raises:
        InputError: one is not.
    """
    wanted = (
        ("photo", isinstance(job.photo, Path), "a path"),
        ("folder", isinstance(job.folder, Path), "a path"),
        ("camera", isinstance(job.camera, (Path, NoneType)), "a path, or None"),
        ("crop", job.crop is None or _are_numbers(job.crop, 4, Integral), "four whole numbers, or None"),
        ("slab", job.slab is None or _are_numbers(job.slab, 2, Real), "two sides in metres, or None"),
        ("camera_height", isinstance(job.camera_height, (Real, NoneType)), "metres, or None"),
        ("ground", isinstance(job.ground, bool), "True or False"),
        ("engine", job.engine in (None, *get_args(EngineName)), "auto, povray, preview, or None"),
        ("wish", isinstance(job.wish, Wish), "a Wish"),
    )
    for name, good, kind in wanted:
        if not good:
            raise InputError(f"{name} of a job must be {kind}, got {getattr(job, name)!r}")


def _are_numbers(values: object, count: int, kind: type) -> bool:
    return isinstance(values, Sequence) and len(values) == count and all(isinstance(v, kind) for v in values)


def _aligned(job: Job, scene: Scene, listener: Listener) -> Outcome:
    listener.doing("reading the photo")
    photo = load_photo(job.photo)
    camera = None if job.camera is None else told_camera(job.camera, job.crop, photo, listener.note)
    if camera is None and photo.exif_focal_note is not None:
        listener.note(photo.exif_focal_note)
    listener.doing("aligning")
    with ThreadPoolExecutor(1) as beside:
        # Decoded and looked at while jax is imported and the solver fetched.
        decoded = beside.submit(photo.colour)
        sight = see(photo.gray)
        pipeline = import_module("autoreg.align")
        try:
            alignment: Alignment = pipeline.align_seen(
                sight,
                camera,
                slab=job.slab,
                camera_height=job.camera_height,
                ground=job.ground,
                exif_focal_px=photo.exif_focal_px,
                colour=decoded.result,
            )
        except Refusal as refusal:
            report = refused_report(job.photo, photo.width, photo.height, refusal, camera)
            with whole_run(job.folder, listener.note) as place:
                write_report(place, report)
            return Outcome(report, None, refusal, None, (job.folder / REPORT_NAME,))

        if unusual := _unusual_height(alignment):
            listener.note(unusual)
        listener.doing("drawing")
        colour = decoded.result()
        report = aligned_report(job.photo, alignment, None, sha256=photo.sha256)
        drawn = beside.submit(overlay_picture, alignment, colour)
        plan = make_plan(job.wish, scene, alignment, colour, job.photo)
        overlay = drawn.result()
        with whole_run(job.folder, listener.note) as place:
            staged = beside.submit(write_scene, place, plan)
            made = [write_png(place / OVERLAY_NAME, overlay), *staged.result(), write_report(place, report)]
        written = [job.folder / path.name for path in made]
    if job.engine is None:
        return Outcome(report, alignment, None, None, tuple(written))
    try:
        rendered, pictures = render_into(
            job.folder, plan, colour, job.wish, job.engine, listener.doing, listener.progress, listener.note
        )
    except RenderError as error:
        return Outcome(report, alignment, None, error, tuple(written))
    report = report | {"render": render_report(rendered)}
    write_report(job.folder, report)
    return Outcome(report, alignment, None, None, (*written, *pictures))


def _warm_up(ended: threading.Event) -> None:
    """Import the pipeline and compile its solver beside the reading of the photo, unless the run has ended.

    A command may keep what it compiled for the next one, which a library must not do behind its user's back.
    """
    # A photo that cannot be read is told of before this.
    if ended.wait(0.02):
        return
    solver = import_module("autoreg.solve.solver")
    if not ended.is_set():
        solver.warm_up(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "autoreg")


def _unusual_height(alignment: Alignment) -> str | None:
    """What to say where the lengths that were given put the camera where few photos are taken from."""
    height = float(alignment.pose.cam_from_ground.origin_in_a[2])
    said = _WONDERED.get(alignment.scale_source)
    return None if said is None or _USUAL_M[0] <= height <= _USUAL_M[1] else said.format(height)
