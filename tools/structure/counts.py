"""Numbers of a checkout's source: modules, code lines, importers, class names, tests."""

from __future__ import annotations

import ast
import io
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

PACKAGES = ("eap", "devicebus")
SMALL = 40
"""Code lines of which a module should have more."""

_LAYOUT = frozenset(
    {
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    }
)
_DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
_CHECKS = frozenset({"raises", "warns"})


@dataclass(frozen=True)
class Row:
    """One number, and the names behind it."""

    title: str
    value: str
    names: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Module:
    """One source file."""

    name: str
    tree: ast.Module
    code_lines: int
    comment_lines: int


def count(root: Path) -> list[Row]:
    """Return the numbers of the checkout in *root*."""
    modules = [read_module(root, path) for package in PACKAGES for path in _sources(root / package)]
    code_lines = sum(module.code_lines for module in modules)
    comment_lines = sum(module.comment_lines for module in modules)
    tests = [ast.parse(path.read_bytes()) for path in _sources(root / "tests")]
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    doubles = find_doubles(modules)
    return [
        Row("modules", f"{len(modules)}"),
        Row("code lines", f"{code_lines}"),
        Row("comment lines of 100 code lines", f"{100 * comment_lines / code_lines:.1f}"),
        _listed(f"modules under {SMALL} code lines", find_small(modules)),
        _listed("modules with one importer", find_with_one_importer(modules)),
        _listed("class names used twice", [name for name in doubles if name[0] != "_"]),
        _listed("private class names used twice", [name for name in doubles if name[0] == "_"]),
        Row("import contracts", f"{len(settings['tool']['importlinter']['contracts'])}"),
        Row("test functions", f"{sum(map(count_test_functions, tests))}"),
        Row("assertions", f"{sum(map(count_assertions, tests))}"),
    ]


def _sources(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def _listed(title: str, names: Iterable[str]) -> Row:
    names = list(names)
    return Row(title, f"{len(names)}", names)


def read_module(root: Path, path: Path) -> Module:
    """Parse the file *path* of the checkout in *root*."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    code: set[int] = set()
    comments: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            comments.add(token.start[0])
        elif token.type not in _LAYOUT:
            code.update(range(token.start[0], token.end[0] + 1))
    code.difference_update(_docstring_lines(tree))
    parts = path.relative_to(root).with_suffix("").parts
    name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
    return Module(name, tree, len(code), len(comments))


def _docstring_lines(tree: ast.Module) -> Iterator[int]:
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            yield from range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)


def find_small(modules: Iterable[Module]) -> list[str]:
    """Name the fragments; a package's docstring is none."""
    return [module.name for module in modules if 0 < module.code_lines < SMALL]


def find_with_one_importer(modules: Iterable[Module]) -> list[str]:
    """Name what a single module of the project imports at its top level."""
    importers: dict[str, set[str]] = defaultdict(set)
    names = {module.name for module in modules}
    for module in modules:
        for imported in _imports(module.tree):
            found = imported if imported in names else imported.rpartition(".")[0]
            importers[found].add(module.name)
    return sorted(name for name in names if len(importers[name]) == 1)


def _imports(tree: ast.Module) -> Iterator[str]:
    """Yield what a module imports, with the names that it takes from it."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def find_doubles(modules: Iterable[Module]) -> list[str]:
    """Return each class name that is used more than once, with the modules that use it."""
    users: dict[str, list[str]] = defaultdict(list)
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef):
                users[node.name].append(module.name)
    return [f"{name}: {', '.join(found)}" for name, found in sorted(users.items()) if found[1:]]


def count_test_functions(tree: ast.Module) -> int:
    """Count the functions that pytest collects by their name, each once for all parameters."""
    return sum(
        isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
        for node in ast.walk(tree)
    )


def count_assertions(tree: ast.Module) -> int:
    """Count ``assert`` statements and expected exceptions and warnings."""
    return sum(
        isinstance(node, ast.Assert)
        or (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr in _CHECKS
        )
        for node in ast.walk(tree)
    )
