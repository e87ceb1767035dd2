import os

import cv2
import numpy as np
import pytest

from autoreg.errors import InputError
from autoreg.jobs.outputs import (
    clear_results,
    is_sealed,
    kept_apart,
    results_in,
    sealed,
    usable_folder,
    whole_run,
    write_png,
    write_whole,
)


def test_a_file_that_could_not_be_written_keeps_its_old_content(tmp_path, monkeypatch):
    path = write_whole(tmp_path / "report.json", b"old")

    def fail(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(KeyboardInterrupt):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_a_written_picture_is_read_back_unchanged(tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (20, 30, 4)).astype(np.uint8)
    path = write_png(tmp_path / "a b'ü.png", image)
    assert (cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED) == image).all()


def test_a_folder_that_can_be_made_is_not_made_yet(tmp_path):
    folder = tmp_path / "deep" / "er"
    assert usable_folder(folder) == folder
    assert not (tmp_path / "deep").exists()


def test_a_file_in_the_folders_way_is_an_input_error(tmp_path):
    (tmp_path / "taken").write_text("")
    for folder in (tmp_path / "taken", tmp_path / "taken" / "below"):
        with pytest.raises(InputError, match="is a file"):
            usable_folder(folder)


def test_earlier_results_are_cleared_only_where_a_report_stands(tmp_path):
    (tmp_path / "scene.pov").write_text("mine")
    clear_results(tmp_path)
    assert (tmp_path / "scene.pov").exists()
    (tmp_path / "alignment.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("keep")
    clear_results(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_a_scene_tells_by_itself_whether_it_was_changed():
    content = sealed("camera { }\n// größer\n")
    assert content.startswith("camera { }\n// größer\n".encode())
    assert is_sealed(content)
    assert is_sealed(sealed(content.decode()))
    for other in (b"mine " + content, content + b"sphere { }\n", content.replace(b"camera", b"light"), b""):
        assert not is_sealed(other)


def test_a_full_disk_is_told_by_the_place_that_was_asked_for(tmp_path):
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*/out/overlay\.png'"),
        whole_run(tmp_path / "out", print) as place,
    ):
        raise OSError(28, "No space left on device", str(place / "overlay.png"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["overlay.png", "alignment.json", "scene-thing_cup.png"])
def test_what_is_read_is_not_written_over(tmp_path, name):
    (tmp_path / name).write_bytes(b"a photo")
    with pytest.raises(InputError, match=rf"{name} would be written over.*another folder"):
        kept_apart((None, tmp_path / name), results_in(tmp_path))
    (tmp_path / "link.png").symlink_to(tmp_path / name)
    with pytest.raises(InputError, match="written over"):
        kept_apart((tmp_path / "link.png",), results_in(tmp_path))
    kept_apart((tmp_path / name, tmp_path / "absent.png"), results_in(tmp_path / "elsewhere"))


def test_a_folder_that_cannot_be_made_is_named(tmp_path, monkeypatch):
    def refuse(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(tmp_path), "mkdir", refuse)
    with (
        pytest.raises(InputError, match=r"cannot be written in .*new: No space left.*another folder with -o"),
        whole_run(tmp_path / "new", print),
    ):
        pass
    assert not (tmp_path / "new").exists()
