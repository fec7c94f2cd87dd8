"""Build the Debian package of the appliance.

    python -m tools.package.deb WHEEL [FOLDER]

Puts ``eap-appliance_VERSION_ARCH.deb`` and its bill of materials in FOLDER (``dist``), and prints
the path of the package.  The package is for the Python of this Debian, because extension modules
are: they are installed with all other dependencies below ``/usr/lib/eap-appliance``, where no other
program sees them.  The same commit and the same dependencies give the same bytes.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from importlib.metadata import distributions
from pathlib import Path

from click.shell_completion import get_completion_class

from eap.cli.group import main as eapctl
from eap.config.new_plant import SCHEMA, read_example
from tools.package import manpages, sbom
from tools.package.version import ROOT, commit_time

PYTHON = "/usr/bin/python3"
FILES = Path(__file__).with_name("files")
LIBRARY = "usr/lib/eap-appliance"
LEFT_OUT = {"all", "export"}
"""Extras that are not in the package: Parquet alone would more than double it."""
_PLACES = {
    "eapctl": ("usr/bin/eapctl", 0o755),
    "eap@.service": ("usr/lib/systemd/system/eap@.service", 0o644),
    "60-eap.rules": ("usr/lib/udev/rules.d/60-eap.rules", 0o644),
    "logrotate": ("etc/logrotate.d/eap-appliance", 0o644),
}
_SCRIPTS = ("postinst", "prerm", "postrm")
_COMPLETIONS = {
    "bash": "usr/share/bash-completion/completions/eapctl",
    "zsh": "usr/share/zsh/vendor-completions/_eapctl",
    "fish": "usr/share/fish/vendor_completions.d/eapctl.fish",
}
_DOC = "usr/share/doc/eap-appliance"
_CONTROL = """\
Package: eap-appliance
Version: {version}
Architecture: {architecture}
Maintainer: The EAP appliance developers <eap-appliance@localhost>
Installed-Size: {size}
Depends: adduser, libc6 (>= 2.28), python3 (>= {python}), python3 (<< {next_python})
Recommends: logrotate, systemd
Suggests: mosquitto, postgresql, prometheus
Section: net
Priority: optional
Description: EtherCAT Automation Protocol (ETG.1005) appliance
 Controllers exchange process data over plain Ethernet or UDP with the EtherCAT
 Automation Protocol, master to master.  One file describes a plant, and
 eap@PLANT.service runs it.  The package has the optional parts as well: live
 overview, pages for browsers, recordings, bridges.
"""


def build(wheel: Path, target: Path) -> Path:
    """Build the package of *wheel* in the folder *target*; return its path."""
    time = commit_time()
    with tempfile.TemporaryDirectory(prefix="eap-deb-") as folder:
        root = Path(folder) / "root"
        library = root / LIBRARY
        _install(wheel, library)
        version = _product_version(library)
        _add_files(root, version, time)
        control = _control(root, version)
        for name in _SCRIPTS:
            _put(root / "DEBIAN" / name, (FILES / name).read_bytes(), 0o755)
        _put(root / "DEBIAN/control", control.encode())
        _put(root / "DEBIAN/conffiles", _conffiles(root).encode())
        _put(root / "DEBIAN/md5sums", _md5sums(root).encode())
        _settle(root)
        name = f"eap-appliance_{debian_version(version)}_{_architecture()}"
        package = target / f"{name}.deb"
        target.mkdir(parents=True, exist_ok=True)
        # dpkg-deb takes later times of files down to this one.
        environment = os.environ | {"SOURCE_DATE_EPOCH": str(time)}
        command = ["dpkg-deb", "--root-owner-group", "-Zzstd", "--build", str(root), str(package)]
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        shutil.copyfile(root / _DOC / "sbom.cdx.json", target / f"{name}.cdx.json")
    return package


def debian_version(version: str) -> str:
    """Return a version as Debian orders it: a development version comes before its release."""
    return version.replace(".dev", "~dev").replace(".post", "+post")


def _install(wheel: Path, library: Path) -> None:
    """Install *wheel* with its dependencies for the Python of this Debian."""
    extras = ",".join(name for name in _extras(wheel) if name not in LEFT_OUT)
    command = [sys.executable, "-m", "pip", "--python", PYTHON, "install", "-qq"]
    options = [
        "--disable-pip-version-check",
        "--root-user-action=ignore",
        "--no-compile",
        "--only-binary=:all:",
        "--target",
    ]
    subprocess.run([*command, *options, str(library), f"{wheel.resolve()}[{extras}]"], check=True)
    shutil.rmtree(library / "bin", ignore_errors=True)
    for each in library.glob("*.dist-info"):
        for name in ("RECORD", "INSTALLER", "REQUESTED", "direct_url.json"):
            (each / name).unlink(missing_ok=True)  # paths and times of this build


def _extras(wheel: Path) -> list[str]:
    (found,) = distributions(path=[str(wheel)])
    return sorted(found.metadata.get_all("Provides-Extra", []))


def _product_version(library: Path) -> str:
    (found,) = distributions(name=sbom.PRODUCT, path=[str(library)])
    return found.version


def _add_files(root: Path, version: str, time: int) -> None:
    """Add starter, unit, man pages, completion, documentation and the first plant."""
    for name, (path, mode) in _PLACES.items():
        _put(root / path, (FILES / name).read_bytes(), mode)
    for name, text in manpages.pages(version, datetime.fromtimestamp(time, UTC).strftime("%F")):
        _put(root / f"usr/share/man/man1/{name}.gz", _gzip(text.encode()))
    for shell, path in _COMPLETIONS.items():
        kind = get_completion_class(shell)
        assert kind is not None  # noqa: S101  click has all three
        _put(root / path, kind(eapctl, {}, "eapctl", "_EAPCTL_COMPLETE").source().encode())
    _put(root / _DOC / "copyright", (ROOT / "LICENSE").read_bytes())
    _put(root / _DOC / "changelog.gz", _gzip((ROOT / "CHANGELOG.md").read_bytes()))
    _put(root / _DOC / "sbom.cdx.json", sbom.bill(root / LIBRARY).encode())
    schema = Path("/", LIBRARY, SCHEMA.relative_to(ROOT)).as_uri()
    for target, content in read_example("demo", "demo", Path("/etc/eap/demo.yaml")).items():
        _put(
            root / target.relative_to("/"),
            content.replace(SCHEMA.as_uri().encode(), schema.encode()),
        )


def _control(root: Path, version: str) -> str:
    size = sum(path.stat().st_size for path in root.rglob("*") if path.is_file())
    shown = subprocess.run([PYTHON, "-V"], capture_output=True, text=True, check=True).stdout
    major, minor = map(int, re.findall(r"\d+", shown)[:2])
    return _CONTROL.format(
        version=debian_version(version),
        architecture=_architecture(),
        size=-(-size // 1024),
        python=f"{major}.{minor}",
        next_python=f"{major}.{minor + 1}",
    )


def _architecture() -> str:
    command = ["dpkg", "--print-architecture"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def _files(root: Path) -> Iterator[Path]:
    for path in sorted(root.rglob("*")):
        if path.is_file() and not path.is_relative_to(root / "DEBIAN"):
            yield path


def _conffiles(root: Path) -> str:
    files = (path for path in _files(root) if path.is_relative_to(root / "etc"))
    return "".join(f"/{path.relative_to(root)}\n" for path in files)


def _md5sums(root: Path) -> str:
    return "".join(
        f"{hashlib.md5(path.read_bytes()).hexdigest()}  {path.relative_to(root)}\n"  # noqa: S324  dpkg's format
        for path in _files(root)
    )


def _settle(root: Path) -> None:
    """Give all files and folders rights that do not depend on who built them."""
    for path in (root, *root.rglob("*")):
        is_run = path.is_dir() or path.parent == root / "usr/bin" or path.name in _SCRIPTS
        path.chmod(0o755 if is_run else 0o644)


def _put(path: Path, content: bytes, mode: int = 0o644) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    path.chmod(mode)


def _gzip(content: bytes) -> bytes:
    return gzip.compress(content, mtime=0)


def main(arguments: list[str]) -> int:
    """Build the package; return the exit status."""
    wheel, *rest = arguments
    print(build(Path(wheel), Path(rest[0] if rest else "dist")))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
