"""The tree check, on small trees made for it."""

from __future__ import annotations

import subprocess
from pathlib import Path, PurePosixPath

import pytest

from tools.check_tree import MAX_LINES, check, check_text, list_files, main

TWO_DOTS = ".."


def grow(root: Path, *names: str, text: str = "") -> Path:
    for name in names:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def found(root: Path) -> list[str]:
    return [str(violation) for violation in check(root)]


def test_clean_tree_has_no_findings(tmp_path):
    grow(tmp_path, "README.md", ".ci/run", "eap/__init__.py", "eap/ids.py", "eap/pd/a.py")
    grow(tmp_path, "tests/unit/eap/test_ids.py", "tests/unit/eap/pd/test_a.py")
    grow(tmp_path, "tests/unit/conftest.py", "tests/support/link.py", "docs/picture.svg")

    assert found(tmp_path) == []
    assert main([str(tmp_path)]) == 0


def test_every_finding_is_one_line_and_the_status_is_1(tmp_path, capsys):
    grow(tmp_path, "notes.txt", "eap/ids.py", "tests/unit/eap/helper.py")

    assert main([str(tmp_path)]) == 1

    assert capsys.readouterr().out.splitlines() == [
        "notes.txt:1: 'notes.txt' at the top level, expected a known one (untracked: remove it)",
        "tests/unit/eap/helper.py:1: no test file, expected helpers of tests in tests/support",
    ]


def test_a_foreign_directory_is_reported_once(tmp_path):
    grow(tmp_path, "vendor/a.txt", "vendor/b.txt")
    assert found(tmp_path) == [
        "vendor/a.txt:1: 'vendor' at the top level, expected a known one (untracked: remove it)"
    ]


def test_missing_file_named_in_page_is_reported(tmp_path):
    grow(tmp_path, "tools/demo.py", "eap/pd/__init__.py")
    text = "`tools/demo.py`, `eap/pd/` show it\n`make demo` and `tests/unit/eap/test_gone.py`, too"
    grow(tmp_path, "docs/features.md", text=text)
    assert found(tmp_path) == [
        "docs/features.md:2: tests/unit/eap/test_gone.py does not exist, expected where it is now"
    ]


def test_missing_program_named_in_page_is_reported(tmp_path):
    grow(tmp_path, "tools/demo.py", "README.md", text="`demo.py`, `python -m x`\nand `gone.py`")
    assert found(tmp_path) == ["README.md:2: no file gone.py, expected where it is now"]


def test_broken_link_in_page_is_reported(tmp_path):
    grow(tmp_path, "docs/ads.md", text="# `ADS`: states, objects\n")
    links = "[a](docs/ads.md), [b](docs/ads.md#ads-states-objects), [c](https://example.org/#x)\n"
    grow(tmp_path, "README.md", text=f"{links}[d](docs/gone.md), [e](docs/ads.md#gone), [f](#gone)")
    assert found(tmp_path) == [
        f"README.md:2: no target {name}, expected where it is now"
        for name in ("#gone", "docs/ads.md#gone", "docs/gone.md")
    ]


def test_missing_module_named_in_page_is_reported(tmp_path):
    grow(tmp_path, "eap/pd/image.py", text="LIMIT = 1\n\nclass Image: ...\n\ndef open_it(): ...\n")
    grow(tmp_path, "eap/__init__.py", text="def attach(): ...\n")
    text = "`eap.pd`, `eap.pd.image`, `eap.pd.image.Image`, `eap.pd.image.LIMIT`, `eap.attach`\n"
    grow(
        tmp_path, "CONTRIBUTING.md", text=text + "`eap.pd.gone`, `eap.pd.image.Gone`, `devicebus.x`"
    )
    assert found(tmp_path) == [
        f"CONTRIBUTING.md:2: no module {name}, expected where it is now"
        for name in ("devicebus.x", "eap.pd.gone", "eap.pd.image.Gone")
    ]


def test_unit_test_in_a_folder_of_no_package_is_reported(tmp_path):
    grow(
        tmp_path, "eap/pd/a.py", "tests/unit/eap/pd/test_several.py", "tests/unit/eap/od/test_a.py"
    )
    assert found(tmp_path) == [
        "tests/unit/eap/od/test_a.py:1: a unit test of no package, expected its package's folder"
    ]


def test_test_of_tools_in_a_folder_of_no_tool_is_reported(tmp_path):
    grow(tmp_path, "tools/bench/a.py", "tests/tools/bench/test_a.py", "tests/tools/gone/test_a.py")
    assert found(tmp_path) == [
        "tests/tools/gone/test_a.py:1: a unit test of no package, expected its package's folder"
    ]


def test_helper_among_unit_tests_is_reported(tmp_path):
    grow(tmp_path, "eap/ids.py", "tests/unit/eap/helper.py")
    assert found(tmp_path) == [
        "tests/unit/eap/helper.py:1: no test file, expected helpers of tests in tests/support"
    ]


def test_too_long_module_of_tools_is_reported(tmp_path):
    grow(tmp_path, "tools/short.py", text="x = 1\n" * MAX_LINES)
    grow(tmp_path, "tools/long.py", text="x = 1\n" * (MAX_LINES + 1))
    assert found(tmp_path) == [
        "tools/long.py:701: 701 lines, expected at most 700: split it by what it does"
    ]


def test_length_of_tests_and_texts_is_free(tmp_path):
    grow(tmp_path, "docs/long.md", "tests/integration/test_long.py", text="\n" * 1000)
    assert found(tmp_path) == []


@pytest.mark.parametrize(
    "line",
    [
        "see /wor" + "k/main/x",
        'PATH="/hom' + 'e/jane/bin"',
        "(/roo" + "t/x)",
        f"see {TWO_DOTS}/shared/spec",
        "pip install -i https://py" + "pi.org/simple x",
        "Get http://de" + "b.debian.org/debian",
        "registry.np" + "mjs.org",
    ],
)
def test_text_of_one_machine_is_reported(line):
    violations = list(check_text(PurePosixPath("docs/x.md"), f"\n{line}\n"))
    assert [violation.line for violation in violations] == [2]


@pytest.mark.parametrize(
    "line",
    ["net/work/x", "./home/x", "https://example.org/a", f"{TWO_DOTS}/sharedness", "~/work/x"],
)
def test_similar_text_is_not_reported(line):
    assert list(check_text(PurePosixPath("docs/x.md"), line)) == []


@pytest.mark.parametrize(
    ("line", "is_fine"),
    [
        ("# TO" + "DO: later", False),
        ("# FIX" + "ME later", False),
        ("# TO" + "DO(#12): later", True),
        ("# TO" + "DO #12 later", True),
        ("AUTO" + "DOC", True),
    ],
)
def test_unfinished_work_names_its_issue(line, is_fine):
    assert (list(check_text(PurePosixPath("eap/x.py"), line)) == []) == is_fine


def test_a_page_may_talk_about_unfinished_marks():
    assert list(check_text(PurePosixPath("CONTRIBUTING.md"), "no TO" + "DO")) == []


@pytest.mark.parametrize(
    ("path", "line", "is_fine"),
    [
        ("eap/net/a.py", "group.create_task(serve())", True),
        ("eap/net/a.py", "self._group.create_task(serve())", True),
        ("eap/net/a.py", "asyncio.get_running_loop().create_task(serve())", False),
        ("eap/net/a.py", "loop.create_task(serve())", False),
        ("eap/net/a.py", "asyncio.ensure_future(serve())", False),
        ("eap/services/tasks.py", "asyncio.get_running_loop().create_task(work)", True),
        ("tests/support/a.py", "loop.create_task(serve())", True),
    ],
)
def test_task_without_an_owner_is_reported(path, line, is_fine):
    assert [each.what for each in check_text(PurePosixPath(path), line)] == (
        [] if is_fine else ["a task without an owner"]
    )


@pytest.mark.parametrize(
    ("word", "is_fine"),
    [("What the bus tells.", False), ("Whoever asks.", False), ("How long.", False),
     ("True if the bus is up.", True), ("Whole objects of a slave.", True)],
)  # fmt: skip
def test_docstring_that_begins_with_a_question_word_is_reported(word, is_fine):
    line = '    r"' + f'""{word}"""'
    assert [each.what for each in check_text(PurePosixPath("eap/net/a.py"), line)] == (
        [] if is_fine else ["a docstring that asks"]
    )


def test_binary_files_are_not_read_as_text(tmp_path):
    grow(tmp_path, "tests/vectors/a.pcap", text="\0 /wor" + "k/x")
    assert found(tmp_path) == []


def test_without_git_generated_files_are_left_out(tmp_path):
    grow(tmp_path, "eap/a.py", ".venv/x.py", "eap/__pycache__/a.pyc", "eap_appliance.egg-info/x")
    assert list_files(tmp_path) == [PurePosixPath("eap/a.py")]


def test_with_git_ignored_and_deleted_files_are_left_out(tmp_path):
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    grow(tmp_path, ".gitignore", text="scratch\n")
    grow(tmp_path, "scratch", "README.md", "gone.md")
    subprocess.run(["git", "-C", tmp_path, "add", "."], check=True)
    (tmp_path / "gone.md").unlink()
    grow(tmp_path, "docs/new.md")

    names = [".gitignore", "README.md", "docs/new.md"]
    assert list_files(tmp_path) == [PurePosixPath(name) for name in names]
