"""The container image: built by buildah from the recipe, and the demo run in it.

``make test-package`` builds the package first.  The clean Debian of the other tests stands for the
image of the registry that the recipe begins with.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.debianroot import archive

ROOT = Path(__file__).parents[2]
DIST = ROOT / "dist"
RECIPE = ROOT / "docs/examples/container/Containerfile"
BASE = "docker.io/library/debian:bookworm-slim"
RUN = """
eapctl run /etc/eap/demo.yaml --log json & plant=$!
for attempt in $(seq 60); do eapctl status >/dev/null 2>&1 && break; sleep 1; done
echo "user $(id -un), state $(stat -c %U $EAP_STATE_DIR)"
eapctl status --json >/dev/null; echo "health $?"
kill $plant; wait $plant; echo "end $?"
"""

pytestmark = [
    pytest.mark.net,
    pytest.mark.timeout(900),
    pytest.mark.skipif(
        shutil.which("buildah") is None,
        reason="needs buildah; to install: apt-get install buildah",
    ),
]

Buildah = Callable[..., str]


@pytest.fixture(scope="module")
def buildah(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Buildah]:
    """Run buildah with a store of its own, and without containers of the kernel."""
    folder = tmp_path_factory.mktemp("images")
    places = ["--root", str(folder / "store"), "--runroot", str(folder / "run")]
    environment = {**os.environ, "STORAGE_DRIVER": "vfs", "BUILDAH_ISOLATION": "chroot"}

    def run(*words: str) -> str:
        done = subprocess.run(
            ["buildah", *places, *words], capture_output=True, text=True, env=environment,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
        return done.stdout.strip()

    yield run
    shutil.rmtree(folder)


def test_image_of_the_recipe_runs_the_demo_as_its_user(buildah: Buildah) -> None:
    debian = archive()
    packages = sorted(DIST.glob("*.deb"), key=lambda path: path.stat().st_mtime)
    if not packages:
        pytest.skip("no package in dist/: make deb")
    base = buildah("from", "scratch")
    buildah("add", "--quiet", base, str(debian), "/")
    buildah("commit", "--quiet", "--rm", base, BASE)
    words = ["--pull-never", "--format", "docker", "--file", str(RECIPE), "--tag", "eap-appliance"]
    buildah("build", *words, str(DIST))
    container = buildah("from", "--pull-never", "localhost/eap-appliance")
    assert buildah("run", container, "--", "eapctl", "--version").startswith("eapctl ")
    lines = buildah("run", container, "--", "sh", "-c", RUN).splitlines()
    assert '{"ready":true,"stations":["island-01","island-02","island-03"]}' in lines
    assert lines[-3:] == ["user eap, state eap", "health 0", "end 0"]
