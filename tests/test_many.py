from __future__ import annotations

import inspect
import json
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from autoreg.errors import InputError, Refusal
from autoreg.jobs import many
from autoreg.jobs.job import Job, demo_job
from autoreg.jobs.many import run_jobs
from autoreg.synthetic import SyntheticPhoto


def with_values(job: Job, **values: object) -> Job:
    """A copy of a job with values that its types forbid."""
    changed = replace(job)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def test_every_photo_ends_as_it_would_by_itself_and_in_order(tmp_path: Path, gravel_photo: SyntheticPhoto):
    gravel = tmp_path / "gravel.png"
    cv2.imwrite(str(gravel), gravel_photo.pixels)
    jobs = [
        Job(tmp_path / "absent.jpg", tmp_path / "a"),
        demo_job(tmp_path / "b", None),
        replace(demo_job(tmp_path / "d", None), slab=(-1.0, 0.5)),
        Job(gravel, tmp_path / "c"),
    ]
    # As a caller without type checks makes them.
    jobs += [
        with_values(replace(jobs[1], folder=tmp_path / "e"), crop=(0, 0, 10)),
        with_values(jobs[1], folder=3),
        with_values(jobs[1], folder=3),
    ]
    absent, paved, negative, refused, cropped, nowhere, _ = run_jobs(jobs, processes=2)
    assert [run.job for run in (absent, paved, negative, refused, cropped, nowhere)] == jobs[:-1]
    assert "crop of a job must be four whole numbers, or None, got (0, 0, 10)" in str(cropped.error)
    assert "folder of a job must be a path, got 3" in str(nowhere.error)
    assert isinstance(negative.error, InputError)
    assert "slab" in str(negative.error)
    assert isinstance(absent.error, InputError)
    assert absent.outcome is None
    assert not (tmp_path / "a").exists()
    assert paved.outcome is not None
    assert paved.outcome.alignment is not None
    assert paved.outcome.alignment.lattice.spacing_x == pytest.approx(0.5, rel=0.01)
    assert refused.outcome is not None
    assert isinstance(refused.outcome.refusal, Refusal)
    told = [json.loads((tmp_path / f / "alignment.json").read_text())["status"] for f in "bc"]
    assert told == ["aligned", "refused"]


def test_a_failure_that_nobody_foresaw_ends_one_run_and_no_other(monkeypatch, tmp_path: Path):
    def broken(job, listener):
        raise KeyError("lost")

    monkeypatch.setattr(many, "run_job", broken)
    run = many._run(demo_job(tmp_path, None))
    assert "KeyError: 'lost'" in str(run.error)


def test_texts_are_taken_for_paths():
    job = with_values(demo_job(Path("x"), None), photo="photo.jpg", folder="out", camera="camera.json")
    job.__post_init__()
    assert (job.photo, job.folder, job.camera) == (Path("photo.jpg"), Path("out"), Path("camera.json"))
    with pytest.raises(InputError, match="must be of type Job, got 'photo"):
        inspect.unwrap(run_jobs)(["photo.jpg"])


def test_nothing_is_begun_where_two_photos_would_share_a_folder(tmp_path: Path):
    jobs = [demo_job(tmp_path / "one", None), demo_job(tmp_path / "two" / ".." / "one", None)]
    with pytest.raises(InputError, match="a folder of its own"):
        run_jobs(jobs)
    with pytest.raises(InputError, match="processes"):
        run_jobs(jobs[:1], processes=0)
    assert list(run_jobs([])) == []
    assert not (tmp_path / "one").exists()


def test_a_refusal_reaches_another_process_whole():
    sent = Refusal("ambiguous", "either may be", measured=2.0, limit=1.0)
    got = pickle.loads(pickle.dumps(sent))
    assert (got.code, got.message, got.measured, got.limit) == ("ambiguous", "either may be", 2.0, 1.0)
    assert str(got) == str(sent)
