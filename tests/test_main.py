import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def program(code: str, **streams) -> subprocess.CompletedProcess:
    """A process that runs `program` after this code, in which `main` is a name."""
    start = (
        "import atexit, os, sys, threading, time\n"
        "from autoreg import __main__ as command\nfrom autoreg.command import cli\n"
    )
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | streams
    return subprocess.run(
        [sys.executable, "-c", f"{start}{code}\ncli.main = main\ncommand.program()\nprint('not reached')"],
        text=True, timeout=60, env=os.environ | {"PYTHONPATH": str(ROOT)}, **streams,
    )  # fmt: skip


@pytest.mark.parametrize(("how", "code"), [("sys.exit(3)", 3), ("sys.exit()", 0), ("sys.exit(0)", 0)])
def test_the_process_ends_at_once_with_the_commands_exit_code(how, code):
    # Were the interpreter taken apart, this object would say so.
    witness = "class Witness:\n    def __del__(self): os.write(1, b'taken apart')\nwitness = Witness()\n"
    done = program(f"{witness}def main():\n    print('written'); print('told', file=sys.stderr); {how}")
    assert (done.returncode, done.stdout, done.stderr) == (code, "written\n", "told\n")


def test_what_was_to_be_done_at_the_end_is_done():
    done = program("atexit.register(lambda: print('tidied up'))\ndef main(): sys.exit(0)")
    assert done.stdout == "tidied up\n"


def test_a_message_instead_of_a_code_is_an_error_as_ever():
    done = program("def main(): sys.exit('not like this')")
    assert (done.returncode, done.stderr) == (1, "not like this\n")


def test_an_error_in_the_program_itself_leaves_a_traceback():
    done = program("def main(): raise ZeroDivisionError")
    assert done.returncode == 1
    assert done.stderr.startswith("Traceback")
    assert done.stderr.endswith("ZeroDivisionError\n")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_output_that_cannot_be_written_is_no_success():
    with open("/dev/full", "w") as full:
        done = program("def main(): print('lost'); sys.exit(0)", stdout=full)
    assert done.returncode not in (0, None)
    assert "No space left" in done.stderr


def test_the_module_is_the_command():
    done = subprocess.run(
        [sys.executable, "-m", "autoreg", "align", "no-such-photo.jpg"],
        capture_output=True, text=True, timeout=60, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 2
    assert "no-such-photo.jpg does not exist" in done.stderr


def test_every_module_can_be_imported_without_jaxtyping():
    code = """
import importlib, pkgutil, sys
from autoreg import __main__ as command
sys.modules["jaxtyping"] = command._Shapes("jaxtyping")
import autoreg
for module in pkgutil.walk_packages(autoreg.__path__, "autoreg."):
    importlib.import_module(module.name)
assert not [name for name in sys.modules if name.startswith("jaxtyping.")]
"""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=120, cwd=ROOT
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_photo_is_aligned_without_jaxtyping_and_without_jax_once_the_solver_is_kept(tmp_path):
    photo, camera = (ROOT / "autoreg" / "data" / f"terrace.{end}" for end in ("jpg", "camera.json"))
    words = ["align", str(photo), "--camera", str(camera), "--slab", "0.5", "-o", str(tmp_path / "out")]
    # What the process imported by the time it ends.
    code = (
        "import atexit, sys\n"
        "named = {'jax', 'jaxopt', 'jaxtyping._array_types'}\n"
        "atexit.register(lambda: print(sorted(named & {*sys.modules})))\n"
        f"sys.argv = ['autoreg', *{words!r}]\n"
        "from autoreg.__main__ import program; program()\n"
    )
    own = os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path / "cache")}
    cold, warm = (
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, timeout=300, env=own
        )
        for _ in range(2)
    )
    assert (cold.returncode, warm.returncode) == (0, 0)
    assert (cold.stdout, warm.stdout) == ("['jax', 'jaxopt']\n", "[]\n")


def test_what_scipy_takes_hold_of_is_imported_when_something_of_it_is_asked_for():
    done = program(
        "def main():\n"
        "    import scipy.linalg\n"
        "    print([name for name in ('f2py', 'testing') if f'numpy.{name}' in sys.modules])\n"
        "    import numpy\n"
        "    numpy.testing.assert_array_equal([1], [1])\n"
        "    print('numpy.testing' in sys.modules, callable(numpy.f2py.get_include))\n"
        "    import numpy.testing as testing\n"
        "    print(testing.assert_allclose.__name__)\n"
        "    sys.exit(0)"
    )
    assert (done.stdout, done.stderr) == ("[]\nTrue True\nassert_allclose\n", "")
