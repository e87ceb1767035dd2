"""OpenCV's lens distortion (k1 k2 p1 p2 k3 k4 k5 k6) and its inverse, in normalised coordinates."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

# tan(89.94°): no lens model of this kind is meant for rays further out than this.
_HORIZON = 1e3
# Points per block of the Newton solve: small enough that all its arrays stay in the processor's cache.
_BLOCK = 8192
_TABLE_NODES = 1024
_USUAL_STEPS = 5
_MAX_STEPS = 60


def distort(xy: Float[np.ndarray, "*n 2"], dist: tuple[float, ...]) -> Float[np.ndarray, "*n 2"]:
    """Distorted normalised coordinates of ideal ones (rational radial and tangential model)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = dist
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def first_fold(dist: tuple[float, ...]) -> float:
    """Smallest radius at which d(r_d)/dr or the denominator of the radial factor vanishes."""
    k1, k2, _, _, k3, k4, k5, k6 = dist
    # In u = r^2: r_d = r N/D, so d(r_d)/dr = (N D + 2 u (N' D - N D')) / D^2.
    N = np.polynomial.Polynomial([1.0, k1, k2, k3])
    D = np.polynomial.Polynomial([1.0, k4, k5, k6])
    u = np.polynomial.Polynomial([0.0, 1.0])
    slope = N * D + 2 * u * (N.deriv() * D - N * D.deriv())
    # Both begin with 1, so as polynomials in v = 1/u they lead with 1: their roots stay exact when the
    # higher coefficients nearly vanish, and the first fold is the largest root.
    v = np.concatenate([np.roots(slope.coef), np.roots(D.coef)])
    # A double root (the slope touches zero) comes out as a pair with a small imaginary part.
    real = np.real(v)[np.abs(np.imag(v)) <= 1e-6 * np.abs(v)]
    return float(1 / np.sqrt(max(real.max(initial=0.0), _HORIZON**-2)))


def undistort(
    target: Float[np.ndarray, "n 2"], dist: tuple[float, ...], valid_radius: float, tolerance: float
) -> Float[np.ndarray, "n 2"]:
    """Ideal coordinates whose distortion is `target`, to `tolerance`; NaN outside the valid field."""
    finite = np.isfinite(target)
    reach = math.sqrt(2) * float(np.abs(target).max(initial=0.0, where=finite))
    radii, radii_distorted = _radial_table(dist, valid_radius, reach)
    # Newton moves the radial answer by what the tangential part adds, at most 3 |p| r^2.
    beyond = radii_distorted[-1] + 3 * math.hypot(dist[2], dist[3]) * valid_radius**2
    result = np.empty_like(target)
    for start in range(0, len(target), _BLOCK):
        block = target[start : start + _BLOCK].T
        radius = np.hypot(block[0], block[1])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            shrink = np.where(radius > 0, np.interp(radius, radii_distorted, radii) / radius, 1.0)
            guess = np.where(radius <= beyond, block * shrink, np.nan)
            answer = _newton(guess, block, dist, valid_radius, tolerance)
        result[start : start + _BLOCK] = answer.T
    return result


def _radial_table(
    dist: tuple[float, ...], valid_radius: float, reach: float
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Radii and their distorted radii, both rising, up to `reach` or to the edge of the valid field."""
    radial_only = (*dist[:2], 0.0, 0.0, *dist[4:])

    def distorted(r: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        return distort(np.stack([r, np.zeros_like(r)], -1), radial_only)[:, 0]

    end = min(valid_radius, 1e-3)
    while end < valid_radius and distorted(np.array([end]))[0] < reach:
        end = min(2 * end, valid_radius)
    # The nodes crowd towards the end, where the inverse of a folding distortion is steep. At a pole the
    # last node would be infinite, so the table stops a hair short of the edge.
    radii = end * (1 - 1e-12) * np.sin(np.linspace(0, np.pi / 2, _TABLE_NODES))
    return radii, np.maximum.accumulate(distorted(radii))


def _newton(
    guess: Float[np.ndarray, "2 n"],
    target: Float[np.ndarray, "2 n"],
    dist: tuple[float, ...],
    valid_radius: float,
    tolerance: float,
) -> Float[np.ndarray, "2 n"]:
    """Roots of distort(x) = target near the guesses; NaN where none is found inside the valid field."""
    answer = np.full_like(guess, np.nan)
    todo = np.flatnonzero(np.isfinite(guess[0]))
    xy, goal = guess[:, todo], target[:, todo]
    for step_count in range(_MAX_STEPS):
        rx, ry, a, b, d = _residual_and_jacobian(xy, goal, dist)
        det = a * d - b * b
        step = np.stack([d * rx - b * ry, a * ry - b * rx]) / det
        done = np.maximum(np.abs(rx), np.abs(ry)) <= tolerance
        if step_count > _USUAL_STEPS:
            # Where the model is steep its own rounding exceeds the tolerance; there the step says when to
            # stop.
            done |= np.abs(step).max(0) <= 4 * np.finfo(float).eps * np.abs(xy).max(0)
        # The Jacobian is symmetric, so the distortion is one-to-one on every convex set where it is also
        # positive definite: roots outside that field belong to the fold.
        inside = (xy[0] ** 2 + xy[1] ** 2 <= valid_radius**2) & (det > 0) & (a + d > 0)
        good = done & inside
        answer[:, todo[good]] = xy[:, good]
        more = ~done
        if not more.any():
            break
        todo, goal = todo[more], goal[:, more]
        xy = _pulled_inside(xy[:, more], xy[:, more] - step[:, more], valid_radius)
    return answer


def _residual_and_jacobian(
    xy: Float[np.ndarray, "2 n"], goal: Float[np.ndarray, "2 n"], dist: tuple[float, ...]
) -> tuple[Float[np.ndarray, " n"], ...]:
    """distort(xy) - goal in x and y, and the Jacobian's entries xx, xy = yx, yy (it is symmetric)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = dist
    x, y = xy
    u = x * x + y * y
    D = 1 + u * (k4 + u * (k5 + u * k6))
    radial = (1 + u * (k1 + u * (k2 + u * k3))) / D
    slope = (k1 + u * (2 * k2 + u * 3 * k3) - radial * (k4 + u * (2 * k5 + u * 3 * k6))) / D
    rx = x * radial + 2 * p1 * x * y + p2 * (u + 2 * x * x) - goal[0]
    ry = y * radial + p1 * (u + 2 * y * y) + 2 * p2 * x * y - goal[1]
    a = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    b = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
    d = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    return rx, ry, a, b, d


def _pulled_inside(
    old: Float[np.ndarray, "2 n"], new: Float[np.ndarray, "2 n"], valid_radius: float
) -> Float[np.ndarray, "2 n"]:
    """The new points, those that left the valid field put back halfway between it and the old ones."""
    radius = np.hypot(new[0], new[1])
    outside = radius > valid_radius
    if outside.any():
        halfway = 0.5 * (np.hypot(old[0], old[1]) + valid_radius)
        new = np.where(outside, new * (halfway / radius), new)
    return new
