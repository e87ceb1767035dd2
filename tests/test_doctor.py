import pytest

from autoreg.command import doctor
from autoreg.errors import Refusal
from autoreg.jobs import job


@pytest.fixture
def said(monkeypatch):
    monkeypatch.setattr(job, "_warm_up", lambda ended: None)
    return []


def test_a_failing_self_test_is_said_with_its_reason(said, monkeypatch):
    import autoreg.align

    def refuse(*_, **__):
        raise Refusal("no_lattice", "no lattice here")

    monkeypatch.setattr(autoreg.align, "align_seen", refuse)
    assert doctor.examine(said.append) is False
    assert "FAILED: no lattice here" in said[-1]


def test_a_missing_povray_is_no_failure_but_is_said_with_the_way_to_install_it(said, monkeypatch):
    monkeypatch.setattr(doctor, "find_povray", lambda: None)
    monkeypatch.setattr(doctor, "_try_demo", lambda say: True)
    assert doctor.examine(said.append) is True
    assert any("apt-get install povray" in line for line in said)


def test_versions_of_what_results_rest_on_are_said(said, monkeypatch):
    monkeypatch.setattr(doctor, "_try_demo", lambda say: True)
    doctor.examine(said.append)
    assert {"python", "numpy", "jax"} <= {line.split()[0] for line in said}


@pytest.mark.parametrize("installed", [False, True])
def test_that_heic_is_not_read_is_said_with_the_way_to_read_it(said, monkeypatch, installed):
    monkeypatch.setattr(doctor, "can_decode_heic", lambda: installed)
    monkeypatch.setattr(doctor, "_try_demo", lambda say: True)
    assert doctor.examine(said.append) is True
    assert any("pip install pillow-heif" in line for line in said) is not installed
