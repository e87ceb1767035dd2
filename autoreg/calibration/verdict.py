"""Can the calibration be trusted? Every measure against its limits, in sentences, with what to photograph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from autoreg.calibration.coverage import Coverage
from autoreg.calibration.flatness import Flatness
from autoreg.calibration.precision import Precision
from autoreg.calibration.projection_map import HalvesDiffer, PictureMap
from autoreg.camera import Camera

Grade = Literal["good", "usable", "do not use"]
_TILT = "add views with the board tilted by 20° to 45°, about both axes"
GRADES: tuple[Grade, ...] = ("good", "usable", "do not use")


@dataclass(frozen=True)
class Finding:
    """One thing that keeps a calibration from being good: how bad, why, and what would mend it."""

    grade: Grade
    reason: str
    advice: str | None = None


@dataclass(frozen=True)
class Verdict:
    """The worst grade of all findings, and the findings, worst first."""

    grade: Grade
    findings: tuple[Finding, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why it is not good."""
        return tuple(finding.reason for finding in self.findings)

    @property
    def advice(self) -> tuple[str, ...]:
        """What to photograph, each once."""
        return tuple(dict.fromkeys(finding.advice for finding in self.findings if finding.advice))


@dataclass(frozen=True)
class Evidence:
    """What a verdict rests on."""

    camera: Camera
    precision: Precision
    coverage: Coverage
    flatness: Flatness
    uncertainty: PictureMap
    halves: HalvesDiffer | None
    rms_px: float
    views: int
    standpoints: int
    bad: int
    bent_focal_change: float | None
    rayless: float


@dataclass(frozen=True)
class Limits:
    """From where on a measure makes a calibration no longer good, and from where on it must not be used.

    Lengths in the picture are parts of its diagonal. A focal length off by 0.1 % turns a camera over paving
    by 0.016° and moves it by 0.13 % of its height; 0.3 % is what a phone's autofocus changes anyway.
    """

    focal: tuple[float, float] = (0.003, 0.02)
    centre: tuple[float, float] = (0.003, 0.02)
    uncertainty: tuple[float, float] = (0.001, 0.005)
    halves: tuple[float, float] = (0.002, 0.01)
    rms: tuple[float, float] = (0.0006, 0.003)
    bent_change: tuple[float, float] = (0.003, 0.03)
    bad_share: tuple[float, float] = (0.1, 1 / 3)
    dispersion: tuple[float, float] = (3.0, 10.0)
    aspect: tuple[float, float] = (0.01, 0.03)
    off_centre: tuple[float, float] = (0.06, 0.2)
    area: tuple[float, float] = (0.5, 0.1)
    views: tuple[int, int] = (8, 3)
    rayless: tuple[float, float] = (0.0, 0.05)
    excess: float = 2.0
    lean: float = 0.06
    tilt_deg: float = 15.0
    bare_zones: int = 2


def verdict_on(evidence: Evidence, limits: Limits | None = None) -> Verdict:
    """The verdict on a calibration."""
    limits = limits or Limits()
    found = [
        *_precise(evidence, limits),
        *_consistent(evidence, limits),
        *_covered(evidence, limits),
        *_plausible(evidence, limits),
    ]
    found.sort(key=lambda finding: -GRADES.index(finding.grade))
    return Verdict(found[0].grade if found else "good", tuple(found))


def _graded(value: float, limits: tuple[float, float]) -> Grade | None:
    """The grade of a measure that should be small; None if it is."""
    if not value > limits[0] and np.isfinite(value):
        return None
    return "usable" if value <= limits[1] else "do not use"


def _precise(e: Evidence, limits: Limits) -> list[Finding]:
    found: list[Finding] = []
    camera, sd = e.camera, e.precision.std_devs
    diagonal = float(np.hypot(camera.width, camera.height))
    tilted = f"{_TILT} and close enough to fill half the picture"
    edges = "add views with the board in the corners and along the edges of the picture"
    focal = max(sd[0] / camera.fx, sd[1] / camera.fy)
    if grade := _graded(focal, limits.focal):
        found.append(
            Finding(grade, f"the focal length is only known to ±{100 * focal:.2g} % (1 sigma)", tilted)
        )
    centre = max(sd[2], sd[3])
    if grade := _graded(centre / diagonal, limits.centre):
        found.append(
            Finding(grade, f"the principal point is only known to ±{centre:.1f} px (1 sigma)", tilted)
        )
    middle = e.uncertainty.median_px
    if grade := _graded(middle / diagonal, limits.uncertainty):
        found.append(
            Finding(
                grade, f"over half the picture, directions are uncertain by {middle:.2f} px or more", edges
            )
        )
    if e.halves is not None:
        apart, excess = e.halves.difference.median_px, e.halves.excess
        if grade := _graded(apart / diagonal, limits.halves):
            found.append(
                Finding(
                    grade,
                    f"two halves of the views, calibrated apart, differ by {apart:.2f} px in the median",
                )
            )
        elif excess > limits.excess and apart > 0.0003 * diagonal:
            found.append(
                Finding(
                    "usable",
                    f"two halves of the views differ {excess:.1f} times as much as the stated errors allow: "
                    "something other than noise moves the corners",
                )
            )
    return found


def _consistent(e: Evidence, limits: Limits) -> list[Finding]:
    found: list[Finding] = []
    diagonal = float(np.hypot(e.camera.width, e.camera.height))
    flat = e.flatness
    if flat.bent:
        change = abs(e.bent_focal_change or 0.0)
        grade = _graded(change, limits.bent_change) or "usable"
        moved = (
            ""
            if e.bent_focal_change is None
            else f"; allowing for it changes the focal length by {100 * e.bent_focal_change:+.2f} %"
        )
        found.append(
            Finding(
                grade,
                f"the sheet is bent: corners are off by {np.sqrt(flat.ratio):.1f} times as much along its "
                "normal as "
                f"across, which asks for heights of {100 * flat.height_squares:.1f} % of a square{moved}",
                "glue the sheet to glass or a flat plate and take the photos again, or estimate the "
                "sheet's shape "
                "(--sheet bent)",
            )
        )
    if grade := _graded(e.rms_px / diagonal, limits.rms):
        found.append(
            Finding(
                grade,
                f"corners are {e.rms_px:.2f} px RMS off their places, {e.rms_px / diagonal * 1e4:.1f} "
                "ten-thousandths of the diagonal: blur, a bent sheet, or a lens that the model does not "
                "describe",
                "hold camera and board still, in good light",
            )
        )
    share = e.bad / max(e.bad + e.views, 1)
    if grade := _graded(share, limits.bad_share):
        found.append(
            Finding(grade, f"{e.bad} of {e.bad + e.views} views contradict the others and were left out")
        )
    if grade := _graded(e.precision.dispersion, limits.dispersion):
        found.append(
            Finding(
                grade,
                f"the views scatter {e.precision.dispersion:.1f} times as much as their corners do: they "
                "share errors "
                "(a bent or badly measured sheet, autofocus or stabilisation that changes between photos, "
                "or photos of two cameras that are much alike)",
                "switch off autofocus and stabilisation, do not zoom, and give photos of one camera",
            )
        )
    return found


def _covered(e: Evidence, limits: Limits) -> list[Finding]:
    found: list[Finding] = []
    coverage = e.coverage
    if e.standpoints < limits.views[0]:
        grade: Grade = "usable" if e.standpoints >= limits.views[1] else "do not use"
        few = f"there are only {e.standpoints} views"
        if e.standpoints < e.views:
            few = f"the {e.views} views show the board in only {e.standpoints} different places"
        found.append(Finding(grade, few, "take 15 to 30 photos, the board each time elsewhere"))
    bare = coverage.bare_zones
    where = f"add views with the board at the {', '.join(bare)}" if bare else None
    if coverage.area < limits.area[0]:
        grade = "usable" if coverage.area >= limits.area[1] else "do not use"
        found.append(
            Finding(
                grade,
                f"boards covered only {100 * coverage.area:.0f} % of the picture",
                where or "add views with the board closer, and nearer to the edges",
            )
        )
    if len(bare) >= limits.bare_zones:
        found.append(
            Finding("usable", f"hardly any corner lies at the {', '.join(bare)} of the picture", where)
        )
    if coverage.tilts_deg.max() < limits.tilt_deg:
        found.append(
            Finding(
                "usable",
                f"no view is tilted by more than {coverage.tilts_deg.max():.0f}°",
                _TILT,
            )
        )
    elif coverage.lean < limits.lean:
        found.append(
            Finding(
                "usable",
                "all tilted views lean about the same axis",
                "add views with the board tilted about the other axis too",
            )
        )
    return found


def _plausible(e: Evidence, limits: Limits) -> list[Finding]:
    found: list[Finding] = []
    camera, sd = e.camera, e.precision.std_devs
    aspect = camera.fx / camera.fy - 1
    sure = abs(aspect) > 3 * float(np.hypot(sd[0], sd[1])) / camera.fx
    if sure and (grade := _graded(abs(aspect), limits.aspect)):
        found.append(
            Finding(
                grade,
                f"fx and fy differ by {100 * aspect:+.1f} %, but the pixels of cameras are square",
                "check that the squares of the print are square, and that no photo was stretched",
            )
        )
    off = max(
        abs(camera.cx - (camera.width - 1) / 2) / camera.width,
        abs(camera.cy - (camera.height - 1) / 2) / camera.height,
    )
    if grade := _graded(off, limits.off_centre):
        found.append(
            Finding(
                grade,
                f"the principal point lies {100 * off:.0f} % of the picture's side from its middle",
                "check that no photo was cropped or turned by software",
            )
        )
    if grade := _graded(e.rayless, limits.rayless):
        found.append(
            Finding(
                grade,
                f"the distortion folds back within the picture, of which {100 * e.rayless:.1f} % has no ray",
                "add views with the board in the corners of the picture",
            )
        )
    return found
