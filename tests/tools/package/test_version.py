"""Version of a build, in git repositories made for it."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from tools.package.release import ReleaseError, notes
from tools.package.version import VersionError, commit_time, version

CHANGELOG = """\
# Changelog

## [Unreleased]

## [0.2.0] - 2026-11-23

### Added

- More.

## [0.1.0] - 2026-10-01

- First.
"""


class Repository:
    def __init__(self, root: Path) -> None:
        self.root = root
        (root / "eap").mkdir()
        (root / "CHANGELOG.md").write_text(CHANGELOG)
        self.git("init", "--quiet")
        self.release("0.1.0")

    def git(self, *words: str) -> None:
        identity = ["-c", "user.name=t", "-c", "user.email=t@t", "-c", "commit.gpgsign=false"]
        environment = os.environ | {"GIT_COMMITTER_DATE": "2026-11-23T00:00:00Z"}
        command = ["git", "-C", str(self.root), *identity, *words]
        subprocess.run(command, check=True, capture_output=True, env=environment)

    def release(self, text: str) -> None:
        (self.root / "eap/release.py").write_text(f'RELEASE = "{text}"\n')
        self.git("add", "-A")
        self.git("commit", "--quiet", "-m", text)


@pytest.fixture
def repository(tmp_path):
    return Repository(tmp_path)


def test_version_of_a_tag_is_the_release_and_others_tell_their_distance(repository):
    root = repository.root
    assert re.fullmatch(r"0\.1\.0\.dev1\+g[0-9a-f]{8}", version(root))
    repository.git("tag", "v0.1.0")
    assert version(root) == "0.1.0"
    (root / "CHANGELOG.md").write_text("changed")
    assert re.fullmatch(r"0\.1\.0\.post0\+g[0-9a-f]{8}\.dirty", version(root))
    repository.git("commit", "--quiet", "-am", "after")
    assert re.fullmatch(r"0\.1\.0\.post1\+g[0-9a-f]{8}", version(root))
    repository.release("0.2.0")
    assert re.fullmatch(r"0\.2\.0\.dev2\+g[0-9a-f]{8}", version(root))
    assert commit_time(root) == 1795392000


def test_tag_of_another_release_is_refused(repository):
    repository.git("tag", "v0.3.0")
    with pytest.raises(VersionError, match=r"tag v0\.3\.0, but eap/release\.py says 0\.1\.0"):
        version(repository.root)


def test_archive_has_the_version_that_it_was_built_with(tmp_path):
    (tmp_path / "eap").mkdir()
    (tmp_path / "eap/release.py").write_text('RELEASE = "0.1.0"\n')
    assert version(tmp_path) == "0.1.0"
    (tmp_path / "PKG-INFO").write_text("Metadata-Version: 2.4\nVersion: 0.1.0.dev7+gabc\n")
    assert version(tmp_path) == "0.1.0.dev7+gabc"


def test_release_needs_its_section_and_a_new_tag(repository):
    root = repository.root
    assert notes(root, "v0.1.0") == notes(root, None) == "- First."
    repository.git("tag", "v0.1.0")
    with pytest.raises(ReleaseError, match="exists"):
        notes(root, None)
    with pytest.raises(ReleaseError, match=r"tag v0\.2\.0"):
        notes(root, "v0.2.0")
    repository.release("0.2.0")
    assert notes(root, "v0.2.0") == "### Added\n\n- More."
    (root / "CHANGELOG.md").write_text(CHANGELOG.replace(" - 2026-11-23", ""))
    with pytest.raises(ReleaseError, match="no date"):
        notes(root, "v0.2.0")
    (root / "CHANGELOG.md").write_text(CHANGELOG.replace("[0.2.0]", "[0.2.1]"))
    with pytest.raises(ReleaseError, match=r"no section 0\.2\.0"):
        notes(root, "v0.2.0")
