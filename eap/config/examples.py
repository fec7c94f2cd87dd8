"""Example plants that come with the package: plant files, and the files that they refer to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import msgspec

from eap.config.new_plant import SCHEMA_LINE, plant_line
from eap.errors import ConfigError
from eap.suggest import suggest

_PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = "config"
"""Folder of the examples in the project; in an installed package it is ``eap/examples``."""
_PATH = re.compile(r"(?:\.\./)*\w[\w-]*(?:[./]\w[\w-]*)+")
_PLANT_LINE = re.compile(r"^plant: .*$", re.MULTILINE)


class CopiedExample(msgspec.Struct, frozen=True):
    """``eapctl new --from``: the plant file, and the files beside it."""

    file: str
    plant: str
    example: str
    files: list[str]


def example_names() -> list[str]:
    """Return the names of all example plants."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def read_example(example: str, plant: str, file: Path) -> dict[Path, bytes]:
    """Return the files of an example: the plant file first, all with their new paths.

    Args:
        example: Its name.
        plant: Name of the new plant.
        file: Path of the plant file; the others are put beside it, in folders of their own.

    Raises:
        ConfigError: there is no such example, or the name of the plant is invalid.
    """
    line = plant_line(plant)
    names = example_names()
    if example not in names:
        hint = suggest(example, names) or f"; known examples: {', '.join(names)}"
        raise ConfigError(f"unknown example {example!r}{hint}")
    source = _folder() / f"{example}.yaml"
    text = source.read_text()
    beside = file.parent.as_posix() + "/" if file.parent != Path() else ""
    written = text.replace(f"{_SOURCES}/{source.name}", str(file))
    written = written.replace(f"{_SOURCES}/", beside)
    written = _PLANT_LINE.sub(lambda _: line, written, count=1)
    found = {file: f"{SCHEMA_LINE}\n{written}".encode()}
    for path in _related(source):
        found[file.parent / path.relative_to(_folder())] = path.read_bytes()
    return found


def _folder() -> Path:
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parent / _SOURCES


def _related(source: Path) -> Iterator[Path]:
    """Yield the files that *source* names, and those that they name, each once."""
    seen = {source}
    waiting = [source]
    while waiting:
        path = waiting.pop()
        for name in _PATH.findall(path.read_text()):
            relative = PurePosixPath(name.removeprefix(f"{_SOURCES}/"))
            target = (path.parent / relative).resolve()
            found = sorted(target.iterdir()) if target.is_dir() else [target]
            for each in found:
                if each.is_file() and each.is_relative_to(_folder()) and each not in seen:
                    seen.add(each)
                    waiting.append(each)
                    yield each
