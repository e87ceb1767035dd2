from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from autoreg.alignment import Alignment, CameraReport, Pose, Residual
from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import on_ground, project_ground
from autoreg.lattice import Lattice
from autoreg.synthetic import SyntheticScene, clean_grey, look_at_ground, render_paving
from benchmarks import __main__ as command
from benchmarks import metrics
from benchmarks.bound import cramer_rao, crossing_jacobian
from benchmarks.gate import judge, read_baseline, write_baseline
from benchmarks.last_stage import crossings_error_px, crossings_of, moved, nudged, pose_error
from benchmarks.metrics import METRICS, Figure, Metric, metric
from benchmarks.options import Options
from benchmarks.peers import Edges, lsd_segments, match_edges, refine_with, solve_poselib, solve_scipy
from benchmarks.plots import draw_all
from benchmarks.processes import run_timed
from benchmarks.report import markdown, measured, print_report
from benchmarks.result import Plot, Result, Series, Table, read_results, to_json
from benchmarks.speed_child import STAGES
from benchmarks.suites import (
    NAMES,
    NOT_QUICK,
    UnknownSuite,
    chosen,
    real,
    robust,
    scenes,
    speed,
    vanishing,
    variants,
)
from benchmarks.suites.limit import scene as limit_scene
from benchmarks.suites.robust import within
from benchmarks.suites.thesis import minutes_by_hand
from benchmarks.suites.truth import covered
from benchmarks.suites.vanishing import area_under_recall, matched_errors_deg

LOWER = Metric("limit.ratio", "ratio", goal=1.3, relative=0.1)
HIGHER = Metric("vanishing.auc3", "area", better="higher", goal=0.7, relative=0.0, absolute=0.02)
INSIDE = Metric("truth.pose", "coverage", "%", "inside", (93.0, 97.0), 0.0, 1.0)
PLACE = (("date", "today"),)


def result(**change: object) -> Result:
    made = Result(
        "limit",
        about="What was done.",
        figures=(Figure("limit.ratio", 1.5), Figure("limit.lost", 0.0)),
        tables=(Table("A table", ("name", "value"), (("a | b", "1"),)),),
        plots=(Plot("curve", "A curve", "x", "y", (Series("s", (1.0, 2.0), (3.0, 4.0)),), goal=3.5),),
        notes=("A note.",),
        seconds=2.0,
        command="python -m benchmarks --only limit",
    )
    return replace(made, **change)  # type: ignore[arg-type]


def test_every_metric_belongs_to_a_suite_and_no_key_comes_twice():
    keys = [m.key for m in METRICS]
    assert len(set(keys)) == len(keys)
    assert {m.suite for m in METRICS} == set(NAMES)


def test_a_goal_is_reached_on_its_good_side():
    assert LOWER.reached(1.3)
    assert not LOWER.reached(1.31)
    assert HIGHER.reached(0.7)
    assert not HIGHER.reached(0.69)
    assert INSIDE.reached(93.0)
    assert not INSIDE.reached(99.0)
    assert Metric("real.aligned", "x").reached(1.0) is None


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({"key": "ratio"}, "suite.name"),
        ({"better": "inside"}, "two bounds"),
        ({"goal": (1.0, 2.0)}, "two bounds"),
        ({"relative": -0.1}, "negative"),
    ],
)
def test_a_metric_that_contradicts_itself_is_an_error(bad: dict[str, object], said: str):
    with pytest.raises(ValueError, match=said):
        replace(LOWER, **bad)  # type: ignore[arg-type]


@settings(deadline=None, derandomize=True)
@given(st.floats(0.1, 10.0), st.floats(0.0, 0.5), st.floats(0.0, 0.5))
def test_within_the_tolerance_nothing_is_worse(baseline: float, relative: float, absolute: float):
    m = Metric("limit.ratio", "x", relative=relative, absolute=absolute)
    allowed = relative * baseline + absolute
    assert m.worse(baseline + 0.999 * allowed, baseline) <= 0
    assert m.worse(baseline + 1.001 * allowed + 1e-9, baseline) > 0
    up = replace(m, better="higher")
    assert up.worse(baseline - 0.999 * allowed, baseline) <= 0
    assert up.worse(baseline - 1.001 * allowed - 1e-9, baseline) > 0


def test_leaving_the_bounds_is_worse_and_moving_within_them_is_not():
    assert INSIDE.worse(93.0, 97.0) <= 0
    assert INSIDE.worse(91.9, 95.0) > 0
    assert INSIDE.worse(98.1, 95.0) > 0
    assert INSIDE.worse(99.0, 99.5) <= 0


def verdicts(value: float | None, baseline: dict[str, float], quick: bool = False) -> dict[str, str]:
    figures = () if value is None else (Figure("limit.ratio", value),)
    return {j.metric.key: j.verdict for j in judge([result(figures=figures)], baseline, quick)}


def test_the_gate_decides_both_ways():
    base = {"limit.ratio": 1.5}
    assert verdicts(1.5, base) == {"limit.ratio": "as good"}
    assert verdicts(1.64, base) == {"limit.ratio": "as good"}
    assert verdicts(1.66, base) == {"limit.ratio": "worse"}
    assert verdicts(1.2, base) == {"limit.ratio": "better"}
    assert verdicts(math.nan, base) == {"limit.ratio": "worse"}
    assert verdicts(math.inf, base) == {"limit.ratio": "worse"}
    assert verdicts(1.5, {}) == {"limit.ratio": "new"}
    assert verdicts(None, base) == {"limit.ratio": "missing"}


def test_times_are_not_gated_in_a_short_run():
    figures = (Figure("refine.solve_ratio", 100.0),)
    run, base = Result("refine", figures=figures), {"refine.solve_ratio": 1.0}
    assert [j.verdict for j in judge([run], base, True)] == ["not gated"]
    assert [j.verdict for j in judge([run], base, False)] == ["worse"]


def test_a_skipped_suite_that_the_baseline_has_is_not_measured_and_shuts_the_gate():
    (j,) = judge([Result("limit", skipped="no pictures")], {"limit.ratio": 1.0}, False)
    assert j.verdict == "not measured"
    assert j.failed
    assert j.sentence() == "limit.ratio: not measured, the baseline has 1: no pictures"
    assert judge([Result("limit", skipped="no pictures")], {}, False) == ()


def test_data_that_were_never_there_are_told_and_leave_the_gate_open():
    (j,) = judge([Result("limit", skipped="no pictures", absent=True)], {"limit.ratio": 1.0}, False)
    assert j.verdict == "not measured"
    assert not j.failed


def test_a_folder_that_was_named_or_is_there_is_not_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    usual = Options(tmp_path)
    assert not replace(usual, photos=tmp_path / "misspelt").is_absent("photos")
    assert not real.run(replace(usual, photos=tmp_path / "misspelt")).absent
    monkeypatch.setattr(Path, "exists", lambda folder: folder != usual.photos)
    assert usual.is_absent("photos")
    assert not usual.is_absent("yorkurban")


def test_a_suite_reports_only_what_the_list_names():
    with pytest.raises(KeyError, match=r"metrics\.py"):
        Result("limit", figures=(Figure("limit.nonsense", 1.0),))
    with pytest.raises(ValueError, match="not of the suite"):
        Result("limit", figures=(Figure("truth.pose", 1.0),))


def test_the_baseline_keeps_what_did_not_run(tmp_path: Path):
    path = tmp_path / "baseline.json"
    truth = Result("truth", figures=(Figure("truth.pose", 95.0),))
    write_baseline(path, [truth, result()], quick=True)
    write_baseline(path, [result(figures=(Figure("limit.ratio", 1.2345678),))], quick=True)
    assert read_baseline(path, True) == {"limit.ratio": 1.23457, "truth.pose": 95.0}
    assert read_baseline(path, False) == {}
    write_baseline(path, [Result("truth", skipped="no data")], quick=True)
    assert "truth.pose" in read_baseline(path, True)


def test_the_committed_baseline_names_gated_metrics_only():
    for quick in (True, False):
        for key in read_baseline(command.BASELINE, quick):
            assert metric(key).gated == "always" or (metric(key).gated == "full" and not quick)


def test_results_come_back_from_their_file(tmp_path: Path):
    path = tmp_path / "results.json"
    path.write_text(to_json([result()], PLACE))
    assert read_results(path) == (result(),)
    assert read_results(tmp_path / "none.json") == ()


def test_the_report_says_what_is_missed_by_how_much_and_how_to_repeat_it():
    ran = [result(), Result("real", skipped="no photos in /nowhere")]
    text = markdown(ran, judge(ran, {"limit.ratio": 1.4}, False), PLACE)
    missed = text.split("## What is not good yet")[1].split("## limit")[0]
    assert "1.5; the goal is at most 1.3" in missed
    assert "real was not measured: no photos in /nowhere" in missed
    assert "limit.lost" not in missed
    assert "1 of 2 goals are missed" in missed
    assert "`python -m benchmarks --only limit` (2 s)" in text
    assert "images/bench-limit-curve.png" in text
    assert "a \\| b" in text


@pytest.mark.parametrize(
    ("value", "shown"), [(97.0, "97"), (97.04, "97.04"), (92.9996, "92.9996"), (95.123, "95.1"), (None, "")]
)
def test_a_figure_that_misses_its_goal_by_little_does_not_look_as_if_it_reached_it(value, shown):
    inside = Metric("truth.pose", "covered", "%", better="inside", goal=(93.0, 97.0))
    assert measured(inside, value) == shown


def test_the_report_says_so_where_every_goal_is_reached():
    ran = [result(figures=(Figure("limit.ratio", 1.1),))]
    assert "All 1 goals are reached." in markdown(ran, judge(ran, {}, False), PLACE)


def test_the_terminal_shows_figure_goal_and_verdict():
    console = Console(width=160, record=True, file=StringIO())
    ran = [result()]
    print_report(ran, judge(ran, {"limit.ratio": 1.0}, False), console)
    said = console.export_text()
    assert "worse" in said
    assert "at most 1.3" in said
    assert "NO" in said
    assert "again: python -m benchmarks --only limit" in said


def test_plots_become_files(tmp_path: Path):
    (path,) = draw_all([result()], tmp_path / "images")
    assert path.name == "bench-limit-curve.png"
    assert path.read_bytes().startswith(b"\x89PNG")


def test_an_unknown_suite_is_bad_usage_and_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert command.main(["--only", "limits", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "there is no suite 'limits'" in said
    assert "limit, truth" in said
    assert not (tmp_path / "out").exists()
    assert command.main(["--seeds", "1"]) == 2


def test_suites_are_chosen_by_name_and_by_length():
    assert chosen(["truth,limit"], quick=True) == ("limit", "truth")
    assert chosen([], quick=False) == NAMES
    assert not set(chosen([], quick=True)) & set(NOT_QUICK)
    assert chosen([NOT_QUICK[0]], quick=True) == (NOT_QUICK[0],)
    with pytest.raises(UnknownSuite):
        chosen(["limit", ""], quick=False)


@pytest.fixture
def stand_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The command with a suite that takes no time, and a baseline of its own."""

    def run_suite(name: str, options: Options) -> Result:
        return replace(result(), suite="limit") if name == "limit" else Result(name, skipped="not here")

    monkeypatch.setattr(command, "run_suite", run_suite)
    monkeypatch.setattr(command, "BASELINE", tmp_path / "baseline.json")
    monkeypatch.setattr(command, "DOCS", tmp_path / "docs")
    monkeypatch.setattr(command, "KEPT", tmp_path / "results.json")
    (tmp_path / "docs").mkdir()
    return tmp_path


def test_the_gate_shuts_with_exit_code_1_and_opens_with_0(stand_in: Path, capsys: pytest.CaptureFixture[str]):
    words = ["--only", "limit", "--out", str(stand_in / "out"), "--gate"]
    (stand_in / "baseline.json").write_text(json.dumps({"full": {"limit.ratio": 1.0}}))
    assert command.main(words) == 1
    assert "gate: limit.ratio: 1.5" in capsys.readouterr().err
    assert command.main([*words[:-1], "--update-baseline"]) == 0
    assert command.main(words) == 0


def test_suites_run_one_by_one_are_reported_together(stand_in: Path):
    out = str(stand_in / "out")
    assert command.main(["--only", "limit", "--out", out]) == 0
    assert command.main(["--only", "real", "--out", out, "--docs"]) == 0
    text = (stand_in / "docs" / "benchmarks.md").read_text()
    assert "## limit" in text
    assert "## real" in text
    assert (stand_in / "docs" / "images" / "bench-limit-curve.png").is_file()
    assert command.main(["--again", "--out", out]) == 0


def test_the_documentation_takes_the_full_run_where_there_is_one_and_says_which(stand_in: Path):
    out = stand_in / "out"
    out.mkdir()
    short = [
        replace(result(), quick=True),
        Result("truth", quick=True, figures=(Figure("truth.pose", 95.0),)),
    ]
    full = [result(figures=(Figure("limit.ratio", 1.25),)), Result("truth", skipped="no time")]
    (out / "results-quick.json").write_text(to_json(short, PLACE))
    (out / "results-full.json").write_text(to_json(full, PLACE))
    results, judged = command.documented(out)
    assert {r.suite: r.quick for r in results} == {"limit": False, "truth": True}
    assert [j.value for j in judged if j.metric.key == "limit.ratio"] == [1.25]
    text = markdown(results, judged, PLACE)
    assert "- Ran in full: limit." in text
    assert "- Ran with `--quick`, few seeds and small pictures: truth." in text
    assert "- Not run: refine, robust, vanishing, thesis, speed, scenes, boards, real, variants." in text


def test_the_documentation_keeps_full_results_so_that_suites_can_be_renewed_one_by_one(stand_in: Path):
    first, second = str(stand_in / "first"), str(stand_in / "second")
    page, kept = stand_in / "docs" / "benchmarks.md", stand_in / "results.json"
    assert command.main(["--only", "limit", "--out", first, "--docs"]) == 0
    assert [r.suite for r in command.read_results(kept)] == ["limit"]
    assert f"s; {command.measured_code()})" in page.read_text()
    # Another folder knows nothing of the first one; what was skipped or ran in short replaces nothing.
    assert command.main(["--only", "real", "--out", second, "--docs"]) == 0
    assert "1 of 2 goals are missed" in page.read_text()
    assert command.main(["--only", "limit", "--quick", "--out", second, "--docs"]) == 0
    (full,) = command.read_results(kept)
    assert (full.suite, full.quick) == ("limit", False)
    assert "--quick" not in page.read_text().split("## limit")[1].split("## real")[0]


def test_a_command_repeats_the_options_that_matter(tmp_path: Path):
    plain = Options(tmp_path)
    assert plain.command("limit") == "python -m benchmarks --only limit"
    changed = replace(plain, quick=True, seeds=5, photos=Path("/pictures"))
    assert changed.command("real") == "python -m benchmarks --only real --quick --seeds 5 --photos /pictures"


# What the suites are built of.

SMALL = limit_scene((160, 120))


@pytest.fixture(scope="module")
def printed() -> SyntheticScene:
    """Joints of some pixels, so that LSD sees both of their edges."""
    return replace(limit_scene((640, 480)), joint_width_m=0.02)


@pytest.fixture(scope="module")
def segments(printed: SyntheticScene) -> tuple[np.ndarray, np.ndarray]:
    return lsd_segments(render_paving(printed).pixels)


def test_a_motion_and_the_pose_error_are_each_other_s_inverse():
    motion = np.array([0.01, -0.02, 0.005, 0.03, 0.01, -0.02])
    pose = SMALL.cam_from_ground
    assert pose_error(moved(pose, motion), pose) == pytest.approx(motion, abs=1e-12)


def test_a_nudge_turns_and_moves_by_what_is_asked_for():
    pose = SMALL.cam_from_ground
    error = pose_error(nudged(pose, 0.5, 0.01, np.random.default_rng(1)), pose)
    assert np.rad2deg(np.linalg.norm(error[:3])) == pytest.approx(0.5)


def test_crossings_are_where_the_scene_says():
    scene = SyntheticScene(
        cam_from_ground=look_at_ground(pitch_deg=50.0, height_m=1.5), spacing_m=(0.5, 0.3), shift=0.5
    )
    ours = crossings_of(scene)
    theirs, _ = render_paving(replace(scene, samples=1)).crossings(margin_px=10.0)
    rounded = {tuple(p) for p in np.round(ours, 6)}
    near = np.linalg.norm(theirs - scene.cam_from_ground.origin_in_a[:2], axis=1) < 9.0
    assert {tuple(p) for p in np.round(theirs[near], 6)} == rounded
    assert crossings_error_px(scene.cam_from_ground, scene, ours) == 0.0


def test_the_crossings_derivative_is_that_of_the_projection():
    ground = crossings_of(SMALL)
    motion = 1e-5 * np.array([1.0, -2.0, 0.5, 1.0, 2.0, -1.0])
    J = crossing_jacobian(SMALL, ground)
    change = np.sqrt(np.mean(((J @ motion) ** 2).sum(1)))
    there = crossings_error_px(moved(SMALL.cam_from_ground, motion), SMALL, ground)
    assert there == pytest.approx(change, rel=1e-3)


def test_the_clean_picture_is_the_mean_of_noisy_ones():
    scene = replace(SMALL, noise_grey=4.0)
    photos = [render_paving(replace(scene, seed=seed)).pixels.astype(float) for seed in range(12)]
    off = np.mean(photos, axis=0) - clean_grey(scene)
    assert off.std() == pytest.approx(4.0 / np.sqrt(12), rel=0.1)
    assert abs(off.mean()) < 0.05


def test_the_bound_is_reached_by_one_gauss_newton_step_from_the_truth():
    """With the renderer as its model, an estimate from all pixels has the bound's own covariance."""
    scene, bound = SMALL, cramer_rao(SMALL)
    clean, true, h = clean_grey(scene), scene.cam_from_ground, 2e-5
    columns = [
        (
            clean_grey(replace(scene, cam_from_ground=moved(true, h * e)))
            - clean_grey(replace(scene, cam_from_ground=moved(true, -h * e)))
        ).ravel()
        / (2 * h)
        for e in np.eye(6)
    ]
    inverse = np.linalg.pinv(np.stack(columns, 1))
    rng = np.random.default_rng(5)
    steps = np.array([inverse @ (2.0 * rng.standard_normal(clean.size)) for _ in range(200)])
    ratio = steps.std(0) / bound.sigma(2.0)
    # The bound also counts width, tones and blur as unknown, so it is a little wider.
    assert (ratio < 1.15).all()
    assert (ratio > 0.7).all()


def test_the_bound_refuses_what_has_no_derivative():
    with pytest.raises(ValueError, match="one tone"):
        cramer_rao(replace(SMALL, texture=0.1))


@pytest.mark.parametrize("name", ["scipy", "poselib"])
def test_a_peer_finds_the_pose_from_segments_matched_by_contrast(
    name: str, printed: SyntheticScene, segments: tuple[np.ndarray, np.ndarray]
):
    if name == "poselib":
        pytest.importorskip("poselib")
    true = printed.cam_from_ground
    assert len(match_edges(*segments, printed, true, 2.0)) > 30
    start = nudged(true, 0.5, 0.01, np.random.default_rng(2))
    found = refine_with(solve_scipy if name == "scipy" else solve_poselib, segments, printed, start)
    assert found is not None
    assert crossings_error_px(found, printed, crossings_of(printed)) < 0.03


def test_segments_of_the_other_contrast_match_the_other_edge(
    printed: SyntheticScene, segments: tuple[np.ndarray, np.ndarray]
):
    ends, dark = segments
    assert len(match_edges(ends, dark, printed, printed.cam_from_ground, 1.0)) > 0.9 * len(ends)
    assert len(match_edges(ends, -dark, printed, printed.cam_from_ground, 1.0)) == 0


def test_coverage_is_that_of_a_chi_square():
    rng = np.random.default_rng(3)
    values = (rng.standard_normal((4000, 6)) ** 2).sum(1)
    assert covered(list(values), 6) == pytest.approx(95.0, abs=1.0)


def test_unknown_metrics_are_named():
    with pytest.raises(KeyError, match="every figure needs a metric"):
        metrics.metric("speed.nothing")


def edges_along_joints(noise_px: float) -> Edges:
    """A segment along each of some joints of the small scene, its ends off by noise."""
    rng = np.random.default_rng(8)
    first = crossings_of(SMALL)[:40]
    ground = np.stack([first, first + np.where(np.arange(40)[:, None] % 2, [0.3, 0.0], [0.0, 0.3])], 1)
    px = project_ground(SMALL.camera, SMALL.cam_from_ground, ground.reshape(-1, 2)).reshape(-1, 2, 2)
    return Edges(px + noise_px * rng.standard_normal(px.shape), ground)


def test_poselib_and_scipy_agree_where_the_noise_is_far_below_the_loss():
    """Beyond that they differ: SciPy's loss is of each end, PoseLib's of both ends of a segment together."""
    pytest.importorskip("poselib")
    start = nudged(SMALL.cam_from_ground, 0.2, 0.005, np.random.default_rng(4))
    for noise_px, most_px in ((0.0, 1e-4), (0.05, 3e-3)):
        edges = edges_along_joints(noise_px)
        a, b = (solve(edges, SMALL.camera, start) for solve in (solve_scipy, solve_poselib))
        ground = crossings_of(SMALL)
        assert crossings_error_px(a, replace(SMALL, cam_from_ground=b), ground) < most_px
        assert crossings_error_px(a, SMALL, ground) < noise_px + most_px


def test_a_peer_s_failures_are_counted_and_told(tmp_path: Path):
    case = vanishing.Case(tmp_path / "picture.jpg", SMALL.camera, np.eye(3))
    good = {"dirs": np.eye(3).tolist(), "seconds": 1.0, "error": None}
    bad = {"dirs": None, "seconds": 0.1, "error": "ValueError: no lines"}
    some = vanishing.lu_score([good, bad], (case, case), [1.0, 1.0])
    assert not isinstance(some, str)
    assert some.failures == ("ValueError: no lines",)
    assert some.area(3.0) == pytest.approx(0.5, abs=0.1)
    none = vanishing.lu_score([bad, bad], (case, case), [1.0, 1.0])
    assert none == "it failed on every picture, first by ValueError: no lines"


def test_a_peer_that_cannot_be_imported_is_no_peer_that_finds_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # This environment has no lu-vp-detect: the program must say so, not answer.
    monkeypatch.setattr(vanishing, "environment", lambda folder, packages: Path(sys.executable))
    case = vanishing.Case(tmp_path / "picture.jpg", SMALL.camera, np.eye(3))
    said = vanishing.lu((case,), [1.0], tmp_path)
    assert isinstance(said, str)
    assert "No module named 'lu_vp_detect'" in said


def test_the_area_under_the_recall_curve_is_that_of_its_steps():
    assert area_under_recall(np.zeros(10), 5.0) == pytest.approx(1.0)
    assert area_under_recall(np.full(10, 90.0), 5.0) < 0.01
    even = np.linspace(0.0, 10.0, 2001)
    assert area_under_recall(even, 10.0) == pytest.approx(0.5, abs=1e-3)


def test_directions_are_matched_whatever_their_order_and_signs():
    turn = np.deg2rad(2.0)
    true = np.eye(3)
    off = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1.0]])
    errors, ordered = matched_errors_deg(off[:, [2, 0, 1]] * [-1.0, 1.0, -1.0], true)
    assert errors == pytest.approx([2.0, 2.0, 0.0], abs=1e-9)
    assert ordered == pytest.approx(off, abs=1e-12)


def test_a_missing_database_is_skipped_with_a_word(tmp_path: Path):
    options = Options(
        tmp_path, yorkurban=tmp_path / "none", photos=tmp_path / "none", scenes=tmp_path / "none"
    )
    assert "--yorkurban" in (vanishing.run(options).skipped or "")
    assert "--photos" in (real.run(options).skipped or "")
    assert "--photos" in (variants.run(options).skipped or "")
    assert "--scenes" in (scenes.run(options).skipped or "")


@pytest.mark.parametrize(
    ("quarters", "shift"), [(0, 0.0), (1, 0.0), (3, 0.0), (0, 0.25), (2, 0.25), (2, 0.5)]
)
def test_a_true_scene_is_seen_from_the_frame_that_was_found(quarters: int, shift: float):
    camera = Camera.from_focal(320, 240, 280.0)
    scene = SyntheticScene(camera=camera, spacing_m=(0.6, 0.3), shift=shift, colour=False)
    true = scene.cam_from_ground
    angle = 0.5 * np.pi * quarters
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    # Two rows further, each moved by its shift; a frame turned by half has the rows below its lines.
    rows = 2 if quarters % 2 == 0 else 0
    along = 0.6 * (3 + (rows - (quarters == 2)) * shift)
    same = Rigid(true.R @ turn, true.t + true.R @ np.array([along, 0.3 * rows, 0.0]))
    spacing = (0.6, 0.3) if quarters % 2 == 0 else (0.3, 0.6)
    seen = scenes.seen_from(alignment(same, spacing), truth_of(scene))
    assert pose_error(seen.cam_from_ground, same) == pytest.approx(np.zeros(6), abs=1e-12)
    assert seen.spacing_m == spacing
    # From both frames the picture is the same.
    plain = [
        replace(scene, cam_from_ground=pose, spacing_m=sides, texture=0.0, tone_spread=0.0)
        for pose, sides in ((true, scene.spacing_m), (seen.cam_from_ground, seen.spacing_m))
    ]
    one, other = (clean_grey(drawn) for drawn in plain)
    assert np.abs(one - other).max() < 1e-6


def truth_of(scene: SyntheticScene) -> dict[str, Any]:
    """What is so, in the form of NAME.truth.json."""
    camera, pose = scene.camera, scene.cam_from_ground
    return {
        "name": "one", "lattice": scene.kind == "lattice", "size": [camera.width, camera.height],
        "K": camera.K.tolist(), "dist": list(camera.dist[:5]), "R": pose.R.tolist(), "t": pose.t.tolist(),
        "slab": list(scene.spacing_m), "bond": scene.shift, "tell_slab": True, "tell_camera": True,
        "wrong_k": False,
    }  # fmt: skip


def test_scenes_are_read_aligned_and_judged(tmp_path: Path):
    paving = SyntheticScene(
        camera=Camera.from_focal(480, 360, 420.0), spacing_m=(0.5, 0.5), colour=False, seed=1
    )
    told = replace(paving, camera=Camera.from_focal(480, 360, 420.0))
    for name, scene in (("one", paving), ("gravel", replace(paving, kind="gravel"))):
        camera = {key: getattr(told.camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), render_paving(scene).pixels)
        (tmp_path / f"{name}.camera.json").write_text(json.dumps({**camera, "dist": []}))
        (tmp_path / f"{name}.truth.json").write_text(json.dumps(truth_of(scene)))
    figures = {f.key: f.value for f in scenes.run(Options(tmp_path, scenes=tmp_path)).figures}
    assert (figures["scenes.right"], figures["scenes.wrong"], figures["scenes.refused"]) == (100, 0, 100)
    assert figures["scenes.turn"] < 0.02
    # With the truth a slab's tenth away the same answer is wrong.
    off = truth_of(paving)
    off["t"] = (np.array(off["t"]) + np.array(off["R"]) @ [0.05, 0.0, 0.0]).tolist()
    (tmp_path / "one.truth.json").write_text(json.dumps(off))
    assert scenes.examine(tmp_path / "one.truth.json").became != "right"


def test_a_pose_is_right_up_to_quarter_turns_and_whole_slabs():
    scene = SyntheticScene(spacing_m=(0.4, 0.4))
    pose = scene.cam_from_ground
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    same = Rigid(pose.R @ turn, pose.t + pose.R @ [0.8, -0.4, 0.0])
    assert within(alignment(same), scene)
    assert not within(alignment(Rigid(same.R, same.t + same.R @ [0.1, 0.0, 0.0])), scene)
    assert not within(alignment(moved(same, np.array([0.02, 0, 0, 0, 0, 0.0]))), scene)


def alignment(pose: Rigid, spacing: tuple[float, float] = (0.4, 0.4)) -> Alignment:
    camera = SyntheticScene().camera
    return Alignment(
        camera.width,
        camera.height,
        CameraReport(camera, "file", None, None, None),
        Pose(pose, np.eye(6)),
        "slab",
        Lattice("stack", *spacing, 0.0, 0.01, np.zeros((4, 2))),
        Residual(0.1, 0.1, 0.2, 10, 100, 1.0),
        (),
    )


def test_a_photo_is_judged_by_what_is_known_of_it():
    square = real.Expected(("stack",), 1.0)
    pose = SyntheticScene().cam_from_ground
    assert real.agrees(alignment(pose), square)
    assert not real.agrees(alignment(pose, (0.6, 0.4)), square)
    assert not real.agrees(alignment(pose), real.Expected(("running", "rows")))


def test_a_photo_s_residual_is_told_by_its_size():
    found = alignment(SyntheticScene().cam_from_ground)
    seen = real.Seen("a.jpg", True, found, "", 1.0, np.zeros((1, 1, 3), np.uint8))
    assert np.isclose(seen.rms_permille, 1e3 * 0.1 / np.hypot(found.width, found.height))
    assert replace(seen, alignment=None).rms_permille == 0.0


def test_an_answer_is_the_same_in_any_unit_and_of_no_multiple_of_the_slabs():
    pose = SyntheticScene().cam_from_ground
    base = alignment(pose, (0.6, 0.4))
    turned = alignment(Rigid(pose.R, 2.0 * pose.t), (0.8, 1.2))
    assert variants.same_ground(base, turned, 1e-9)
    assert not variants.same_ground(base, alignment(pose, (1.2, 0.4)), variants.PART_TOLERANCE)
    bond = replace(base, lattice=replace(base.lattice, kind="running", shift=0.5))
    assert not variants.same_ground(base, bond, variants.PART_TOLERANCE)
    rows = replace(base, lattice=replace(base.lattice, kind="rows", spacing_x=None, shift=None))
    assert variants.same_ground(base, rows, 1e-9)
    assert variants.same_ground(rows, alignment(pose, (0.4, 0.9)), 1e-9)
    assert not variants.same_ground(rows, alignment(pose, (0.9, 0.9)), variants.WHOLE_TOLERANCE)


def test_what_a_changed_photo_became_is_held_against_the_photo_as_it_is():
    mirrored = variants.VARIANTS[0]
    found = alignment(SyntheticScene().cam_from_ground)
    other = alignment(SyntheticScene().cam_from_ground, (2.0, 0.4))
    assert variants._became(found, None, mirrored, True) == "refused"
    assert variants._became(None, found, mirrored, True) == "stack?"
    assert variants._became(None, found, mirrored, False) == "CONTRADICTED"
    assert variants._became(found, other, mirrored, True) == "CONTRADICTED"
    assert variants._became(found, found, mirrored, True) == "stack"


def test_variants_of_a_photo_keep_its_kind_and_show_what_they_say():
    gray = np.arange(200, dtype=np.uint8).reshape(10, 20)
    made = {variant.name: variant.make(gray) for variant in variants.VARIANTS}
    assert all(picture.dtype == np.uint8 and picture.ndim == 2 for picture in made.values())
    assert (made["mirrored"][:, ::-1] == gray).all()
    assert (made["left 70 %"] == gray[:, :14]).all()
    assert (made["right 70 %"] == gray[:, 6:]).all()
    assert (made["lower 70 %"] == gray[3:]).all()
    assert made["0.6 times"].shape == (6, 12)
    assert made["1.5 times"].shape == (15, 30)
    assert (made["darker"] <= gray).all()


def test_spoilt_photos_are_spoilt_by_the_share_that_is_asked_for():
    photo = robust.take(robust.Axis("occlusion", "", (0.4,)), 0.4, 1, (160, 120))
    hidden = robust._covered(photo, 0.4, np.random.default_rng(1))
    assert 0.35 < (hidden.gray != photo.gray).mean() < 0.6
    terrace = robust._terrace(photo, 0.3, np.random.default_rng(1))
    # Some pixels of the gravel have the paving's grey level by chance.
    assert 0.65 < (terrace.gray != photo.gray).mean() <= 0.7
    wrong = robust._wrong_camera(photo, 10.0, np.random.default_rng(1))
    assert abs(wrong.told.fx / photo.told.fx - 1) == pytest.approx(0.1)


def test_minutes_by_hand_grow_with_the_lines():
    assert minutes_by_hand(30, together=False) == 10 * minutes_by_hand(3, together=False)
    assert minutes_by_hand(30, together=True) == minutes_by_hand(3, together=True)


def test_a_timed_process_tells_time_memory_and_failure():
    ran = run_timed(["-c", "print('{\"answer\": 42}')"])
    assert ran.answer() == {"answer": 42}
    assert 0 < ran.seconds < 60
    # The program's own: what this process has loaded is none of it.
    assert 0.001 < ran.peak_gb < 0.08
    with pytest.raises(RuntimeError, match="ended with 3"):
        run_timed(["-c", "raise SystemExit(3)"]).answer()


def test_a_photo_in_strips_is_the_photo_in_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = replace(SMALL, blur_px=0.0, noise_grey=0.0)
    monkeypatch.setattr(speed, "STRIP_ROWS", 40)
    path = speed.write_photo(scene, tmp_path, "strips")
    drawn = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    whole = np.clip(np.round(clean_grey(scene)), 0, 255).astype(np.uint8)
    encoded = cv2.imencode(".jpg", whole, [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    at_once = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    assert np.abs(drawn.astype(float) - at_once).mean() < 0.2
    assert json.loads((tmp_path / "camera.json").read_text())["width"] == SMALL.camera.width


def test_crossings_that_a_lens_folds_back_into_the_picture_are_none():
    camera = replace(Camera.from_focal(640, 480, 500.0), dist=(-0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    scene = SyntheticScene(camera=camera, spacing_m=(0.3, 0.3))
    ground = crossings_of(scene, margin_px=0.0)
    back = on_ground(project_ground(camera, scene.cam_from_ground, ground), camera, scene.cam_from_ground)
    assert len(ground) > 20
    assert np.abs(back - ground).max() < 1e-6


def test_the_stages_that_are_timed_are_called_under_the_names_they_are_timed_by():
    for name, place in STAGES.items():
        assert callable(getattr(import_module(place), name))
