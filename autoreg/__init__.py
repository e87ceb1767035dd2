"""Align a camera to photographed paving, so that a computer-generated object can stand on it.

`autoreg.align(photo, camera, slab=(0.6, 0.4))` is the library's one call; docs/library.md has its stages.
Names are loaded when they are first used: `import autoreg` costs nothing and does not import JAX.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from autoreg.align import align as align
    from autoreg.alignment import Alignment as Alignment
    from autoreg.calibration.board import Board as Board
    from autoreg.calibration.pipeline import calibrate as calibrate
    from autoreg.calibration.result import Calibration as Calibration
    from autoreg.camera import Camera as Camera
    from autoreg.camera_files import read_camera as read_camera
    from autoreg.errors import AutoregError as AutoregError
    from autoreg.errors import InputError as InputError
    from autoreg.errors import Refusal as Refusal
    from autoreg.errors import RenderError as RenderError
    from autoreg.geometry import Rigid as Rigid
    from autoreg.image import load_photo as load_photo
    from autoreg.lattice import Lattice as Lattice
    from autoreg.segments import detect_segments as detect_segments
    from autoreg.vanishing import manhattan_frame as manhattan_frame

    __version__: str

_HOMES = {
    "Alignment": "autoreg.alignment",
    "Board": "autoreg.calibration.board",
    "Calibration": "autoreg.calibration.result",
    "calibrate": "autoreg.calibration.pipeline",
    "Camera": "autoreg.camera",
    "AutoregError": "autoreg.errors",
    "InputError": "autoreg.errors",
    "Refusal": "autoreg.errors",
    "RenderError": "autoreg.errors",
    "Rigid": "autoreg.geometry",
    "Lattice": "autoreg.lattice",
    "detect_segments": "autoreg.segments",
    "load_photo": "autoreg.image",
    "manhattan_frame": "autoreg.vanishing",
    "read_camera": "autoreg.camera_files",
}

__all__ = [*_HOMES, "__version__", "align"]  # pyright: ignore[reportUnsupportedDunderAll]


class _CallableModule(ModuleType):
    """`autoreg.align` is the pipeline's module and, called, its function of the same name."""

    def __call__(self, *args: Any, **options: Any) -> Any:
        return self.align(*args, **options)


class _Package(ModuleType):
    """Makes the submodule `align` callable, whoever imports it first."""

    def __setattr__(self, name: str, value: Any) -> None:
        # The import system binds a submodule to its package through here.
        if name == "align" and type(value) is ModuleType:
            value.__class__ = _CallableModule
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name == "align":
        return import_module("autoreg.align")
    if name == "__version__":
        # It takes longer to import than all the rest here.
        from importlib import metadata

        try:
            return metadata.version("autoreg")
        except metadata.PackageNotFoundError:
            return "unknown (not installed)"
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'autoreg' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
