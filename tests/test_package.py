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


def test_every_exported_name_is_there():
    import autoreg

    for name in autoreg.__all__:
        assert getattr(autoreg, name) is not None
