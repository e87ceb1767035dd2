"""The suite's command line: `python -m benchmarks --help`."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from benchmarks.gate import BASELINE, Judgement, judge, mode_of, read_baseline, write_baseline
from benchmarks.options import DATA, Options
from benchmarks.plots import draw_all
from benchmarks.report import machine, markdown, print_report
from benchmarks.result import Result, read_results, to_json
from benchmarks.suites import NAMES, UnknownSuite, chosen, run_suite

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
# The results that docs/benchmarks.md shows: suites take hours together, and are renewed one by one.
KEPT = Path(__file__).with_name("results.json")
BAD_USAGE, GATE_SHUT = 2, 1


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="How good autoreg is: against the physical limit, one LSD pass, and peers.",
        epilog=f"suites: {', '.join(NAMES)}. Exit codes: 0, 1 the gate is shut, 2 bad usage.",
    )
    plain = Options(Path("benchmark-results"))
    made.add_argument("--quick", action="store_true", help="the short run: few seeds, small pictures")
    made.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="only this suite; repeat it"
    )
    made.add_argument("--gate", action="store_true", help="fail where a figure is worse than the baseline")
    made.add_argument("--out", type=Path, default=plain.out, metavar="DIR", help="folder of results")
    made.add_argument("--update-baseline", action="store_true", help="make this run's figures the baseline")
    made.add_argument(
        "--docs", action="store_true", help="write docs/benchmarks.md: DIR's results, else those kept"
    )
    made.add_argument("--again", action="store_true", help="run nothing, report the results in DIR")
    made.add_argument("--seeds", type=int, help="so many seeds instead of a suite's own number")
    made.add_argument(
        "--jobs", type=int, default=plain.jobs, help="processes for limit, truth, robust and variants"
    )
    for name in DATA:
        made.add_argument(f"--{name}", type=Path, default=getattr(plain, name), metavar="DIR", help="data")
    return made


def main(words: Sequence[str] | None = None, console: Console | None = None) -> int:
    """Run what was asked for; the exit code."""
    asked = parser().parse_args(words)
    console = console or Console(soft_wrap=False)
    data = {name: getattr(asked, name) for name in DATA}
    options = Options(asked.out, asked.quick, asked.seeds, asked.jobs, **data)
    try:
        names = chosen(asked.only, quick=asked.quick)
        if asked.seeds is not None and asked.seeds < 2:
            raise UnknownSuite(f"--seeds wants at least 2, got {asked.seeds}")
        if asked.jobs < 1:
            raise UnknownSuite(f"--jobs wants at least 1, got {asked.jobs}")
    except UnknownSuite as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_USAGE
    options.out.mkdir(parents=True, exist_ok=True)
    kept, place = options.out / f"results-{mode_of(options.quick)}.json", machine()
    # Suites may be run one by one: the folder holds the latest result of each, as soon as there is one.
    latest = {result.suite: result for result in read_results(kept)}
    # What is committed while suites run is not what they measure.
    code = measured_code()
    ran: list[Result] = []
    for name in names:
        if not asked.again:
            latest[name] = _run(name, options, code)
            kept.write_text(to_json(_in_order(latest), place))
        ran += [latest[name]] if name in latest else []
    every = _in_order(latest)
    baseline = read_baseline(BASELINE, options.quick)
    judged = judge(ran, baseline, options.quick)
    print_report(ran, judged, console)
    draw_all(every, options.out / "images")
    (options.out / "report.md").write_text(markdown(every, judge(every, baseline, options.quick), place))
    console.print(f"wrote {options.out}/report.md, {kept} and the plots", soft_wrap=True)
    if asked.docs:
        results, judgements = documented(options.out)
        full = [result for result in results if not result.quick and result.skipped is None]
        KEPT.write_text(to_json(full, place))
        (DOCS / "benchmarks.md").write_text(markdown(results, judgements, place))
        draw_all(results, DOCS / "images")
        console.print("wrote docs/benchmarks.md", soft_wrap=True)
    if asked.update_baseline:
        write_baseline(BASELINE, ran, options.quick)
        console.print(f"the baseline ({mode_of(options.quick)}) is now this run's", soft_wrap=True)
    elif asked.gate:
        for judgement in judged:
            if judgement.failed or judgement.verdict == "not measured":
                print(f"gate: {judgement.sentence()}", file=sys.stderr)
        return GATE_SHUT if any(j.failed for j in judged) else 0
    return 0


def documented(out: Path) -> tuple[tuple[Result, ...], tuple[Judgement, ...]]:
    """Every suite's best result, each judged as its kind of run.

    A full run's before a short one's, one that ran before one that was skipped, that of a folder before the
    one that is kept beside the baseline.
    """
    found: dict[str, Result] = {}
    for place in (out / f"results-{mode_of(True)}.json", KEPT, out / f"results-{mode_of(False)}.json"):
        for result in read_results(place):
            if result.suite not in found or result.skipped is None:
                found[result.suite] = result
    results = _in_order(found)
    judged = [
        judgement
        for quick in (True, False)
        for judgement in judge(
            [r for r in results if r.quick == quick], read_baseline(BASELINE, quick), quick
        )
    ]
    return results, tuple(judged)


def _run(name: str, options: Options, code: str) -> Result:
    print(f"{name} ...", file=sys.stderr, flush=True)
    began = time.monotonic()
    result = run_suite(name, options)
    took = time.monotonic() - began
    command = options.command(name)
    return replace(result, seconds=took, command=command, quick=options.quick, code=code)


def _in_order(latest: Mapping[str, Result]) -> tuple[Result, ...]:
    return tuple(latest[name] for name in NAMES if name in latest)


def measured_code() -> str:
    """The commit that is measured, as far as git tells it, and the day."""
    words = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        said = subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()
    except OSError:
        said = ""
    day = time.strftime("%Y-%m-%d")
    return f"{said}, {day}" if said else day


if __name__ == "__main__":
    sys.exit(main())
