"""Extras that are not installed: the message names what to install."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import sys
for name in {blocked!r}:
    sys.modules[name] = None
from eap.errors import EnvironmentalError
try:
    import eap.recording.{module}
except EnvironmentalError as exc:
    print(exc)
"""


@pytest.mark.parametrize(
    ("module", "blocked", "extra"),
    [
        ("values_writer", ["mcap", "mcap.writer"], "record"),
        ("values_reader", ["lz4", "lz4.frame"], "record"),
        ("parquet", ["pyarrow"], "export"),
        ("chart_png", ["PIL"], "export"),
        ("postgres", ["psycopg"], "postgres"),
    ],
)
def test_missing_package_names_the_extra(module: str, blocked: list[str], extra: str) -> None:
    code = CODE.format(module=module, blocked=blocked)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"pip install 'eap-appliance[{extra}]'" in done.stdout


def test_recordings_of_frames_need_no_extra() -> None:
    blocked = ["mcap", "lz4", "zstandard", "pyarrow", "PIL", "psycopg"]
    code = CODE.format(
        module="recording_file, eap.recording.export, eap.ops.replay", blocked=blocked
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == ""
