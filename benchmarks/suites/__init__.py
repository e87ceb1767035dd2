"""The suites: each module has `run(options) -> Result`. They are imported when they are run."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

from autoreg.blas_threads import one_blas_thread
from benchmarks.options import Options
from benchmarks.result import Result

# In the order in which they run and are reported.
NAMES = (
    *("refine", "limit", "truth", "robust", "vanishing", "thesis", "speed"),
    *("scenes", "boards", "real", "variants"),
)
# What the short run leaves out, because it needs what a checkout alone does not have, or minutes.
NOT_QUICK = ("thesis", "speed", "scenes", "boards", "real", "variants")


class UnknownSuite(ValueError):
    """A suite was asked for that there is not."""


def chosen(only: Sequence[str], *, quick: bool) -> tuple[str, ...]:
    """Names of the suites to run: those asked for, else all that belong to this kind of run.

    Raises:
        UnknownSuite: one of the names is none.
    """
    asked = [name.strip() for text in only for name in text.split(",")]
    unknown = [name for name in asked if name not in NAMES]
    if unknown:
        raise UnknownSuite(f"there is no suite {unknown[0]!r}; there are {', '.join(NAMES)}")
    return tuple(name for name in NAMES if (name in asked if asked else not (quick and name in NOT_QUICK)))


def run_suite(name: str, options: Options) -> Result:
    """The result of one suite, with BLAS on one thread, as `align` holds it."""
    suite = import_module(f"benchmarks.suites.{name}")
    with one_blas_thread():
        return suite.run(options)
