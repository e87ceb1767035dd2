"""What the documentation shows of the library is run as it stands there."""

import re
from pathlib import Path

from autoreg.rendering import render

ROOT = Path(__file__).parents[1]
PAGE, RENDERING = ROOT / "docs" / "library.md", ROOT / "docs" / "rendering.md"


def run_blocks(page):
    names = {}
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
        exec(compile(block, str(page), "exec"), names)
    return names


def test_the_final_render_runs_by_itself(monkeypatch):
    monkeypatch.chdir(ROOT / "fixtures")
    monkeypatch.setattr(render, "find_povray", lambda: None)
    made = run_blocks(RENDERING)["made"]
    assert made.composite.shape == (900, 1200, 3)
    assert (made.layer[..., 3] == 255).sum() > 1000


def test_the_page_runs_from_top_to_bottom(monkeypatch):
    monkeypatch.chdir(ROOT / "fixtures")
    names = run_blocks(PAGE)
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
