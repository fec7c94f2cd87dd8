"""Build hook of hatchling: compile ``eap/cyclic`` where a compiler is.

| build | result |
|---|---|
| of a wheel | a wheel for this architecture and CPython 3.11 or later, with the compiled part |
| editable, as `make setup` does | ``eap/_cyclic.abi3.so`` in the tree, which git ignores |
| without a compiler or the headers of Python | a wheel for all; Python does everything |

``EAP_PURE=1`` builds nothing, ``EAP_COMPILED=1`` makes a failure fatal.  ``CC`` and ``CFLAGS`` are
as usual.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCES = "eap/cyclic"
TARGET = "eap/_cyclic.abi3.so"
_LIMITED_API = "0x030B0000"
_TAG = "cp311-abi3"


class CompiledPartHook(BuildHookInterface[Any]):
    """Adds the compiled part to a wheel, or puts it into the tree."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and say what the wheel is for; *version* is standard or editable."""
        self._folder = tempfile.mkdtemp(prefix="eap-compiled-")
        root = Path(self.root)
        is_editable = version == "editable"
        target = root / TARGET if is_editable else Path(self._folder, Path(TARGET).name)
        if is_editable:
            target.unlink(missing_ok=True)  # nothing old stays where nothing new can be built
        if os.environ.get("EAP_PURE", "0") not in {"", "0"}:
            return
        try:
            compile_part(root, target)
        except (OSError, subprocess.CalledProcessError) as exc:
            if os.environ.get("EAP_COMPILED", "0") not in {"", "0"}:
                raise
            self.app.display_warning(f"{SOURCES} was not compiled, so Python does its work: {exc}")
            return
        if is_editable:
            return
        build_data["force_include"][str(target)] = TARGET
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"{_TAG}-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was made for the wheel."""
        del version, build_data, artifact_path
        shutil.rmtree(self._folder, ignore_errors=True)


def compile_part(root: Path, target: Path) -> None:
    """Compile the sources below *root* to *target*; the same sources give the same bytes.

    Raises:
        OSError: there is no compiler.
        subprocess.CalledProcessError: it failed; its own message is on stderr.
    """
    compiler = shlex.split(os.environ.get("CC", "cc"))
    flags = ["-O2", "-g0", "-Wall", "-shared", "-fPIC", "-fvisibility=hidden", "-fwrapv"]
    flags.append("-ffp-contract=off")  # numbers are those of Python, bit by bit
    flags += ["-fno-plt", "-Wl,-z,now"]  # many calls of Python's functions, each once a cycle
    include = sysconfig.get_path("include")
    # Beside the target and renamed: a process that runs has the old one mapped.
    made = target.with_name(f".{target.name}.{os.getpid()}")
    command = [*compiler, *flags, *shlex.split(os.environ.get("CFLAGS", ""))]
    command += [f"-DPy_LIMITED_API={_LIMITED_API}", "-I", include, "-o", str(made)]
    command += sorted(str(file.relative_to(root)) for file in (root / SOURCES).glob("*.c"))
    try:
        subprocess.run(command, cwd=root, check=True)
        made.replace(target)
    finally:
        made.unlink(missing_ok=True)
