"""Candidates for the orientation of the paved ground, from segments alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from autoreg.camera import Camera
from autoreg.ground.directions import (
    CUTOFF_SIGMAS,
    MIN_DEPRESSION,
    SegmentRays,
    agreement,
    camera_rays,
    segment_rays,
    single_directions,
    strongest_share,
)
from autoreg.ground.frames import (
    FrameFit,
    circle_across,
    fit_step,
    frames_of_pairs,
    frames_through,
    image_dirs,
    memberships,
)
from autoreg.ground.upright import possible_up, stands_plumb, upside_down
from autoreg.segments import Segments

# So many of another direction than the strongest one take part in any case.
OTHER_VOTERS = 150
# A plane seen more steeply than this may be a wall seen from the front as well.
WALL_LIKE_RAD = np.radians(65.0)
# What a candidate's support is worth by how far the camera would look down: less where it may be a wall.
PITCH_RAD = np.radians([60.0, 80.0])
PITCH_WORTH = np.array([1.0, 0.5])
# Two candidates whose directions both share this much of their segments (a cosine) are one.
REPETITION = 0.8
# Without a camera: long side / focal length spread about that of a 32 mm lens on 36 mm film.
LOG_FOCAL_PRIOR = (float(np.log(0.9)), 0.3)
# Joints of one family share errors (of laying, of the lens), so that this many segments tell as much of the
# focal length as one would alone; without it two nearly parallel families claim to know it.
SHARED_ERRORS = 5.0
FOCAL_GRID = np.exp(np.linspace(np.log(0.4), np.log(2.2), 9))


class Effort(NamedTuple):
    """How much is tried for candidates; a longer list asked for finds no more.

    Attributes:
        voters: the longest so many segments find the candidates; all of them score the survivors.
        seeds: so many of the longest segments, and of those in the lower part, propose directions.
        first: so many of these are first directions of candidates.
        peaks: so many second directions are looked at with each of them.
        started: candidates looked at for repetitions.
        fitted: ... and fitted.
    """

    voters: int = 350
    seeds: int = 80
    first: int = 24
    peaks: int = 5
    started: int = 192
    fitted: int = 60


USUAL = Effort()
# What finds joints that are few and short beside a crowd of others, as shadows of bars are.
THOROUGH = Effort(voters=5000, seeds=120, first=60, peaks=10, started=400, fitted=150)
# The focal length is looked for as well: most of the effort goes there.
NO_FOCAL = Effort(peaks=3)


@dataclass(frozen=True)
class GroundHypothesis:
    """One candidate for the ground's orientation.

    `R` is the rotation of cam_from_ground: its columns are the two paving directions and the up normal, in
    camera axes. +Y is the direction that points most away from the camera. `sigma_rad` is the standard
    deviation of the rotation about the camera's axes, for the segments' own noise. `support_px` is the length
    of the segments that agree, per direction; hypotheses are ranked by `score`. `sigma_log_focal` is the
    standard deviation of the logarithm of a focal length that was estimated with the frame: that of the
    prior (0.3) where the photo says nothing of it; None where the focal length was given.
    """

    R: Float[np.ndarray, "3 3"]
    sigma_rad: Float[np.ndarray, "3"]
    support_px: Float[np.ndarray, "2"]
    score: float
    sigma_log_focal: float | None = None


def ground_planes(
    segments: Segments, camera: Camera, *, max_hypotheses: int = 12, effort: Effort = USUAL
) -> tuple[GroundHypothesis, ...]:
    """Ranked candidates for the paved ground's two joint directions; empty where nothing supports any."""
    rays = camera_rays(segments, camera)
    found = _search(rays, np.array([0.0]), None, max_hypotheses, effort)
    return tuple(_hypothesis(found, k) for k in range(len(found.score)))


def ground_planes_unknown_focal(
    segments: Segments, width: int, height: int, *, max_hypotheses: int = 12
) -> tuple[tuple[GroundHypothesis, float], ...]:
    """Ranked (candidate, focal length in pixels); the principal point is taken at the picture's centre."""
    nominal_px = float(max(width, height))
    centre = 0.5 * (np.array([width, height]) - 1.0)
    rays = segment_rays(segments, (segments.ends_px - centre) / nominal_px, nominal_px)
    found = _search(rays, np.log(FOCAL_GRID), LOG_FOCAL_PRIOR, max_hypotheses, NO_FOCAL)
    focal_px = nominal_px * np.exp(found.fit.log_focal)
    scale = float(np.sqrt(SHARED_ERRORS))
    return tuple((_hypothesis(found, k, scale), float(focal_px[k])) for k in range(len(found.score)))


def shares_at_right_angles(
    segments: Segments, width: int, height: int, camera: Camera | None
) -> tuple[float, float]:
    """Shares of the segments' length along both directions of the likeliest ground, the larger one first.

    By a focal length of the photo's own where there is no camera; zero where nothing supports any ground.
    """
    if camera is not None:
        found = ground_planes(segments, camera, max_hypotheses=1)
    else:
        guessed = ground_planes_unknown_focal(segments, width, height, max_hypotheses=1)
        found = tuple(ground for ground, _ in guessed)
    if not found:
        return 0.0, 0.0
    rarer, larger = np.sort(found[0].support_px / segments.length_px.sum()).tolist()
    return larger, rarer


def grounds_along(
    segments: Segments, camera: Camera, *, least_share: float, step_rad: float
) -> Float[np.ndarray, "k 3 3"]:
    """Every so far turned ground along which the strongest direction runs, if it has such a share of edges.

    Columns are those of `GroundHypothesis.R`. For joints of one family, or a grain along them, beside which
    next to no edges tell how the ground is turned about them.
    """
    rays = camera_rays(segments, camera)
    if strongest_share(rays) < least_share:
        return np.zeros((0, 3, 3))
    strongest = single_directions(rays, _seeds(rays, USUAL.seeds), count=1, apart_rad=np.radians(2.0))
    angle = np.arange(0.0, np.pi, step_rad)
    first, second = circle_across(strongest)
    up = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    along = np.broadcast_to(strongest, up.shape)
    R = _canonical(np.stack([along, np.cross(up, along), up], 2))
    return R[_possible(R)]


@dataclass(frozen=True)
class _Found:
    fit: FrameFit
    support_px: Float[np.ndarray, "k 2"]
    score: Float[np.ndarray, " k"]


def _hypothesis(found: _Found, k: int, sigma_scale: float | None = None) -> GroundHypothesis:
    sigma = np.sqrt(np.maximum(np.diag(np.linalg.pinv(found.fit.information[k])), 0.0))
    return GroundHypothesis(
        found.fit.R[k],
        sigma[:3],
        found.support_px[k],
        float(found.score[k]),
        None if sigma_scale is None else float(sigma[3] * sigma_scale),
    )


def _search(
    rays: SegmentRays,
    log_focals: Float[np.ndarray, " g"],
    prior: tuple[float, float] | None,
    max_hypotheses: int,
    effort: Effort,
) -> _Found:
    """Fitted frames, best first. The prior is the mean and spread of the logarithm of the focal length."""
    voters = _voters(rays, effort.voters)
    seeds = _seeds(voters, effort.seeds) if len(voters) else np.zeros(0, int)
    first = single_directions(voters, seeds, count=effort.first, apart_rad=np.radians(2.0))
    fit = frames_through(voters, first, log_focals, peaks=effort.peaks, may_vote=_lies_on_ground)
    if prior is not None:
        fit = fit.joined(frames_of_pairs(first, (float(log_focals[0]), float(log_focals[-1]))))
    fit = FrameFit(_canonical(fit.R), fit.log_focal, fit.information)
    fit = fit.take(np.flatnonzero(_possible(fit.R)))
    member = _members(voters, fit)
    _, score = _score(voters, fit, member, prior)
    order = _both_kinds(fit.R, np.argsort(-score, kind="stable"), effort.started)
    order = order[_distinct_frames(member[order], voters.weight, 0.95)]
    fit = fit.take(_both_kinds(fit.R, order, effort.fitted))
    fit_prior = None if prior is None else (prior[0], prior[1] / np.sqrt(SHARED_ERRORS))
    for _ in range(5):
        allowed = _below_horizon(voters, fit)
        fit = fit_step(voters, fit, 2, allowed, log_focal_prior=fit_prior)
    fit = FrameFit(_canonical(fit.R), fit.log_focal, fit.information)
    fit = fit.take(np.flatnonzero(_possible(fit.R)))
    member = _members(rays, fit)
    support, score = _score(rays, fit, member, prior)
    order = np.argsort(-score, kind="stable")
    order = order[score[order] > 0]
    order = order[_distinct_frames(member[order], rays.weight, REPETITION)]
    order = _both_kinds(fit.R, order, max_hypotheses)
    return _Found(fit.take(order), support[order], score[order])


def _voters(rays: SegmentRays, count: int) -> SegmentRays:
    """The longest segments, and the longest of those that the strongest direction does not explain.

    Unbroken joints are long and many; beside them the short cross joints would have no say.
    """
    longest = np.arange(min(len(rays), count))
    if len(rays) <= count:
        return rays
    strongest = single_directions(rays.take(longest), longest[:40], count=1, apart_rad=np.radians(2.0))
    if not len(strongest):
        return rays.take(longest)
    others = np.flatnonzero(agreement(rays, strongest)[0] == 0.0)[:OTHER_VOTERS]
    return rays.take(np.union1d(longest, others))


def _seeds(rays: SegmentRays, count: int) -> np.ndarray:
    """The longest segments of the picture and the longest of its lower part, where the ground is."""
    lower = np.flatnonzero(rays.middle[:, 1] > np.median(rays.middle[:, 1]))
    return np.unique(np.concatenate([np.arange(min(len(rays), count)), lower[:count]]))


def _lies_on_ground(
    normal: Float[np.ndarray, "k n 3"], ends: Float[np.ndarray, "k n 2 3"]
) -> Bool[np.ndarray, "k n"]:
    """Whether segments lie below the horizon of a plane, one for each, that can be a ground."""
    up = np.where(upside_down(normal)[..., None], -normal, normal)
    height = np.einsum("knej,knj->kne", ends, up)
    return (np.maximum(height[..., 0], height[..., 1]) < -MIN_DEPRESSION) & possible_up(up)


def _possible(R: Float[np.ndarray, "k 3 3"]) -> Bool[np.ndarray, " k"]:
    return possible_up(R[:, :, 2]) & ~stands_plumb(R)


def _canonical(R: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 3 3"]:
    """The same frames turned by quarter turns until +Y points most away from the camera, Z to its side."""
    up = np.where(upside_down(R[:, :, 2])[:, None], -R[:, :, 2], R[:, :, 2])
    # Away is forward for a level camera and up in the picture for one that looks straight down.
    away = np.array([0.0, -1.0, 1.0])
    ways = np.stack([R[:, :, 0], R[:, :, 1], -R[:, :, 0], -R[:, :, 1]], 1)
    Y = ways[np.arange(len(R)), (ways @ away).argmax(1)]
    return np.stack([np.cross(Y, up), Y, up], 2)


def _below_horizon(rays: SegmentRays, fit: FrameFit) -> Bool[np.ndarray, "k n"]:
    """Segments that lie wholly on the ground's side of its horizon."""
    up = fit.R[:, :, 2].copy()
    up[:, :2] *= np.exp(-fit.log_focal)[:, None]
    return np.maximum(up @ rays.ends[:, 0].T, up @ rays.ends[:, 1].T) < -MIN_DEPRESSION


def _members(rays: SegmentRays, fit: FrameFit) -> Float[np.ndarray, "k 2 n"]:
    return memberships(rays, image_dirs(fit.R, fit.log_focal, 2), _below_horizon(rays, fit))


def _score(
    rays: SegmentRays,
    fit: FrameFit,
    member: Float[np.ndarray, "k 2 n"],
    prior: tuple[float, float] | None,
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
    """Supporting length per direction, and the score: what chance alone would support is taken off.

    A segment that supports one direction cannot support the other by chance: the grain of wooden boards would
    outweigh their short joints. A wall shares one direction with the ground, so the weaker of the two
    directions counts most.
    """
    below = _below_horizon(rays, fit)
    support = member @ rays.weight
    chance = np.minimum(1.0, (4 / (3 * np.pi)) * CUTOFF_SIGMAS * rays.sigma / rays.half_length)
    free = below[:, None] & (member[:, ::-1] == 0.0)
    excess = support - free @ (chance * rays.weight)
    low, high = excess.min(1), excess.max(1)
    score = np.where(low > 0, low + 0.1 * high, 0.1 * low)
    pitch = np.arcsin(np.clip(-fit.R[:, 2, 2], -1.0, 1.0))
    score = np.interp(pitch, PITCH_RAD, PITCH_WORTH) * score
    if prior is not None:
        mean, spread = prior
        score = score * np.exp(-0.5 * ((fit.log_focal - mean) / (2.5 * spread)) ** 2)
    return support, score


def _both_kinds(R: Float[np.ndarray, "k 3 3"], order: np.ndarray, count: int) -> np.ndarray:
    """The first `count` of an order, with room kept for planes seen steeply and for planes seen obliquely.

    Without it a wall seen from the front, which only the pixels can tell from a floor seen from above,
    would fill the list with its variants.
    """
    steep = -R[order, 2, 2] > np.sin(WALL_LIKE_RAD)
    rank = np.where(steep, np.cumsum(steep), np.cumsum(~steep))
    quota = max(count - count // 2, count - min(np.count_nonzero(steep), np.count_nonzero(~steep)))
    return order[rank <= quota][:count]


def _distinct_frames(
    member: Float[np.ndarray, "k 2 n"], weight: Float[np.ndarray, " n"], repetition: float
) -> np.ndarray:
    """Index of the frames that are no repetition of an earlier one: that rest on other segments.

    Two frames may differ by degrees (or in focal length, where the photo says little of it) and still
    explain the same segments; the angle between them says less than what they share.
    """
    share = np.sqrt(member * weight)
    share /= np.linalg.norm(share, axis=2, keepdims=True) + 1e-12
    x, y = share[:, 0], share[:, 1]
    alike = np.maximum(np.minimum(x @ x.T, y @ y.T), np.minimum(x @ y.T, y @ x.T))
    kept: list[int] = []
    free = np.ones(len(alike), bool)
    while free.any():
        first = int(np.argmax(free))
        kept.append(first)
        free &= alike[first] < repetition
        free[first] = False
    return np.array(kept, int)
