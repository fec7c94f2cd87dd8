"""Check the shape of the tree: what no linter of single files sees.

Rules: the top level holds only what ``docs/architecture.md`` allows; modules stay under 700 lines;
``tests/unit`` and ``tests/tools`` hold test files, in folders named after what they test;
nothing that is true of one machine only is committed; unfinished work names its issue; tasks have
an owner that keeps and reports them; docstrings name the thing; the files and modules that pages
name exist.

    python tools/check_tree.py [ROOT]

Prints one line a violation, ``file:line: what, what was expected``; exits with 1 if there is any.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

TOP_LEVEL = frozenset(
    {
        ".ci",
        ".github",
        ".gitignore",
        "CHANGELOG.md",
        "CONTRIBUTING.md",
        "LICENSE",
        "Makefile",
        "README.md",
        "config",
        "devicebus",
        "deploy",
        "docs",
        "eap",
        "pyproject.toml",
        "tests",
        "tools",
    }
)
PACKAGES = ("eap", "devicebus")
MAX_LINES = 700
MIRRORS = (
    (PurePosixPath("tests/unit"), PurePosixPath("tests/unit")),
    (PurePosixPath("tests/tools"), PurePosixPath("tests")),
)
"""Folders of test files, and the part of their path that stands for the top level."""

# Written so that no pattern matches its own line.
FORBIDDEN = (
    (re.compile(r"(?<![\w.~-])/(?:work|root|home)/"), "a path of one machine", "a relative path"),
    (
        re.compile(
            r"\b(?:pypi|python[h]osted|npm[j]s)\.(?:org|com)\b|\b(?:deb|security|snapshot)\.debian\.org\b"
            r"|\bcrates\.io\b|\bproxy\.golang\.org\b"
        ),
        "the host of a package registry",
        "the package's name alone",
    ),
    (re.compile(r"\.\./shared\b"), "a file beside the repository", "a file of the repository"),
)
UNFINISHED = re.compile(r"\b(?:TO[D]O|FIX[M]E)\b(?!\W{0,3}#\d)")
NAMED = re.compile(r"`((?:tests|config|eap|devicebus|docs|tools)/[\w./-]*\w)/?`")
MODULE = re.compile(r"`((?:eap|devicebus)(?:\.[A-Za-z_]\w*)+)`")
PROGRAM = re.compile(r"`(?!(?:tests|eap|devicebus|docs|tools)/)(?:\w+/)*(\w+\.py)`")
LINK = re.compile(r"\]\(([^)\s:#]*)(?:#([\w-]+))?\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)
PAGES = ("CONTRIBUTING.md", "README.md")
"""Pages beside those in ``docs/``."""
QUESTION = re.compile(r'^\s*r?"""(?:What|Who(?:ever|m|se)?|How|Whether|Where|When|Why)\b')
LOOSE_TASK = re.compile(r"(?<!group)\.create_task\(|\bensure_future\(")
TASKS = ("services", "tasks.py")
"""The module that may start tasks, whatever package services is in."""
CODE_SUFFIXES = frozenset({"", ".py", ".sh", ".toml", ".yaml"})


class Violation(NamedTuple):
    """One broken rule; *line* 1 stands for the file as a whole."""

    path: PurePosixPath
    line: int
    what: str
    expected: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.what}, expected {self.expected}"


def list_files(root: Path) -> list[PurePosixPath]:
    """Name the files under version control or about to be; without git, all but generated ones."""
    command = [
        "git",
        "-C",
        str(root),
        "ls-files",
        "-z",
        "--cached",
        "--others",
        "--exclude-standard",
    ]
    try:
        listed = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        names = _walk(root)
    else:
        names = [PurePosixPath(name) for name in listed.split("\0") if name]
    return sorted(name for name in names if (root / name).is_file())


def _walk(root: Path) -> list[PurePosixPath]:
    found = []
    for path in root.rglob("*"):
        name = PurePosixPath(path.relative_to(root).as_posix())
        if not any(map(_is_generated, name.parts)):
            found.append(name)
    return found


def _is_generated(part: str) -> bool:
    if part in {".ci", ".github", ".gitignore"}:
        return False
    return (
        part.startswith(".")
        or part in {"__pycache__", "build", "dist", "node_modules"}
        or "egg-info" in part
    )


def check(root: Path) -> list[Violation]:
    """Return every violation in the tree under *root*, in the order of the files."""
    files = list_files(root)
    found = [*check_top_level(files), *check_unit_tests(files)]
    for name in files:
        data = (root / name).read_bytes()
        if b"\0" not in data:
            text = data.decode(errors="replace")
            found += check_text(name, text)
            if name.suffix == ".md" and name.parts[0] in {"docs", *PAGES}:
                found += check_named(root, name, text)
                found += check_programs(files, name, text)
                found += check_links(root, name, text)
    return sorted(found)


def check_top_level(files: list[PurePosixPath]) -> Iterator[Violation]:
    """Yield what stands at the top and does not belong there, each entry once."""
    for entry in sorted({name.parts[0] for name in files} - TOP_LEVEL):
        first = next(name for name in files if name.parts[0] == entry)
        yield Violation(
            first, 1, f"{entry!r} at the top level", "a known one (untracked: remove it)"
        )


def check_unit_tests(files: list[PurePosixPath]) -> Iterator[Violation]:
    """Yield files in the mirrors that are no tests, or whose folder mirrors no package."""
    folders = {name.parent for name in files if not name.is_relative_to("tests")}
    for mirror, top in MIRRORS:
        for name in files:
            if not name.is_relative_to(mirror) or name.suffix != ".py" or name.stem == "conftest":
                continue
            if not name.name.startswith("test_"):
                yield Violation(name, 1, "no test file", "helpers of tests in tests/support")
            elif name.parent != mirror and name.parent.relative_to(top) not in folders:
                yield Violation(name, 1, "a unit test of no package", "its package's folder")


def check_text(name: PurePosixPath, text: str) -> Iterator[Violation]:
    """Yield what one file's text breaks: its length, its paths and hosts, its loose ends."""
    lines = text.splitlines()
    is_module = name.suffix == ".py" and name.parts[0] in {*PACKAGES, "tools"}
    if is_module and len(lines) > MAX_LINES:
        expected = f"at most {MAX_LINES}: split it by what it does"
        yield Violation(name, MAX_LINES + 1, f"{len(lines)} lines", expected)
    is_bound = name.suffix == ".py" and name.parts[0] in PACKAGES and name.parts[-2:] != TASKS
    for number, line in enumerate(lines, 1):
        if is_bound and LOOSE_TASK.search(line):
            yield Violation(name, number, "a task without an owner", "a TaskGroup or a TaskSet")
        if name.suffix == ".py" and QUESTION.search(line):
            yield Violation(name, number, "a docstring that asks", "the thing's name, or a verb")
        for pattern, what, expected in FORBIDDEN:
            if match := pattern.search(line):
                yield Violation(name, number, f"{what} ({match[0]})", expected)
        if name.suffix in CODE_SUFFIXES and (match := UNFINISHED.search(line)):
            yield Violation(name, number, f"{match[0]} without an issue", f"{match[0]} #12 or none")


def check_named(root: Path, page: PurePosixPath, text: str) -> Iterator[Violation]:
    """Yield the files, folders and modules that a page names and that do not exist."""
    for number, line in enumerate(text.splitlines(), 1):
        for match in NAMED.finditer(line):
            if not (root / match[1]).exists():
                yield Violation(page, number, f"{match[1]} does not exist", "where it is now")
        for match in MODULE.finditer(line):
            if not _is_module(root, match[1]):
                yield Violation(page, number, f"no module {match[1]}", "where it is now")


def check_programs(
    files: list[PurePosixPath], page: PurePosixPath, text: str
) -> Iterator[Violation]:
    """Yield the Python files that a page names by their last parts and that do not exist."""
    names = {name.name for name in files}
    for number, line in enumerate(text.splitlines(), 1):
        for match in PROGRAM.finditer(line):
            if match[1] not in names:
                yield Violation(page, number, f"no file {match[1]}", "where it is now")


def check_links(root: Path, page: PurePosixPath, text: str) -> Iterator[Violation]:
    """Yield the links of a page to files and headings that do not exist."""
    for number, line in enumerate(text.splitlines(), 1):
        for match in LINK.finditer(line):
            file, anchor = match.groups()
            target = root / page.parent / file if file else root / page
            is_found = target.exists() and (not anchor or anchor in _anchors(target))
            if not is_found:
                yield Violation(page, number, f"no target {match[0][2:-1]}", "where it is now")


def _anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    kept = (
        re.sub(r"[^\w\- ]", "", found[1].lower()) for found in HEADING.finditer(page.read_text())
    )
    return {each.replace(" ", "-") for each in kept}


def _is_module(root: Path, name: str) -> bool:
    """Return whether *name* is a module, a package, or a name in one of them."""
    path = root / name.replace(".", "/")
    if path.is_dir() or path.with_suffix(".py").is_file():
        return True
    definition = re.compile(rf"^(?:def|class) {path.name}\b|^{path.name}\b *[:=]", re.MULTILINE)
    owners = (path.parent.with_suffix(".py"), path.parent / "__init__.py")
    return any(each.is_file() and definition.search(each.read_text()) for each in owners)


def main(arguments: list[str]) -> int:
    """Print the violations; return the exit status."""
    root = Path(arguments[0]) if arguments else Path(__file__).resolve().parent.parent
    found = check(root)
    for violation in found:
        print(violation)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
