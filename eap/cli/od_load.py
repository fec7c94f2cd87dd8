"""``eapctl od write --from``: a whole dictionary written at once."""

from __future__ import annotations

from pathlib import Path

from eap.appliance.commands import od_load
from eap.appliance.commands.od_target import Target, open_device
from eap.cli.od_file import read_file
from eap.cli.output import write_json, write_text


def load(target: Target, file: Path, *, as_json: bool) -> None:
    """Write what *file* holds to *target* and say how much that was."""
    entries = read_file(file)
    with open_device(target) as device:
        done = od_load.load(device, entries)
    if as_json:
        write_json({"target": str(target), "written": done.written, "unchanged": done.unchanged})
        return
    rest = f", {done.unchanged} were there already" if done.unchanged else ""
    word = "entry" if done.written == 1 else "entries"
    write_text(f"{target}: {done.written} {word} written{rest}")
