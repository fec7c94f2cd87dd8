"""Unmodified npm packages as peers: those of ``tests/peers/package.json``, run by node."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

PEERS = Path(__file__).parents[1] / "peers"
NODE_MODULES = PEERS / "node_modules"
"""Folder of the installed packages."""


def needs_npm(*packages: str) -> pytest.MarkDecorator:
    """Skip a test where node or one of *packages* in the declared version is missing."""
    reason = _lacks(packages)
    return pytest.mark.skipif(reason is not None, reason=reason or "")


def node_environment() -> dict[str, str]:
    """Return an environment in which node's ``require`` finds the packages."""
    return {**os.environ, "NODE_PATH": str(NODE_MODULES)}


def _lacks(packages: tuple[str, ...]) -> str | None:
    if shutil.which("node") is None:
        return "needs node; to install: apt-get install nodejs npm"
    declared = json.loads((PEERS / "package.json").read_text())["dependencies"]
    for name in packages:
        manifest = NODE_MODULES / name / "package.json"
        found = json.loads(manifest.read_text())["version"] if manifest.exists() else None
        if found != declared[name]:
            return f"needs {name} {declared[name]} of npm; to install: tools/install_peers.sh test"
    return None
