"""Check a release, and print its section of the changelog.

    python tools/package/release.py [TAG]

TAG is ``v`` and the version of ``eap/release.py``.  ``CHANGELOG.md`` has a section of that version
with a date, and none that is empty.  Without TAG the tag must not exist yet.  Nothing but the
standard library is needed.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_SECTION = re.compile(
    r"^## \[(?P<version>[^\]]+)\](?: - (?P<date>\d{4}-\d\d-\d\d))?$", re.MULTILINE
)


class ReleaseError(Exception):
    """The tree is not ready for the release."""


def notes(root: Path, tag: str | None) -> str:
    """Return the section of the changelog for the release of the tree at *root*.

    Raises:
        ReleaseError: tag, version and changelog contradict each other.
    """
    text = (root / "eap/release.py").read_text()
    (release,) = re.findall(r'^RELEASE = "(.+)"$', text, re.MULTILINE)
    if tag is not None and tag != f"v{release}":
        raise ReleaseError(f"tag {tag}: eap/release.py says {release}; change one of them")
    if tag is None and f"v{release}" in _tags(root):
        raise ReleaseError(f"tag v{release} exists: raise the version in eap/release.py")
    changelog = (root / "CHANGELOG.md").read_text()
    sections = list(_SECTION.finditer(changelog))
    for section, following in zip(sections, [*sections[1:], None], strict=True):
        if section["version"] == release:
            end = following.start() if following else len(changelog)
            found = changelog[section.end() : end].strip()
            if not section["date"] or not found:
                raise ReleaseError(f"CHANGELOG.md: section {release} has no date or no lines")
            return found
    raise ReleaseError(
        f"CHANGELOG.md has no section {release}: rename the one of unreleased changes to"
        f" '## [{release}] - YYYY-MM-DD'"
    )


def _tags(root: Path) -> list[str]:
    command = ["git", "-C", str(root), "tag", "--list"]
    return subprocess.run(command, capture_output=True, check=True, text=True).stdout.split()


def main(arguments: list[str]) -> int:
    """Print the section; return the exit status."""
    try:
        print(notes(ROOT, arguments[0] if arguments else None))
    except ReleaseError as exc:
        print(exc, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
