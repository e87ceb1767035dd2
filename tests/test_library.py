"""The walk through the stages in docs/library.md is run as it stands there."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "library.md"


def blocks():
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


def test_the_page_runs_from_top_to_bottom(monkeypatch):
    monkeypatch.chdir(ROOT / "fixtures")
    names = {}
    for block in blocks():
        exec(compile(block, str(PAGE), "exec"), names)
    found, settled = names["found"], names["settled"]
    assert found.lattice.kind == "stack"
    assert names["paving"].grid.shift == 0
    # The stages by themselves come to where the one call does.
    turned = found.pose.cam_from_ground.R[:, 2] @ settled.fit.cam_from_ground.R[:, 2]
    assert turned > 1 - 1e-8
    assert names["told"].consistent


def test_every_place_it_names_is_there():
    for place in re.findall(r"`([a-z_]+(?:\.py|/))`", PAGE.read_text()):
        assert (ROOT / "autoreg" / place).exists(), place
    package = ROOT / "autoreg"
    folders = {p.name for p in package.iterdir() if (p / "__init__.py").exists()}
    named = {p.rstrip("/") for p in re.findall(r"`([a-z_]+/)`", PAGE.read_text())}
    assert folders == named
