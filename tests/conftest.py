"""Photos and fits that several test modules look at; drawn and fitted once."""

from __future__ import annotations

from collections.abc import Generator

import pytest
import scipy.linalg  # noqa: F401  # brings a BLAS of its own
from paved import CHECKER, GRAVEL, HALF_BOND, STACK, fit_of
from threadpoolctl import threadpool_limits

from autoreg.fitting.fit import Fit
from autoreg.ground.rectify import Rectified, picture_gradient, rectify
from autoreg.synthetic import SyntheticPhoto, render_paving


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread_in_tests() -> Generator[None]:
    """BLAS on one thread, as `align` holds it: tests ask for the stages by themselves, several at a time."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="session")
def stack_photo() -> SyntheticPhoto:
    return render_paving(STACK)


@pytest.fixture(scope="session")
def half_photo() -> SyntheticPhoto:
    return render_paving(HALF_BOND)


@pytest.fixture(scope="session")
def checker_photo() -> SyntheticPhoto:
    return render_paving(CHECKER)


@pytest.fixture(scope="session")
def gravel_photo() -> SyntheticPhoto:
    return render_paving(GRAVEL)


@pytest.fixture(scope="session")
def stack_fit(stack_photo: SyntheticPhoto) -> Fit:
    return fit_of(stack_photo)


@pytest.fixture(scope="session")
def half_fit(half_photo: SyntheticPhoto) -> Fit:
    return fit_of(half_photo)


@pytest.fixture(scope="session")
def stack_rectified(stack_photo: SyntheticPhoto) -> Rectified:
    rectified = rectify(
        picture_gradient(stack_photo.pixels.mean(-1)), stack_photo.camera, stack_photo.cam_from_ground.R
    )
    assert rectified is not None
    return rectified
