"""The numbers of a small tree made for them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.structure.__main__ import main
from tools.structure.counts import PACKAGES, Row, count

ENGINE = '''"""The engine.

Two paragraphs.
"""

# A reason.
from eap.pd.image import Image  # another one

TEXT = """two
lines"""


class Engine:
    """A class."""

    def run(self) -> Image:
        """Run."""
        return Image()


class _Part: ...
'''
TEST = """def test_one():
    assert 1
    with pytest.raises(ValueError): int("x")

class TestTwo:
    async def test_two(self): assert (2 and
                                      3)

def helper(): assert 4
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    files = {
        "eap/__init__.py": '"""The package."""\n',
        "eap/engine.py": ENGINE,
        "eap/pd/__init__.py": "",
        "eap/pd/image.py": "class Image: pass\nclass _Part: pass\n",
        "eap/user.py": "import eap.engine\nfrom eap.pd import image\n",
        "devicebus/engine.py": "class Engine: pass\n" * 60,
        "tests/unit/test_engine.py": TEST,
        "pyproject.toml": "[[tool.importlinter.contracts]]\n[[tool.importlinter.contracts]]\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


@pytest.fixture
def rows(root: Path) -> dict[str, Row]:
    return {row.title: row for row in count(root)}


@pytest.mark.parametrize(
    ("title", "value"),
    [
        ("modules", "6"),
        ("code lines", "71"),
        ("comment lines of 100 code lines", "2.8"),
        ("import contracts", "2"),
        ("test functions", "2"),
        ("assertions", "4"),
    ],
)
def test_count_of_a_small_tree(rows: dict[str, Row], title: str, value: str) -> None:
    assert rows[title].value == value


def test_package_of_a_docstring_is_no_fragment(rows: dict[str, Row]) -> None:
    assert rows["modules under 40 code lines"].names == ["eap.engine", "eap.pd.image", "eap.user"]


def test_importers_are_counted_by_the_module_that_they_take_from(rows: dict[str, Row]) -> None:
    assert rows["modules with one importer"].names == ["eap.engine"]


def test_class_names_used_twice_are_listed_with_their_modules(rows: dict[str, Row]) -> None:
    (double,) = rows["class names used twice"].names
    assert double.startswith("Engine: eap.engine, devicebus.engine")
    assert rows["private class names used twice"].names == ["_Part: eap.engine, eap.pd.image"]


def test_checkouts_are_shown_side_by_side(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["-v", str(root), str(root)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["modules", "6", "6"]
    assert "    eap.pd.image" in lines


def test_packages_of_this_tree_are_those_counted() -> None:
    tree = Path(__file__).parents[3]
    assert {path.parent.name for path in tree.glob("*/__init__.py")} == set(PACKAGES)
