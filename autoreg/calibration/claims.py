"""What a camera file claims: a whole camera, or the parts of one that somebody published."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from autoreg.calibration.board import parse_pattern
from autoreg.camera import Camera
from autoreg.camera_files import read_camera, read_camera_record
from autoreg.errors import InputError
from autoreg.formats.camera_fields import number

_PARTS = (
    "width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3",
    "focal_px", "fx_fy_difference", "exif_focal_mm", "angle_of_view_deg", "mean_error_px",
)  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Claims:
    """What is claimed of a camera; None is what is not.

    Attributes:
        camera: the whole camera, if it is there.
        width: of the calibrated frame in pixels.
        height: likewise.
        fx: focal length along x in pixels.
        fy: along y.
        focal_px: one focal length for both.
        fx_fy_difference: |fx / fy - 1|, where the two themselves are not given.
        cx: principal point.
        cy: likewise.
        coefficients: distortion coefficients by name.
        std_devs: standard deviations by name.
        exif_focal_mm: the focal length in mm that the photos' EXIF gave.
        angle_of_view_deg: the angle of view that was used.
        mean_error_px: the mean over views of |residuals|_2 / N.
        corners: inner corners of the board, for the error's meaning.
        verdict: what the file says of itself, with its reasons.
        source: where the figures stand.
    """

    camera: Camera | None
    width: float | None
    height: float | None
    fx: float | None
    fy: float | None
    focal_px: float | None
    fx_fy_difference: float | None
    cx: float | None
    cy: float | None
    coefficients: Mapping[str, float]
    std_devs: Mapping[str, float]
    exif_focal_mm: float | None
    angle_of_view_deg: float | None
    mean_error_px: float | None
    corners: int | None
    verdict: tuple[str, tuple[str, ...]] | None
    source: str | None

    @property
    def focal(self) -> float | None:
        """The focal length along x, or the one for both, in pixels."""
        return self.fx or self.focal_px or self.fy


def read_claims(path: Path) -> Claims:
    """The claims of a camera file in any of the known formats, or of a JSON object with some of its parts.

    Raises:
        InputError: it is neither.
    """
    record = read_camera_record(path)
    whole = {"width", "height", "fx", "fy", "cx", "cy", "dist"} <= record.keys()
    if not whole and any(name in record for name in _PARTS):
        return _partial(path, record)
    camera = read_camera(path)
    std_devs, quality = record.get("std_devs"), record.get("quality")
    verdict = None
    mean_error, corners = None, None
    if isinstance(quality, dict) and isinstance(quality.get("verdict"), str):
        reasons = quality.get("reasons")
        verdict = (quality["verdict"], tuple(map(str, reasons)) if isinstance(reasons, list) else ())
        error = quality.get("mean_over_views_of_l2_over_n_px")
        mean_error = number("mean_over_views_of_l2_over_n_px", error) if error is not None else None
    return Claims(
        camera=camera,
        width=float(camera.width),
        height=float(camera.height),
        fx=camera.fx,
        fy=camera.fy,
        focal_px=None,
        fx_fy_difference=None,
        cx=camera.cx,
        cy=camera.cy,
        coefficients=dict(zip(_COEFFICIENTS, camera.dist, strict=True)),
        std_devs={str(k): number(f"std_devs.{k}", v) for k, v in std_devs.items()}
        if isinstance(std_devs, dict)
        else {},
        exif_focal_mm=None,
        angle_of_view_deg=None,
        mean_error_px=mean_error,
        corners=corners,
        verdict=verdict,
        source=None,
    )


def _partial(path: Path, record: Mapping[str, object]) -> Claims:
    try:
        parts = {
            name: number(f"key {name!r}", record[name]) for name in _PARTS if record.get(name) is not None
        }
    except InputError as error:
        raise InputError(f"camera file {path}: {error}") from error
    for name in ("width", "height", "fx", "fy", "focal_px", "exif_focal_mm", "angle_of_view_deg"):
        if parts.get(name, 1.0) <= 0:
            raise InputError(
                f"camera file {path}: key {name!r} must be positive, got {parts[name]:g}; correct it"
            )
    pattern, source = record.get("pattern"), record.get("source")
    size = parse_pattern(pattern) if isinstance(pattern, str) else None
    return Claims(
        camera=None,
        width=parts.get("width"),
        height=parts.get("height"),
        fx=parts.get("fx"),
        fy=parts.get("fy"),
        focal_px=parts.get("focal_px"),
        fx_fy_difference=parts.get("fx_fy_difference"),
        cx=parts.get("cx"),
        cy=parts.get("cy"),
        coefficients={name: parts[name] for name in _COEFFICIENTS if name in parts},
        std_devs={},
        exif_focal_mm=parts.get("exif_focal_mm"),
        angle_of_view_deg=parts.get("angle_of_view_deg"),
        mean_error_px=parts.get("mean_error_px"),
        corners=size[0] * size[1] if size else None,
        verdict=None,
        source=source if isinstance(source, str) else None,
    )
