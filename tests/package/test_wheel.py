"""The wheel and the archive of sources, installed as users do, outside of the project."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DIST = ROOT / "dist"

pytestmark = [pytest.mark.net, pytest.mark.timeout(600)]


def built(pattern: str) -> Path:
    found = list(DIST.glob(pattern))
    if not found:
        pytest.skip(f"no {pattern} in dist/: make dist")
    return max(found, key=lambda path: path.stat().st_mtime)


def run(folder: Path, *words: str | Path, code: int = 0) -> str:
    """Run a program that sees nothing of the project; return its output."""
    environment = {
        "PATH": "/usr/bin:/bin",
        "HOME": str(folder),
        "EAP_RUNTIME_DIR": str(folder / "run"),
        # Where packages come from is the user's business.
        "XDG_CONFIG_HOME": os.environ.get("XDG_CONFIG_HOME", str(Path.home() / ".config")),
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "PIPX_HOME": str(folder / "pipx"),
        "PIPX_BIN_DIR": str(folder / "bin"),
        **{name: each for name, each in os.environ.items() if name.startswith(("PIP_", "http"))},
    }
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=500
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def use(folder: Path, eapctl: Path) -> None:
    """Make a plant of an example, check it and run it."""
    line = folder / "line.yaml"
    run(folder, eapctl, "new", "line.yaml", "--from", "demo")
    assert line.read_text().startswith("# yaml-language-server: $schema=file://")
    schema = line.read_text().splitlines()[0].partition("file://")[2]
    assert json.loads(Path(schema).read_text())["title"] == "Plant file"
    assert "no errors (plant line: 3 stations" in run(folder, eapctl, "check", "line.yaml")
    command = [eapctl, "run", "line.yaml", "--no-realtime"]
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder), "EAP_RUNTIME_DIR": f"{folder}/run"}
    with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE) as plant:
        try:
            assert plant.stdout is not None
            assert json.loads(plant.stdout.readline())["ready"] is True
            assert "island-03  OP" in run(folder, eapctl, "status")
        finally:
            plant.terminate()


def environment_in(folder: Path, what: str, *, compiler: str = "cc") -> Path:
    """Return eapctl of a clean environment with *what*."""
    run(folder, sys.executable, "-m", "venv", folder / "venv")
    install = ("env", f"CC={compiler}", folder / "venv/bin/pip", "install", "--quiet")
    run(folder, *install, what)
    return folder / "venv/bin/eapctl"


def test_wheel_of_the_same_commit_has_the_same_bytes(tmp_path):
    time = subprocess.run(
        ["git", "log", "-1", "--format=%ct"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.strip()
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d"]
    environment = os.environ | {"SOURCE_DATE_EPOCH": time}
    for name in ("one", "other"):
        subprocess.run([*command, tmp_path / name], cwd=ROOT, env=environment, check=True)
    one, other = (next((tmp_path / name).glob("*.whl")) for name in ("one", "other"))
    assert one.name == other.name
    digests = {hashlib.sha256(path.read_bytes()).hexdigest() for path in (one, other)}
    assert len(digests) == 1


def test_wheel_in_a_clean_environment_runs_a_plant(tmp_path):
    wheel = built("*.whl")
    eapctl = environment_in(tmp_path, str(wheel))
    (product,) = distributions(path=[str(wheel)])
    is_compiled = "-abi3-" in wheel.name
    assert run(tmp_path, eapctl, "--version") == says(product.version, is_compiled=is_compiled)
    use(tmp_path, eapctl)
    # What is not installed is named with its extra.
    assert "eap-appliance[web]" in run(tmp_path, eapctl, "web", "line.yaml", code=2)
    on_terminal = ("script", "-qec", f"{eapctl} routes", "/dev/null")
    assert "eap-appliance[tui]" in run(tmp_path, *on_terminal, code=2)


def test_all_extras_are_in_all():
    (product,) = distributions(path=[str(built("*.whl"))])
    of_extras: dict[str, set[str]] = {}
    for text in product.requires or ():
        needs, _, condition = text.partition("; extra == ")
        of_extras.setdefault(condition.strip("'\""), set()).add(needs)
    assert set(of_extras) == {"", *product.metadata.get_all("Provides-Extra")}
    whole = of_extras.pop("all")
    assert whole == set().union(*(needs for extra, needs in of_extras.items() if extra))


def test_archive_of_sources_installs_the_same_version(tmp_path):
    wheel = built("*.whl")
    (product,) = distributions(path=[str(wheel)])
    eapctl = environment_in(tmp_path, str(built("*.tar.gz")))
    is_compiled = "-abi3-" in wheel.name
    assert run(tmp_path, eapctl, "--version") == says(product.version, is_compiled=is_compiled)
    run(tmp_path, eapctl, "new", "x.yaml", "--from", "valve")
    assert "no errors" in run(tmp_path, eapctl, "check", "x.yaml")


def test_archive_of_sources_runs_a_plant_where_no_compiler_is(tmp_path):
    (product,) = distributions(path=[str(built("*.whl"))])
    eapctl = environment_in(tmp_path, str(built("*.tar.gz")), compiler="no-compiler-here")
    assert run(tmp_path, eapctl, "--version") == says(product.version, is_compiled=False)
    use(tmp_path, eapctl)


def says(version: str, *, is_compiled: bool) -> str:
    return f"eapctl {version} (cyclic path {'compiled' if is_compiled else 'in Python'})\n"


def test_pipx_installs_the_wheel_with_extras(tmp_path):
    if shutil.which("pipx") is None:
        pytest.skip("needs pipx; to install: apt-get install pipx")
    run(tmp_path, "pipx", "install", "--python", sys.executable, f"{built('*.whl')}[web]")
    use(tmp_path, tmp_path / "bin/eapctl")
    run(tmp_path, tmp_path / "pipx/venvs/eap-appliance/bin/python", "-c", "import aiohttp")
