import subprocess
import sys


def run(code):
    """Run code in a fresh interpreter, without this test run's import hooks."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_importing_autoreg_and_asking_for_help_import_no_numerics():
    code = """
import sys, autoreg
from autoreg.command.cli import main
sys.argv = ["autoreg", "align", "--help"]
try:
    main()
except SystemExit as done:
    assert done.code == 0
loaded = {"jax", "jaxopt", "cv2", "numpy", "scipy"} & set(sys.modules)
assert not loaded, loaded
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_align_is_the_library_call_whichever_way_it_is_imported():
    for first in (
        "import autoreg",
        "import autoreg.align",
        "from autoreg.align import align",
        "from autoreg import align",
    ):
        done = run(
            f"{first}\nimport autoreg\nassert callable(autoreg.align) and callable(autoreg.align.align)"
        )
        assert done.returncode == 0, done.stderr


def test_calling_the_package_attribute_calls_the_pipeline(monkeypatch):
    import autoreg
    import autoreg.align as module

    monkeypatch.setattr(module, "align", lambda photo, camera, **options: (photo, camera, options))
    assert autoreg.align("photo", None, slab=(1.0, 2.0)) == ("photo", None, {"slab": (1.0, 2.0)})


def test_arguments_of_a_wrong_kind_are_value_errors_that_name_them():
    code = """
import autoreg, numpy as np
calls = [
    ("photos must be", lambda: autoreg.calibrate(None, "9x6")),
    ("pattern must be", lambda: autoreg.calibrate([np.zeros((99, 99), np.uint8)], 9)),
    ("pattern must be", lambda: autoreg.calibrate([np.zeros((99, 99), np.uint8)], (9, "6"))),
    ("square must be", lambda: autoreg.calibrate([np.zeros((99, 99), np.uint8)], (9, 6), square="25mm")),
    ("marker must be", lambda: autoreg.calibrate([np.zeros((99, 99), np.uint8)], (9, 6), marker=None)),
]
for words, call in calls:
    try:
        call()
    except ValueError as error:
        assert words in str(error), error
    else:
        raise AssertionError(words)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_a_camera_takes_opencvs_rows_and_columns_and_refuses_what_is_no_list():
    code = """
import autoreg, numpy as np
def camera(dist):
    return autoreg.Camera(10, 10, 5.0, 5.0, 4.5, 4.5, dist)
for shape in ((5,), (1, 5), (5, 1)):
    assert camera(np.full(shape, 0.125)) == camera([0.125] * 5) == camera((0.125,) * 5)
assert camera(np.zeros((1, 0))) == camera(())
for wrong in (None, 0.1, "0.1", np.float64(0.1), np.zeros((2, 4)), np.array(0.1), {1: 2}):
    try:
        camera(wrong)
    except ValueError as error:
        assert "dist must be a sequence" in str(error), error
    else:
        raise AssertionError(wrong)
"""
    done = run(code)
    assert done.returncode == 0, done.stderr


def test_every_exported_name_is_there():
    import autoreg

    for name in autoreg.__all__:
        assert getattr(autoreg, name) is not None
