import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from autoreg.solve import compiled_step, machine_code
from autoreg.solve.bare_code import bare_form, from_bare_form
from autoreg.solve.jax_code import from_jax_form, jax_form, on_arrays
from autoreg.solve.joint_data import PARAMETERS
from autoreg.solve.lm_step import compiled_with_jax
from autoreg.solve.step_state import blank_state, example_arguments

ROOT = Path(__file__).parents[1]

# What is said of a process: whether jaxopt or jax was imported for the step, and what it then solved.
SOLVES = """
import sys; sys.path.insert(0, 'tests')
from pathlib import Path
from autoreg.solve import solver
{first}
solver.warm_up(Path(sys.argv[1]))
print('compiled' if 'jaxopt' in sys.modules else 'jax' if 'jax' in sys.modules else 'bare')
import handmade_joints
print(handmade_joints.solved())
{then}
"""


def in_a_process(folder: Path, first: str = "", then: str = "") -> list[str]:
    """Where a new process had the step from, what it solved, and what `then` prints."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SOLVES.format(first=first, then=then), str(folder)],
        capture_output=True, text=True, check=True, timeout=300, cwd=ROOT,
    )  # fmt: skip
    assert done.stderr == ""
    return done.stdout.split()


@pytest.fixture(scope="module")
def compiled():
    return compiled_with_jax()


@pytest.fixture(scope="module")
def filled(tmp_path_factory) -> tuple[Path, str]:
    """A folder where a process left the step, and what it solved."""
    folder = tmp_path_factory.mktemp("kept") / "cache"
    told, solved = in_a_process(folder)
    assert told == "compiled"
    return folder, solved


@pytest.fixture
def kept(filled, tmp_path) -> tuple[Path, Path, str]:
    """Both forms of the step in a folder of the test's own, and what it solves."""
    folder, solved = filled
    for path in folder.iterdir():
        machine_code.keep_code(tmp_path / path.name, path.read_bytes()[32:])
    (bare,), (own,) = tmp_path.glob("step-*.bare"), tmp_path.glob("step-*.jax")
    return bare, own, solved


def test_a_later_process_solves_the_same_without_importing_jax(kept):
    bare, _, solved = kept
    assert in_a_process(bare.parent) == ["bare", solved]


def test_jax_works_as_ever_where_it_is_imported_after_the_step_was_run_without_it(kept):
    bare, _, solved = kept
    then = """
import jax, jax.numpy as jnp
import numpy as np
from autoreg.solve import compiled_step, jax_code, lm_step
compiled_step._STEP[:] = [jax_code.on_arrays(lm_step.compiled_with_jax())]
print(handmade_joints.solved())
# Constants that jax hands over in types of its own.
print(jax.jit(lambda x: x @ np.ones((3, 3), np.float32))(np.eye(3)).sum(), (jnp.arange(4) * 2).sum())
"""
    assert in_a_process(bare.parent, then=then) == ["bare", solved, solved, "9.0", "12"]


def test_where_jax_is_imported_already_its_own_form_is_fetched(kept):
    bare, _, solved = kept
    assert in_a_process(bare.parent, "import jax") == ["jax", solved]


@pytest.mark.parametrize(
    "broken",
    [
        "KNOWN_RELEASES = ('0.7.',)",
        # What is missing is called, and so an error.
        "_register_lapack = None",
        *(pytest.param(f"{name} = None", marks=pytest.mark.slow) for name in ("_handlers", "_put")),
    ],
)
def test_jax_stands_in_where_jaxlib_is_not_as_it_was(kept, broken):
    bare, _, solved = kept
    first = f"from autoreg.solve import bare_code; bare_code.{broken}"
    assert in_a_process(bare.parent, first) == ["jax", solved]


@pytest.mark.parametrize(
    "spoil",
    ["changed", *(pytest.param(how, marks=pytest.mark.slow) for how in ("missing", "open to others"))],
)
def test_a_form_that_cannot_be_trusted_is_not_run(kept, spoil):
    bare, own, solved = kept
    for path, told in ((bare, "jax"), (own, "compiled")):
        code = path.read_bytes()
        if spoil == "changed":
            path.write_bytes(code[:-100] + bytes(100))
        elif spoil == "missing":
            path.unlink()
        else:
            path.chmod(0o666)
        assert in_a_process(bare.parent) == [told, solved]
    # Whatever was wrong has been put right.
    for path in (bare, own):
        assert path.read_bytes()[:32] == hashlib.sha256(path.read_bytes()[32:]).digest()
        assert path.stat().st_mode & 0o077 == 0
    assert in_a_process(bare.parent) == ["bare", solved]


@pytest.mark.slow
def test_code_of_the_right_digest_that_is_no_code_is_not_run(kept):
    bare, own, solved = kept
    machine_code.keep_code(bare, bytes(1000))
    assert in_a_process(bare.parent) == ["jax", solved]
    machine_code.keep_code(own, b"")
    assert in_a_process(bare.parent) == ["compiled", solved]


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_does_no_harm(filled, tmp_path):
    stands_in_the_way = tmp_path / "file"
    stands_in_the_way.write_text("")
    assert in_a_process(stands_in_the_way / "cache") == ["compiled", filled[1]]


@pytest.mark.slow
def test_threads_that_solve_at_once_without_jax_find_the_same(kept):
    bare, _, solved = kept
    then = """
from concurrent.futures import ThreadPoolExecutor
with ThreadPoolExecutor(4) as pool:
    print(*set(pool.map(lambda _: handmade_joints.solved(), range(40))))
print('jax' in sys.modules)
"""
    assert in_a_process(bare.parent, then=then) == ["bare", solved, solved, "False"]


def test_every_form_of_the_step_does_the_same(compiled):
    arguments = example_arguments()
    q, state, problem = arguments
    rng = np.random.default_rng(0)
    data = problem.data._replace(
        ground=rng.normal(size=(2048, 2)),
        measured_px=500 + 100 * rng.normal(size=(2048, 2)),
        normal=rng.normal(size=(2048, 2)),
        weight=np.ones(2048),
        intrinsics=np.r_[1000.0, 1000.0, 500.0, 500.0, np.zeros(8)],
    )
    given = q, state, problem._replace(data=data, unit=np.ones(PARAMETERS), prior_weight=np.ones(PARAMETERS))
    forms = (
        on_arrays(compiled),
        from_jax_form(jax_form(compiled), arguments, arguments[:2]),
        from_bare_form(bare_form(compiled, arguments), arguments, arguments[:2]),
    )
    answers = [form(*given) for form in forms]
    for answer in answers:
        assert isinstance(answer[1], type(blank_state()))
        for name, there, here in zip(state._fields, answer[1], answers[0][1], strict=True):
            np.testing.assert_equal(there, here, err_msg=name)
        np.testing.assert_array_equal(answer[0], answers[0][0])
    assert answers[0][1].value > 0


def test_an_array_of_another_shape_is_an_error_and_not_read_beyond_its_end(compiled):
    arguments = example_arguments()
    step = from_bare_form(bare_form(compiled, arguments), arguments, arguments[:2])
    with pytest.raises(ValueError, match=re.escape(f"must be float64 of shape ({PARAMETERS},), got (10,)")):
        step(np.zeros(10), *arguments[1:])


@pytest.mark.parametrize(
    ("package", "release"), [("jaxlib", "0.99.0"), ("jax", "0.99.0"), ("jaxopt", "0.99.0"), (None, None)]
)
def test_code_of_other_releases_settings_and_sources_has_another_name(
    monkeypatch, tmp_path, package, release
):
    source = tmp_path / "source.py"
    source.write_text("a = 1")

    def name() -> str:
        return machine_code.fingerprint(source, packages=("jax", "jaxlib", "jaxopt"))

    before, real = name(), machine_code.version
    assert name() == before
    with monkeypatch.context() as changed:
        if package is None:
            changed.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        else:
            changed.setattr(machine_code, "version", lambda of: release if of == package else real(of))
        assert name() != before
    source.write_text("a = 2")
    assert name() != before


def test_the_name_needs_no_jax():
    code = (
        "import sys; from autoreg.solve import compiled_step as c, machine_code as m;"
        "print(m.fingerprint(*c.SOURCES, packages=c.PACKAGES), 'jax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT, env=os.environ
    )
    name = machine_code.fingerprint(*compiled_step.SOURCES, packages=compiled_step.PACKAGES)
    assert done.stdout.split() == [name, "False"]
