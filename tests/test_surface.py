from pathlib import Path

import numpy as np
import pytest
import trimesh
from handmade import CAMERA, POSE

from autoreg.rendering.letters import text_surface
from autoreg.rendering.mesh_files import read_mesh
from autoreg.rendering.raster import ZBuffer, clipped
from autoreg.rendering.surface import (
    Surface,
    box_surface,
    frustum_surface,
    sphere_surface,
    stand_up,
    torus_surface,
)
from autoreg.view import View


def volume(surface):
    """Enclosed volume by the divergence theorem; negative if the triangles face inwards."""
    a, b, c = np.moveaxis(surface.corners, 1, 0)
    return float(np.einsum("nd,nd->", a, np.cross(b, c)) / 6)


SHAPES = {
    "box": (box_surface((0.2, 0.3, 0.4)), 0.2 * 0.3 * 0.4),
    "sphere": (sphere_surface(0.3), 4 / 3 * np.pi * 0.3**3),
    "cylinder": (frustum_surface(0.2, 0.2, 0.5), np.pi * 0.04 * 0.5),
    "cone": (frustum_surface(0.3, 0.0, 0.5), np.pi * 0.09 * 0.5 / 3),
    "frustum": (frustum_surface(0.3, 0.1, 0.5), np.pi * 0.5 / 3 * (0.09 + 0.03 + 0.01)),
    "torus": (torus_surface(0.3, 0.1), 2 * np.pi**2 * 0.3 * 0.01),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_surface_is_closed_faces_outwards_and_stands_on_the_ground(name):
    surface, expected = SHAPES[name]
    assert volume(surface) == pytest.approx(expected, rel=2e-3)
    assert surface.corners[..., 2].min() == pytest.approx(0.0, abs=1e-12)
    # Every edge is walked once each way.
    edges = (
        np.round(np.stack([surface.corners, np.roll(surface.corners, -1, axis=1)], 2), 9).reshape(-1, 6) + 0.0
    )
    forth, back = (np.unique(e, axis=0, return_counts=True) for e in (edges, np.roll(edges, 3, axis=1)))
    assert np.array_equal(forth[0], back[0])
    assert (forth[1] == 1).all()


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_of_length_1_and_point_outwards(name):
    surface, _ = SHAPES[name]
    assert np.linalg.norm(surface.normals, axis=-1) == pytest.approx(np.ones(surface.normals.shape[:2]))
    a, b, c = np.moveaxis(surface.corners, 1, 0)
    assert (np.einsum("nd,nd->n", np.cross(b - a, c - a), surface.normals.mean(1)) > 0).all()


def test_letters_are_solids_as_high_as_asked_with_their_holes():
    surface = text_surface("HI", 0.3, 0.1, None)
    low, high = surface.corners.min((0, 1)), surface.corners.max((0, 1))
    assert (low[2], high[2]) == pytest.approx((0.0, 0.3))
    assert (low[1], high[1]) == pytest.approx((-0.05, 0.05))
    assert low[0] == pytest.approx(-high[0])
    assert volume(surface) > 0
    # A ring has a hole: its volume is well below that of its disc.
    ring, disc = (volume(text_surface(letter, 0.3, 0.1, None)) for letter in ("O", "."))
    outline = text_surface("O", 0.3, 0.1, None).corners
    box = np.ptp(outline[..., 0]) * np.ptp(outline[..., 2]) * 0.1
    assert 0.1 * box < ring < 0.6 * box
    assert disc > 0


def test_letters_read_from_left_to_right_seen_from_minus_y():
    # L has its foot on the right of its stem.
    surface = text_surface("L", 0.3, 0.1, None)
    low = surface.corners[surface.corners[..., 2] < 0.01][:, 0]
    high = surface.corners[surface.corners[..., 2] > 0.29][:, 0]
    assert low.max() > high.max() + 0.05
    assert low.min() == pytest.approx(high.min(), abs=0.01)


def test_a_font_that_cannot_be_read_and_a_missing_letter_are_named(tmp_path):
    (tmp_path / "bad.ttf").write_bytes(b"no font")
    with pytest.raises(ValueError, match=r"bad\.ttf cannot be read"):
        text_surface("A", 0.1, 0.1, Path(tmp_path / "bad.ttf"))
    with pytest.raises(ValueError, match="has no letter"):
        text_surface("漢", 0.1, 0.1, None)


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_a_mesh_file_stands_upright_at_its_height(tmp_path, kind):
    path = tmp_path / f"a b.{kind}"
    mesh = trimesh.creation.box((1.0, 2.0, 4.0))
    mesh.apply_translation((5.0, 5.0, 5.0))
    mesh.export(path)
    surface = stand_up(read_mesh(path), height_m=0.8)
    assert volume(surface) == pytest.approx(8 * 0.2**3)
    assert surface.corners.min((0, 1)) == pytest.approx([-0.1, -0.2, 0.0])
    lying = stand_up(read_mesh(path, up="y"), scale=1.0)
    assert np.ptp(lying.corners, axis=(0, 1)) == pytest.approx([1.0, 4.0, 2.0])
    assert volume(lying) > 0


def test_a_meshs_own_normals_are_kept_and_else_its_triangles_are_flat(tmp_path):
    ball = trimesh.creation.icosphere(2)
    (tmp_path / "smooth.obj").write_text(trimesh.exchange.obj.export_obj(ball, include_normals=True))
    (tmp_path / "flat.obj").write_text(trimesh.exchange.obj.export_obj(ball, include_normals=False))
    for name, spread in (("smooth", True), ("flat", False)):
        normals = read_mesh(tmp_path / f"{name}.obj").normals
        assert (np.abs(normals[:, 0] - normals[:, 1]).max() > 0.01) == spread


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def obj(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_mesh(path)


@pytest.mark.parametrize(
    "data",
    [
        f"# Stra\u00dfe\no K\u00f6rper\n{TRIANGLE}f 1 2 3\n".encode("latin-1"),
        f"# Stra\u00dfe\r\n{TRIANGLE}f 1 2 3\r\n".encode("utf-16"),
        f"\ufeffmtllib no.mtl\n{TRIANGLE}f 1 2 3".encode(),
        f"{TRIANGLE}f\t1 \\\n 2 3  # a face".encode(),
        f"  {TRIANGLE}l 1 2\nusemtl x\nf -3 -2 -1\nv 5 5 5\n".encode(),
        b"v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 1\nvt 0.5\nvn 0 0 2\nf 1/1/1 2/1/1 3/1/1",
    ],
    ids=["latin-1", "utf-16", "utf-8 with a mark", "continued", "counted back", "with more numbers"],
)
def test_an_obj_file_is_read_however_it_is_written(tmp_path, data):
    surface = obj(tmp_path / "a.obj", data)
    assert surface.corners.tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]
    assert surface.normals.tolist() == [[[0, 0, 1]] * 3]


def test_polygons_of_an_obj_file_become_triangles_with_their_texture(tmp_path):
    text = TRIANGLE + "v -1 1 0\nv -1 0 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3 4/3 5/1\nf 1/1 3/2 2/3\n"
    surface = obj(tmp_path / "a.obj", text)
    assert surface.corners[:, 1:, :2].tolist() == [
        [[1, 0], [0, 1]], [[0, 1], [-1, 1]], [[-1, 1], [-1, 0]], [[0, 1], [1, 0]]
    ]  # fmt: skip
    assert surface.uv[0].tolist() == [[0, 0], [1, 0], [1, 1]]
    assert obj(tmp_path / "b.obj", text + "f 1 2 3\n").uv is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (TRIANGLE, "3 vertices and no faces"),
        (TRIANGLE + "l 1 2 3", "3 vertices and no faces"),
        ("nothing", "0 vertices and no faces"),
        (TRIANGLE + "f 1 2 9", "line 4: the face has v number 9, and the file holds 3"),
        (TRIANGLE + "f 1/7 2/7 3/7", "line 4: the face has vt number 7, and the file holds 0"),
        (TRIANGLE + "f 0 1 2", "line 4: 'f 0 1 2' is damaged .*counted from 1"),
        (TRIANGLE + "f -1 -2 -9", "line 4: .*counts 9 back, and only 3"),
        (TRIANGLE + "f 1 2", "line 4: .*three corners"),
        (TRIANGLE + "f a b c", "line 4: 'f a b c'"),
        (TRIANGLE + "f /1 /2 /3", "line 4: .*no number"),
        ("v 0 nan 0\n", "line 1: 'v 0 nan 0' is damaged .*3 numbers within 1e"),
        ("v 0 1e300 0\n", r"line 1: .*3 numbers within 1e\+09"),
        ("v 0 1\n", "line 1: .*3 numbers"),
        (b"\x7fELF\0\0\1" * 9, "binary data and no OBJ text"),
    ],
)
def test_what_is_odd_in_an_obj_file_is_named_with_its_line(tmp_path, text, words):
    with pytest.raises(ValueError, match=words) as caught:
        obj(tmp_path / "odd.obj", text)
    assert "save it as OBJ" not in str(caught.value)


def test_a_mesh_file_without_an_ending_says_so(tmp_path):
    with pytest.raises(ValueError, match="no ending that says its format"):
        obj(tmp_path / "mesh", TRIANGLE)


def test_a_triangle_cut_by_a_plane_keeps_the_area_on_its_side():
    triangle = np.array([[[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 2.0, 1.0]]])
    for plane, area in (([1.0, 0.0, 0.0, -1.0], 0.5), ([-1.0, 0.0, 0.0, 1.0], 1.5)):
        parts, source, weights = clipped(triangle, np.array(plane))
        sides = np.cross(parts[:, 1] - parts[:, 0], parts[:, 2] - parts[:, 0])
        assert 0.5 * sides[:, 2].sum() == pytest.approx(area)
        assert (source == 0).all()
        assert weights.sum(-1) == pytest.approx(np.ones((len(parts), 3)))


def test_the_z_buffer_agrees_with_rays_through_every_pixel():
    rng = np.random.default_rng(3)
    middle = rng.uniform([-0.5, -0.5, 0.0], [0.8, 1.0, 0.6], (40, 3))
    corners = middle[:, None] + rng.uniform(-0.3, 0.3, (40, 3, 3))
    view = View(CAMERA, POSE)
    buffer = ZBuffer(view, 0, 480, 1)
    buffer.draw(corners)
    v, u = (g.ravel()[::97] for g in np.indices((480, 640)))
    rays = view.directions(np.stack([u, v], -1).astype(float))
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(rays[:, None], e2)
    scale = 1 / np.einsum("td,ntd->nt", e1, p)
    s = view.eye - corners[:, 0]
    a = np.einsum("td,ntd->nt", s, p) * scale
    b = np.einsum("nd,td->nt", rays, np.cross(s, e1)) * scale
    t = np.einsum("td,td->t", e2, np.cross(s, e1)) * scale
    t = np.where((a >= 0) & (b >= 0) & (a + b <= 1) & (t > 0), t, np.inf)
    expected = np.where(np.isfinite(t.min(1)), t.argmin(1), -1)
    assert (expected >= 0).sum() > 150
    assert (buffer.nearest[v, u] != expected).mean() < 0.003


def test_pictures_are_inset_by_half_a_pixel_where_they_are_not_repeated():
    corners = np.zeros((2, 3, 3))
    uv = np.array([[[0.0, 0.0], [1.00001, 0.5], [0.3, 1.0]], [[0.0, 0.0], [2.0, 0.0], [0.5, 1.0]]])
    found = Surface(corners, corners, uv).inset(8, 4).uv
    assert found[0].tolist() == [[1 / 16, 1 / 8], [15 / 16, 0.5], [0.3, 7 / 8]]
    assert (found[1] == uv[1]).all()
    assert Surface(corners, corners).inset(8, 4).uv is None


def test_a_flat_mesh_has_no_height_to_scale():
    flat = Surface(np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]]), np.tile([0.0, 0, 1], (1, 3, 1)))
    with pytest.raises(ValueError, match="height cannot scale"):
        stand_up(flat, height_m=1.0)
