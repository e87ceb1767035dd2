from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from autoreg.camera import Camera
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.joints.edges import fit_offsets, search_offsets, strip_misfits, strip_support
from autoreg.joints.profiles import STEP_PX, Profiles, sample_profiles
from autoreg.joints.strips import bell, edge
from autoreg.joints.widths import fit_widths
from autoreg.synthetic import look_at_ground

AT = np.arange(-20, 21) * STEP_PX
CAMERA = Camera.from_focal(401, 301, 200.0)
# Straight down from two metres: a metre is 100 px, +X to the right and +Y upwards.
DOWN = look_at_ground(pitch_deg=90.0, height_m=2.0)


def strip_values(
    offset: float, width: float, blur: float, *, near: float = 150.0, joint: float = 60.0, far: float = 150.0
) -> np.ndarray:
    s = AT - offset
    return near + (joint - near) * ndtr((s + width / 2) / blur) + (far - joint) * ndtr((s - width / 2) / blur)


def profiles_of(*values: np.ndarray) -> Profiles:
    n = len(values)
    normal = np.tile([0.0, 1.0], (n, 1))
    return Profiles(
        np.stack(values).astype(np.float32),
        AT,
        np.zeros((n, 2)),
        normal,
        np.full(n, 100.0),
        np.full(n, AT[-1]),
    )


def each(value: float, profiles: Profiles) -> np.ndarray:
    return np.full(len(profiles.values), value)


def stations_at(ground: np.ndarray, family: int, half_length: float = 0.1) -> Stations:
    n = len(ground)
    number = np.arange(n)
    return Stations(ground, np.full(n, half_length), np.full(n, family), number, number, number)


@given(
    # The search before it leaves half a pixel.
    st.floats(-0.75, 0.75),
    st.floats(1.0, 5.0),
    st.floats(0.6, 1.2),
    st.floats(20.0, 230.0),
    st.floats(-40.0, 40.0),
)
@settings(deadline=None, derandomize=True, max_examples=40)
def test_the_centre_of_a_strip_is_found_exactly(
    offset: float, width: float, blur: float, joint: float, step: float
):
    if abs(joint - 150.0 - step / 2) < 30.0:
        joint = 60.0
    profiles = profiles_of(strip_values(offset, width, blur, joint=joint, far=150.0 + step))
    found = fit_offsets(profiles, np.zeros(1), each(width, profiles), blur, iterations=12)
    assert found.offset_px[0] == pytest.approx(offset, abs=0.03)
    assert found.step[0] == pytest.approx(step, abs=3.0)
    assert found.strength[0] > 0.97


def test_a_blurred_edge_is_the_normal_distribution_at_any_distance_and_never_falls():
    x = np.linspace(-9.0, 9.0, 20_001, dtype=np.float32)
    assert np.abs(edge(x) - ndtr(x.astype(float))).max() < 2e-6
    assert (np.diff(edge(x)) >= 0).all()
    assert edge(np.array([-3e3, -40.0, 40.0, 3e3], np.float32)).tolist() == [0.0, 0.0, 1.0, 1.0]
    slope = np.gradient(edge(x).astype(float), x.astype(float))
    assert bell(x) / np.sqrt(2 * np.pi) == pytest.approx(slope, abs=2e-4)


@pytest.mark.parametrize("guess", [0.7, 1.4])
def test_a_wrong_width_does_not_move_the_centre_of_a_joint_between_like_slabs(guess: float):
    profiles = profiles_of(strip_values(0.6, 3.0, 0.9))
    first = fit_offsets(profiles, np.zeros(1), each(3.0 * guess, profiles), 0.9, iterations=12)
    assert first.offset_px[0] == pytest.approx(0.6, abs=0.03)
    # Its window was centred on the start; centred on the joint it sees both slabs alike.
    second = fit_offsets(profiles, first.offset_px, each(3.0 * guess, profiles), 0.9, iterations=12)
    assert second.offset_px[0] == pytest.approx(0.6, abs=0.002)


@given(
    st.floats(-0.75, 0.75),
    st.floats(2.5, 7.0),
    st.floats(0.6, 1.0),
    st.floats(0.7, 1.4),
    st.floats(-30.0, 30.0),
)
@settings(deadline=None, derandomize=True, max_examples=40)
def test_both_edges_of_a_joint_are_found_whatever_width_was_expected(
    offset: float, width: float, blur: float, guess: float, step: float
):
    profiles = profiles_of(strip_values(offset, width, blur, far=150.0 + step))
    found = fit_widths(profiles, np.zeros(1), each(width * guess, profiles), blur)
    assert found.middle_px[0] == pytest.approx(offset, abs=0.03)
    assert found.width_px[0] == pytest.approx(width, abs=0.06)


def test_a_joint_whose_far_edge_is_missing_is_narrower_and_nearer_by_half_of_that():
    whole, part = strip_values(0.0, 6.0, 0.7), strip_values(-1.2, 3.6, 0.7)
    found = fit_widths(profiles_of(whole, part), np.zeros(2), np.full(2, 5.0), 0.7)
    assert np.diff(found.width_px)[0] == pytest.approx(-2.4, abs=0.05)
    assert np.diff(found.middle_px)[0] == pytest.approx(-1.2, abs=0.05)


def test_the_stated_spread_of_edges_is_that_of_noise():
    rng = np.random.default_rng(4)
    # Neighbouring samples of a profile are a quarter of a pixel apart, and not independent.
    noise = gaussian_filter(rng.normal(0.0, 12.0, (400, len(AT))), (0.0, 0.6 / STEP_PX))
    profiles = profiles_of(*(strip_values(0.3, 5.0, 0.8) + noise))
    found = fit_widths(profiles, np.zeros(400), np.full(400, 5.0), 0.8)
    for value, sigma in ((found.middle_px, found.sigma_middle_px), (found.width_px, found.sigma_width_px)):
        assert np.std(value) == pytest.approx(np.median(sigma), rel=0.35)


def test_edges_of_a_flat_profile_are_told_to_be_unknown():
    found = fit_widths(profiles_of(np.full(len(AT), 120.0)), np.zeros(1), np.full(1, 4.0), 0.8)
    assert found.sigma_middle_px[0] > 5.0
    assert found.sigma_width_px[0] > 5.0


def test_dark_and_light_joints_differ_in_the_sign_of_their_depth():
    profiles = profiles_of(strip_values(0.2, 2.0, 0.8), strip_values(0.2, 2.0, 0.8, joint=230.0))
    found = fit_offsets(profiles, np.zeros(2), each(2.0, profiles), 0.8)
    assert found.depth[0] < -50.0
    assert found.depth[1] > 50.0


def test_a_flat_profile_is_no_joint_and_gives_no_nan():
    profiles = profiles_of(np.full(len(AT), 120.0), 120.0 + np.random.default_rng(0).normal(0, 2, len(AT)))
    found = fit_offsets(profiles, np.zeros(2), each(2.0, profiles), 0.9)
    assert np.isfinite(found.offset_px).all()
    assert np.isfinite(found.sigma_px).all()
    assert (found.sigma_px > 0.1).all()


@given(st.floats(-6.0, 6.0), st.floats(1.0, 4.0))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_a_search_comes_within_a_pixel_of_the_strip(offset: float, width: float):
    profiles = profiles_of(strip_values(offset, width, 0.9))
    found = search_offsets(profiles, each(width, profiles), 7.0, 7.0)
    assert found[0] == pytest.approx(offset, abs=0.75)


def test_of_two_equal_joints_the_search_takes_the_nearer():
    both = strip_values(-4.0, 1.5, 0.9) + strip_values(2.0, 1.5, 0.9) - 150.0
    profiles = profiles_of(both)
    assert search_offsets(profiles, each(1.5, profiles), 7.0, 3.0)[0] == pytest.approx(2.0, abs=0.5)


def test_a_start_beyond_a_profiles_end_gives_no_nan():
    profiles = profiles_of(strip_values(0.0, 2.0, 0.8), strip_values(0.0, 2.0, 0.8))
    beyond = np.array([1.5, -3.0]) * profiles.at_px[-1]
    fitted = fit_offsets(profiles, beyond, each(2.0, profiles), 0.8)
    assert np.isfinite(fitted.offset_px).all()
    misfit = strip_misfits(profiles, np.arange(2), beyond, each(2.0, profiles)[None], np.array([0.8]))
    assert np.isfinite(misfit).all()


@pytest.mark.parametrize(("family", "slope"), [(ALONG_X, (0.0, -1.0)), (ALONG_Y, (1.0, 0.0))])
def test_a_profile_runs_across_the_joint_towards_growing_ground_coordinates(
    family: int, slope: tuple[float, float]
):
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    picture = (0.3 * u + 0.2 * v).astype(np.float32)
    ground = np.array([[0.2, -0.3], [-0.5, 0.4]])
    profiles = sample_profiles(picture, CAMERA, DOWN, stations_at(ground, family), 6.0)
    centre = np.column_stack([200.0 + 100.0 * ground[:, 0], 150.0 - 100.0 * ground[:, 1]])
    assert profiles.centre_px == pytest.approx(centre)
    assert profiles.px_per_unit == pytest.approx([100.0, 100.0])
    assert profiles.normal == pytest.approx(np.tile(slope, (2, 1)))
    along_normal = 0.3 * slope[0] + 0.2 * slope[1]
    expected = centre @ [0.3, 0.2] + profiles.at_px[:, None] * along_normal
    assert pytest.approx(expected, abs=0.01) == profiles.values.T


@pytest.mark.parametrize("grain_px", [1.0, 1.5])
def test_the_stated_scatter_of_the_offsets_is_that_of_the_texture(grain_px: float):
    rng = np.random.default_rng(3)
    truth = 200.3
    columns = np.arange(CAMERA.width)
    clean = 150.0 - 70.0 * (ndtr((columns - truth + 1.2) / 0.8) - ndtr((columns - truth - 1.2) / 0.8))
    errors: list[np.ndarray] = []
    sigmas: list[np.ndarray] = []
    y = np.linspace(-1.2, 1.2, 40)
    stations = stations_at(np.column_stack([np.zeros(40), y]), ALONG_Y, half_length=0.025)
    for _ in range(8):
        grain = gaussian_filter(rng.normal(0, 1.0, (CAMERA.height, CAMERA.width)), grain_px)
        picture = (clean + 5.0 * grain / grain.std()).astype(np.float32)
        profiles = sample_profiles(picture, CAMERA, DOWN, stations, 10.0)
        # Bilinear sampling between pixels widens the lens's blur.
        found = fit_offsets(profiles, np.zeros(40), np.full(40, 2.4), 0.9)
        errors.append(found.offset_px - 0.3)
        sigmas.append(found.sigma_px)
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(len(error))
    assert 0.5 < error.std() / np.sqrt(np.mean(sigma**2)) < 1.5


def support(
    profiles: Profiles, polarity: int, width: float = 2.0, room: float = 8.0, *, paired: bool = False
) -> np.ndarray:
    kinds = np.full(len(profiles.values), polarity)
    return strip_support(
        profiles, each(width, profiles), 0.9, 1.0, each(room, profiles), kinds, paired=paired
    )


def test_support_is_high_for_a_joint_of_the_right_kind_alone():
    dark, light = strip_values(0.4, 2.0, 0.9), strip_values(0.4, 2.0, 0.9, joint=230.0)
    edge = strip_values(0.0, 0.001, 0.9, far=80.0)
    profiles = profiles_of(dark, light, edge)
    as_dark, as_light, as_any = (support(profiles, polarity) for polarity in (-1, 1, 0))
    assert as_dark[0] > 0.9
    assert as_dark[1] < 0.1
    assert as_light[1] > 0.9
    assert as_light[0] < 0.1
    # Tiles of two tones may meet without a joint, so a bare edge counts where joints are neither.
    assert as_any[2] > 0.9


def test_a_light_line_beside_a_dark_one_is_a_joint_where_these_are_looked_for():
    pair = strip_values(-1.0, 2.0, 0.9, joint=190.0) + strip_values(1.0, 2.0, 0.9, joint=110.0) - 150.0
    profiles = profiles_of(pair, strip_values(0.4, 2.0, 0.9))
    # No strip of one tone has it, and no step.
    assert support(profiles, 0)[0] < 0.8
    assert (support(profiles, 0, paired=True) > 0.9).all()
    # What is known to be dark is held against dark strips in either case.
    assert np.array_equal(support(profiles, -1, paired=True), support(profiles, -1))


def test_support_falls_when_the_joint_lies_elsewhere():
    profiles = profiles_of(strip_values(0.0, 2.0, 0.9), strip_values(4.0, 2.0, 0.9))
    here, elsewhere = support(profiles, -1)
    assert elsewhere < 0.3 * here


def test_a_neighbouring_joint_has_no_say_beyond_the_room():
    alone = strip_values(0.0, 2.0, 0.9)
    crowded = alone + strip_values(8.5, 1.0, 0.6, joint=-150.0) - 150.0
    near = support(profiles_of(alone, crowded), -1, room=4.0)
    assert near[1] == pytest.approx(near[0], abs=0.02)


@pytest.mark.parametrize("slope", [0.0, 4.0, -12.0])
def test_the_misfit_is_lowest_at_the_true_width_and_blur_in_any_light(slope: float):
    rng = np.random.default_rng(4)
    light = slope * AT
    values = [
        strip_values(o, 3.0, 1.0) + light + rng.normal(0, 1, len(AT)) for o in rng.uniform(-0.5, 0.5, 20)
    ]
    profiles = profiles_of(*values)
    offsets = fit_offsets(profiles, np.zeros(20), each(3.0, profiles), 1.0).offset_px
    rows = np.arange(20)
    widths = np.array([each(w, profiles) for w in (2.0, 3.0, 4.0)])
    blurs, shaded = np.array([0.6, 1.0, 1.6, 6.5]), slope != 0.0
    by_width = strip_misfits(profiles, rows, offsets, widths, np.full(3, 1.0), shaded=shaded)
    by_blur = strip_misfits(profiles, rows, offsets, widths[[1, 1, 1, 1]], blurs, shaded=shaded)
    assert np.argmin(by_width) == 1
    assert np.argmin(by_blur) == 1
