"""Is the installation whole? Versions, POV-Ray, and the demo picture from file to report."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from autoreg.errors import AutoregError
from autoreg.formats.heic import can_decode_heic
from autoreg.jobs.job import Listener, demo_job, run_job
from autoreg.jobs.report import versions
from autoreg.rendering.povray import find_povray, povray_version


def examine(say: Callable[[str], None]) -> bool:
    """Whether all that autoreg needs works; POV-Ray is optional, and its absence is only said."""
    for name, version in versions().items():
        say(f"{name:14} {version or 'not installed as a package'}")
    program = find_povray()
    if program is None:
        say("POV-Ray        not found; --render uses the built-in preview. To install it:")
        say("               apt-get install povray, or brew install povray")
    else:
        say(f"POV-Ray        {povray_version(program)} ({program})")
    if not can_decode_heic():
        say("HEIC photos    are not read; to read them: pip install pillow-heif")
    return _try_demo(say)


def _try_demo(say: Callable[[str], None]) -> bool:
    """Whether the demo picture is aligned and rendered."""
    begun = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="autoreg-doctor-") as name:
        try:
            outcome = run_job(demo_job(Path(name), "auto"), Listener(note=say, doing=lambda text: None))
        except AutoregError as error:
            say(f"self-test      FAILED: {error}")
            return False
    failure = outcome.refusal or outcome.render_error
    if failure is not None or outcome.alignment is None:
        say(f"self-test      FAILED: {failure}")
        return False
    took = time.monotonic() - begun
    rms = outcome.alignment.residual.rms_px
    say(f"self-test      the demo picture is aligned ({rms:.2f} px rms) and rendered in {took:.1f} s")
    return True
