"""``eapctl routes add-remote``."""

from __future__ import annotations

import json
import os
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.controlstub import ControlStub

ADDED = {"ok": True, "result": 0, "text": "added"}
WRONG = {"ok": False, "result": 0x704, "text": "user or password is wrong"}


@pytest.fixture
def run(runtime):
    """Run the command against a station whose peer takes the password ``1``."""
    with ExitStack() as stack:
        methods = {
            "routes_add_remote": lambda params: ADDED if params["password"] == "1" else WRONG
        }
        stub = ControlStub("line", ["left"], methods, stack)

        def run_command(*words, typed=None, command="add-remote"):
            result = CliRunner().invoke(main, ["routes", command, *words], input=typed)
            asked = [params for method, params in stub.requests if method == "routes_add_remote"]
            return result, asked

        yield run_command


def test_add_remote_prompts_for_the_password(run):
    result, (asked,) = run("left", "10.0.0.5", "--user", "Administrator", typed="1\n")
    assert result.exit_code == 0
    assert result.output.endswith("10.0.0.5: added\n")
    assert asked == {
        "station": "left", "address": "10.0.0.5", "name": "", "user": "Administrator",
        "password": "1", "wait_ms": 5000,
    }  # fmt: skip


def test_a_password_comes_from_a_file(run, tmp_path):
    (tmp_path / "pw").write_text("1\r\nmore\n")
    words = ["--user", "x", "--password-file", str(tmp_path / "pw"), "--name", "ours"]
    result, (asked,) = run("left", "10.0.0.5", *words, "--json")
    assert json.loads(result.output) == ADDED
    assert (asked["password"], asked["name"]) == ("1", "ours")


def test_a_file_that_holds_no_password_is_an_error_in_words(run, tmp_path):
    (tmp_path / "pw").write_bytes(b"\xff\n")
    os.mkfifo(tmp_path / "pipe")
    for name, reason in (("pw", "its first line is not UTF-8"), ("pipe", "in a regular file")):
        words = ["--user", "x", "--password-file", str(tmp_path / name)]
        result, asked = run("left", "10.0.0.5", *words)
        assert (result.exit_code, asked) == (2, [])
        assert reason in result.stderr


def test_a_refusal_fails(run):
    result, _ = run("left", "10.0.0.5")
    assert result.exit_code == 1
    assert result.output == "10.0.0.5: user or password is wrong\n"


def test_add_remote_by_its_former_name_introduce_sends_the_same_request(run):
    results = [run("left", "10.0.0.5", "--user", "x", typed="1\n", command=command)
               for command in ("add-remote", "introduce")]  # fmt: skip
    (new, asked_new), (former, asked_former) = results
    assert (former.exit_code, former.output) == (new.exit_code, new.output)
    assert asked_former == 2 * asked_new
    assert "introduce" not in CliRunner().invoke(main, ["routes", "--help"]).output
