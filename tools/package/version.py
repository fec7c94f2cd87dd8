"""Version of a build: the release, and how far the commit is from it.

hatchling runs this file when it builds a wheel or an archive of sources (``pyproject.toml``).

| commit | version |
|---|---|
| tag ``v0.2.0``, as ``eap/release.py`` says | 0.2.0 |
| 12 commits behind the tag before, which is ``v0.1.0`` | 0.2.0.dev12+g5d52352 |
| 3 commits behind the tag of the release itself | 0.2.0.post3+g5d52352 |
| with changes that are not committed | the same, and ``.dirty`` |

An archive of sources has the version that it was built with.  Without git and without that, the
version is the release.
"""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_DESCRIBED = re.compile(
    r"(?:v(?P<tag>.+)-(?P<behind>\d+)-g)?(?P<commit>[0-9a-f]+)(?P<dirty>-dirty)?"
)


class VersionError(Exception):
    """The tag of the commit contradicts the release."""


def version(root: Path = ROOT) -> str:
    """Return the version of the tree at *root*.

    Raises:
        VersionError: the commit has the tag of another release.
    """
    archive = root / "PKG-INFO"
    if archive.exists():
        return _field(archive.read_text(), r"^Version: (.+)$")
    release = _field((root / "eap/release.py").read_text(), r'^RELEASE = "(.+)"$')
    if not (root / ".git").exists():
        return release
    described = _DESCRIBED.fullmatch(
        _git(root, "describe", "--tags", "--long", "--always", "--dirty", "--abbrev=8",
             "--match", "v[0-9]*")
    )  # fmt: skip
    if described is None:
        return release
    tag, commit, dirty = described["tag"], described["commit"], described["dirty"]
    behind = int(described["behind"] or _git(root, "rev-list", "--count", "HEAD"))
    if tag and not behind and tag != release:
        raise VersionError(f"the commit has the tag v{tag}, but eap/release.py says {release}")
    if tag and not behind and not dirty:
        return release
    kind = "post" if tag == release else "dev"
    return f"{release}.{kind}{behind}+g{commit}{'.dirty' if dirty else ''}"


def commit_time(root: Path = ROOT) -> int:
    """Return the Unix time of the commit: that of all files of reproducible packages."""
    return int(_git(root, "log", "-1", "--format=%ct"))


def _field(text: str, pattern: str) -> str:
    (found,) = re.findall(pattern, text, re.MULTILINE)[:1]
    return str(found)


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *words], capture_output=True, check=True, text=True
    )
    return done.stdout.strip()
