"""What one run of the suite was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SHARED = Path(__file__).resolve().parents[2] / "shared"
# The folders of data that a checkout alone does not have; each is an option.
DATA = ("yorkurban", "photos", "scenes", "chessboards", "groundgrid")


@dataclass(frozen=True)
class Options:
    """Choices that hold for every suite.

    Attributes:
        quick: the short run of continuous integration.
        out: folder of results; pictures that a suite needs are kept there too, and not made again.
        seeds: so many seeds where a suite draws noise, instead of its own number.
        jobs: so many processes for the suites of many photos; it changes no figure.
        yorkurban: folder of the York Urban pictures and `ground_truth.json`.
        photos: folder of real photos, with `paved/` and `refuse/`.
        scenes: folder of ray-traced scenes, as `benchmarks/scenes.py` writes them.
        chessboards: folder of sets of photographed boards of 9 x 6 inner corners, one subfolder each.
        groundgrid: folder of floors with `gt.json`, their cameras and poses.
    """

    out: Path
    quick: bool = False
    seeds: int | None = None
    jobs: int = 1
    yorkurban: Path = SHARED / "yorkurban"
    photos: Path = SHARED / "photos"
    scenes: Path = SHARED / "scenes"
    chessboards: Path = SHARED / "chessboards"
    groundgrid: Path = SHARED / "groundgrid"

    def count(self, quick: int, full: int) -> int:
        """How many seeds to draw."""
        return self.seeds if self.seeds is not None else quick if self.quick else full

    def is_absent(self, name: str) -> bool:
        """Whether a folder of data was neither named nor put where it is looked for."""
        folder = getattr(self, name)
        return folder == getattr(Options(self.out), name) and not folder.exists()

    def cache(self, name: str) -> Path:
        """A folder, made if missing, for what a suite keeps between runs."""
        folder = self.out / "cache" / name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def command(self, suite: str) -> str:
        """The command that measures a suite's figures again."""
        words = ["python -m benchmarks --only", suite]
        words += ["--quick"] if self.quick else []
        words += [] if self.seeds is None else [f"--seeds {self.seeds}"]
        plain = Options(self.out)
        for name in DATA:
            if getattr(self, name) != getattr(plain, name):
                words.append(f"--{name} {getattr(self, name)}")
        return " ".join(words)
