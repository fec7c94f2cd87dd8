"""The compiled part of the cyclic path, ``eap/cyclic``, where it was built.

Python code does the same, slower: it is the reference, and what the compiled part leaves to it.
``EAP_PURE=1`` in the environment of a process has it use Python alone.
"""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

_API = 10
"""Of the source; a file that was built from an older one is not used."""


def _find() -> ModuleType | None:
    try:
        found = import_module("eap._cyclic")
    except ImportError:  # not built, or refused because of EAP_PURE
        return None
    return found if found.API == _API else None


cyclic = _find()
"""The module, None without it."""


def override(target: object, method: str, compiled: object) -> None:
    """Have *compiled* called in place of a method of *target*; without compiled part it stays."""
    if compiled is not None:
        setattr(target, method, compiled)
