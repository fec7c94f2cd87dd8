"""Examples of a page, run as a reader would: in a Python of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_RUN = """
import doctest, pathlib, sys
page = pathlib.Path(sys.argv[1])
test = doctest.DocTestParser().get_doctest(page.read_text(), {}, page.name, page.name, 0)
result = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test)
print(result.attempted, "examples")
sys.exit(bool(result.failed))
"""


def run_examples(page: Path, at_least: int) -> None:
    """Run the examples of *page*, of which there are at least so many.

    Not in the process of the tests: pyads keeps connections there that another test's plant ended.
    """
    done = subprocess.run(
        [sys.executable, "-c", _RUN, str(page)],
        check=False,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout.splitlines()[-1].split()[0]) >= at_least
