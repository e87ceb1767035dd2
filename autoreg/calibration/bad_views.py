"""Views that the other views contradict: blurred, bent, or of another board; found, named and left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from autoreg.calibration.adjustment import Adjustment, adjust, fit_poses
from autoreg.calibration.models import GENERAL
from autoreg.calibration.observations import Data
from autoreg.calibration.unknowns import Freedom, State
from autoreg.spread import spread_about

# A view is bad if it is foretold this many times worse than the median view, and if that is also this many
# standard deviations of the spread among the views, on a logarithmic scale.
_LEAST_RATIO, _LEAST_SIGMAS = 1.5, 4.0
# If more than this part of the views is bad, nobody knows which part is right.
MOST_BAD = 1 / 3
_LEAST_VIEWS = 4
# A view that is off by more than this part of the board's size is no view of the board.
_NONSENSE = 0.05


@dataclass(frozen=True)
class BadView:
    """A view left out: how far its corners lie from where the other views put them, and what is usual."""

    name: str
    held_out_px: float
    usual_px: float

    @property
    def reason(self) -> str:
        """Why it was left out, in a sentence."""
        return (
            f"its corners are {self.held_out_px:.2f} px off where the other views foretell them, "
            f"which is {self.held_out_px / self.usual_px:.1f} times what is usual: blurred, moved, or bent"
        )


@dataclass(frozen=True)
class Sifted:
    """The views that agree, a state fitted to them, and those left out."""

    kept: tuple[int, ...]
    state: State
    bad: tuple[BadView, ...]


def sane_views(data: Data, state: State) -> Int[np.ndarray, " s"]:
    """Which views show the board at all, by a rough camera."""
    return np.flatnonzero(fit_poses(data, state).view_rms_px < _NONSENSE * data.sizes_px)


def held_out_rms(fit: Adjustment) -> Float[np.ndarray, " v"]:
    """Per view, the RMS of its corners under the intrinsics that the other views give, its pose its own.

    To first order: without view v, whose share of the normal equations is S_v and of the gradient g_v, the
    common unknowns move by d = (S - S_v)^-1 g_v, and its sum of squares becomes r² + 2 g_v d + d' S_v d.
    """
    total = fit.total
    squares = (fit.residuals_px**2).sum((1, 2))
    unit = 1 / np.sqrt(np.maximum(total.diagonal(), 1e-300))
    scaled = unit[:, None] * unit
    for k in range(fit.views):
        S, g = fit.information[k] * scaled, fit.gradients[k] * unit
        d = np.linalg.lstsq(total * scaled - S, g, rcond=1e-12)[0]
        squares[k] += max(0.0, float(2 * g @ d + d @ S @ d))
    return np.sqrt(squares / fit.present.sum(1))


def sift(
    data: Data, start: State, sound: Callable[[State], bool] = lambda state: True, *, shape: bool = False
) -> Sifted:
    """The views that agree with one another, the worst being left out one by one.

    Args:
        data: the corners of all views.
        start: first values.
        sound: whether a state is worth going on from.
        shape: whether to allow for a bent sheet, which bad views are hidden behind.
    """
    kept = np.arange(len(data))
    state, bad = start, list[BadView]()
    freedom = Freedom(GENERAL.free, shape)
    most = int(MOST_BAD * len(data)) + 1
    while True:
        fit = adjust(data.part(kept), replace(state, poses=state.poses[kept]), freedom)
        if sound(fit.state):
            poses = state.poses.copy()
            poses[kept] = fit.state.poses
            state = State(fit.state.intrinsics, poses, fit.state.shape)
        if len(kept) <= _LEAST_VIEWS or len(bad) >= most:
            break
        rms = held_out_rms(fit)
        worst = int(np.argmax(rms))
        others = np.delete(rms, worst)
        usual = float(np.median(others))
        sigma = max(
            spread_about(np.log(others / usual)), 1 / np.sqrt(2 * max(2 * fit.present[worst].sum() - 6, 1))
        )
        if rms[worst] < _LEAST_RATIO * usual or np.log(rms[worst] / usual) < _LEAST_SIGMAS * sigma:
            break
        bad.append(BadView(data.names[kept[worst]], float(rms[worst]), usual))
        kept = np.delete(kept, worst)
    return Sifted(tuple(int(k) for k in kept), state.part(kept), tuple(bad))
