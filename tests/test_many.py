from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import pytest

from autoreg.errors import InputError, Refusal
from autoreg.jobs.job import Job, demo_job
from autoreg.jobs.many import run_jobs
from autoreg.synthetic import SyntheticPhoto


def test_every_photo_ends_as_it_would_by_itself_and_in_order(tmp_path: Path, gravel_photo: SyntheticPhoto):
    gravel = tmp_path / "gravel.png"
    cv2.imwrite(str(gravel), gravel_photo.pixels)
    jobs = [
        Job(tmp_path / "absent.jpg", tmp_path / "a"),
        demo_job(tmp_path / "b", None),
        replace(demo_job(tmp_path / "d", None), slab=(-1.0, 0.5)),
        Job(gravel, tmp_path / "c"),
    ]
    absent, paved, negative, refused = run_jobs(jobs, processes=2)
    assert [run.job for run in (absent, paved, negative, refused)] == jobs
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
