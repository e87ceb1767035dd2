"""The final render as a step of a run: a wish and an aligned photo in, a folder's pictures out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from autoreg.alignment import Alignment
from autoreg.errors import InputError, RenderError
from autoreg.formats.exif import read_exif
from autoreg.image import Photo, load_photo
from autoreg.jobs.alignment_file import SavedAlignment, aligned_photo, read_alignment, with_photo
from autoreg.jobs.outputs import (
    OVERLAY_NAME,
    REPORT_NAME,
    SCENE_NAME,
    as_paths,
    kept_apart,
    places_free,
    results_in,
    sealed,
    usable_folder,
    whole_run,
    write_png,
    write_whole,
)
from autoreg.jobs.report import RenderReport, Report, render_report, report_text
from autoreg.rendering.demo import demo_objects
from autoreg.rendering.depth_of_field import Focus, assert_moderate, blur_px
from autoreg.rendering.engine import Plan
from autoreg.rendering.objects import Scene
from autoreg.rendering.povray_engine import write_image
from autoreg.rendering.render import EngineName, choose_engine, plan_render, render
from autoreg.rendering.scene_file import read_scene
from autoreg.rendering.staging import Staging, can_be_staged, focused, stage
from autoreg.view import View

PICTURES = ("render.png", "composite.png")


@dataclass(frozen=True)
class Lens:
    """What depth of field needs; None is what the photo's EXIF says."""

    f_number: float | None = None
    focal_mm: float | None = None


@dataclass(frozen=True)
class Wish:
    """How the picture is to look.

    Attributes:
        scene: the scene's file; without one the demo objects stand there.
        demo: whether the demo objects stand there besides.
        sun_deg: azimuth from X towards Y and elevation of the sun, instead of the scene's.
        lines: whether lines are drawn on the joints, besides what the scene says.
        lens: depth of field; None is none.
        timeout_s: each pass of POV-Ray is stopped after this time.
    """

    scene: Path | None = None
    demo: bool = False
    sun_deg: tuple[float, float] | None = None
    lines: bool = False
    lens: Lens | None = None
    timeout_s: float = 1800.0

    def __post_init__(self) -> None:
        as_paths(self, "scene")


@dataclass(frozen=True)
class RenderJob:
    """What `autoreg render` was asked for; a photo of None is the one that was aligned."""

    alignment: Path
    wish: Wish
    engine: EngineName = "auto"
    photo: Path | None = None
    folder: Path | None = None

    def __post_init__(self) -> None:
        as_paths(self, "alignment", "photo", "folder")


@dataclass(frozen=True)
class RenderOutcome:
    """What was written, with the report; `error` says why there is no picture."""

    report: Report
    written: tuple[Path, ...]
    error: RenderError | None


def read_wish(wish: Wish) -> Scene:
    """The scene of a wish; read before anything else is done, so that a mistake in it costs no time.

    Raises:
        InputError: its file is wrong.
    """
    scene = Scene() if wish.scene is None else read_scene(wish.scene)
    if wish.sun_deg is not None:
        scene = replace(scene, light=replace(scene.light, sun_deg=wish.sun_deg, shadow=None))
    return replace(scene, joints=scene.joints or wish.lines)


def make_plan(
    wish: Wish, scene: Scene, alignment: Alignment, colour: UInt8[np.ndarray, "h w 3"], photo: Path
) -> Plan:
    """All that is to be drawn.

    Raises:
        InputError: an object cannot be where it is wanted, or depth of field lacks a number.
    """
    view = View(alignment.camera.camera, alignment.pose.cam_from_ground)
    if wish.demo or wish.scene is None:
        # Nobody chose their places: what does not fit into the picture is left out.
        demo = demo_objects(view, alignment.lattice)
        seen = (thing for thing in demo if can_be_staged(thing, view, alignment.lattice))
        scene = replace(scene, objects=(*scene.objects, *seen))
    staging = stage(scene, view, alignment.lattice, colour)
    if wish.lens is not None:
        staging = focused(staging, _focus(wish.lens, scene, staging, alignment, view, photo))
    return plan_render(alignment, staging, colour)


def write_scene(folder: Path, plan: Plan) -> list[Path]:
    """scene.pov and all that it names, written; the paths."""
    files = plan.files
    written = [write_png(folder / files.backdrop, plan.backdrop)]
    written += [write_whole(folder / name, text.encode()) for name, text in files.includes]
    for name, source in files.images:
        part = folder / f".{name}.{os.getpid()}.part.png"
        try:
            write_image(source, part)
            os.replace(part, folder / name)
        finally:
            part.unlink(missing_ok=True)
        written.append(folder / name)
    return [*written, write_whole(folder / SCENE_NAME, sealed(files.text))]


def write_report(folder: Path, report: Report) -> Path:
    """The path of alignment.json, written whole."""
    return write_whole(folder / REPORT_NAME, report_text(report).encode())


def render_into(
    folder: Path,
    plan: Plan,
    colour: UInt8[np.ndarray, "h w 3"],
    wish: Wish,
    engine_name: EngineName,
    tell: Callable[[str], None],
    progress: Callable[[float], None],
    note: Callable[[str], None],
) -> tuple[RenderReport, list[Path]]:
    """render.png and composite.png, written; what the report says of them, and their paths.

    Raises:
        RenderError: the engine failed, is missing, or its camera is not the photo's; then neither is written.
    """
    engine = choose_engine(engine_name, folder, timeout_s=wish.timeout_s, progress=progress)
    if engine.name == "preview":
        if engine_name == "auto":
            note(
                "POV-Ray is not installed, so the built-in preview renders; for soft shadows, reflections "
                "and materials install it (apt-get install povray, or brew install povray) and render again"
            )
        if wish.lens is not None:
            note("the preview has no depth of field; --dof needs POV-Ray")
    sun = plan.staging.sun
    if sun.sigma_deg is not None:
        note(
            f"the sun is estimated by the shadow: azimuth {sun.azimuth_deg:.1f}° ± {sun.sigma_deg[0]:.1f}°, "
            f"elevation {sun.elevation_deg:.1f}° ± {sun.sigma_deg[1]:.1f}°"
        )
    if engine.name == "povray" and (widest := _widest_blur_px(plan)) is not None:
        note(f"depth of field: points of the objects become discs up to {widest:.1f} px wide")
    tell(f"rendering with {engine.name}")
    made = render(engine, plan, colour)
    try:
        pictures = zip(PICTURES, (made.layer, made.composite), strict=True)
        written = [write_png(folder / name, picture) for name, picture in pictures]
    except BaseException:
        # One without the other would be no render.
        for name in PICTURES:
            (folder / name).unlink(missing_ok=True)
        raise
    return RenderReport(made.engine, PICTURES, made.check, plan.staging.sun), written


def run_render(
    job: RenderJob,
    tell: Callable[[str], None],
    progress: Callable[[float], None],
    note: Callable[[str], None],
) -> RenderOutcome:
    """The outcome of rendering an alignment anew.

    Nothing in the folder changes until all that is new is there. A failed render leaves the new scene without
    pictures, so that no folder shows one scene's text beside another's picture.

    Raises:
        InputError: the alignment, the photo or the scene cannot be used; nothing was written.
    """
    scene = read_wish(job.wish)
    saved = read_alignment(job.alignment)
    folder = usable_folder(job.folder or job.alignment.parent)
    tell("reading the photo")
    path, photo = _photo_of(job, saved)
    colour = photo.colour()
    outputs = results_in(folder)
    places_free(outputs)
    # The report alone is read and written.
    kept_apart((path, job.wish.scene), outputs[1:])
    if job.photo is not None:
        if saved.sha256 not in (None, photo.sha256):
            note(
                f"{path} is not, byte for byte, the photo that was aligned; what is drawn lies right only if "
                "the camera stood still"
            )
        saved = with_photo(saved, path, photo.sha256)
    plan = make_plan(job.wish, scene, saved.alignment, colour, path)
    same = folder.is_dir() and folder.samefile(job.alignment.parent)
    made, failure = None, None
    with whole_run(folder, note, staying=(OVERLAY_NAME,) if same else ()) as place:
        pictures: list[Path] = []
        try:
            made, pictures = render_into(place, plan, colour, job.wish, job.engine, tell, progress, note)
        except RenderError as error:
            failure = error
        report = saved.report | {"render": None if made is None else render_report(made)}
        written = [*write_scene(place, plan), *pictures, write_report(place, report)]
    return RenderOutcome(report, tuple(folder / path.name for path in written), failure)


def _photo_of(job: RenderJob, saved: SavedAlignment) -> tuple[Path, Photo]:
    """The photo that was given, or the one that was aligned, with its path."""
    path = job.photo or aligned_photo(job.alignment, saved)
    photo = load_photo(path)
    wanted = (saved.alignment.width, saved.alignment.height)
    if (photo.width, photo.height) != wanted:
        raise InputError(
            f"photo {path} has {photo.width} x {photo.height} pixels, but {wanted[0]} x {wanted[1]} were "
            "aligned; give the same photo with --photo"
        )
    return path, photo


def _focus(
    lens: Lens, scene: Scene, staging: Staging, alignment: Alignment, view: View, photo: Path
) -> Focus:
    """The opening of the lens, f/N, and what it is focused on."""
    if alignment.scale_source == "none":
        raise InputError("--dof needs the scale, because the lens has its size in mm; align with --slab")
    exif = read_exif(photo.read_bytes())
    f_number, focal_mm = lens.f_number or exif.f_number, lens.focal_mm or exif.focal_mm
    if f_number is None:
        raise InputError("the photo's EXIF holds no f-number; give it, as in --dof 2.8")
    if focal_mm is None:
        raise InputError("the photo's EXIF holds no focal length in mm; give it too, as in --dof 2.8,24")
    if scene.focus_m is not None:
        point = np.array([*scene.focus_m, 0.0])
    elif staging.solids:
        point = staging.solids[0].foot * [1.0, 1.0, 0.0]
    else:
        point = _middle_of_ground(view)
    if not view.cam_from_ground.apply(point)[2] > 0:
        raise InputError("focus lies behind the camera; choose a ground point in the picture")
    focus = Focus(focal_mm / 1000.0 / f_number, point)
    assert_moderate(view, focus, f"a lens of {focal_mm:g} mm at f/{f_number:g}")
    return focus


def _widest_blur_px(plan: Plan) -> float | None:
    """Width of the widest disc of blur on an object; None without depth of field or objects."""
    focus, solids = plan.staging.focus, plan.staging.solids
    if focus is None or not solids:
        return None
    return float(np.nanmax(blur_px(plan.view, focus, np.stack([solid.corners for solid in solids]))))


def _middle_of_ground(view: View) -> Float[np.ndarray, "3"]:
    c = view.camera
    ground = view.ground_under(np.array([[0.5 * c.width, part * c.height] for part in (0.6, 0.8, 0.95)]))
    seen = ground[np.isfinite(ground).all(1)]
    if not len(seen):
        raise InputError("no ground is in the middle of the picture to focus on; give focus in the scene")
    return np.array([*seen[0], 0.0])
