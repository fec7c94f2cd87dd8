"""``eapctl routes import`` and ``export``."""

from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from tests.support.controlstub import ControlStub
from tests.support.fakeroutes import FakeRoutes


@pytest.fixture
def stub(runtime):
    fake = FakeRoutes()
    with ExitStack() as stack:
        yield ControlStub("line", list(fake.stations), fake.table(), stack)


def routes(*words, given=None):
    return CliRunner().invoke(main, ["routes", *words], input=given)


def test_import(stub, tmp_path):
    file = tmp_path / "StaticRoutes.xml"
    file.write_text("<TcConfig/>")
    result = routes("import", "island-01", str(file), "--dry-run")
    assert result.exit_code == 0
    assert "Would be added" in result.output
    assert stub.requests[-1][1] == {"station": "island-01", "xml": "<TcConfig/>", "dry_run": True}
    result = routes("import", "island-01", str(file))
    assert "ams-tcp:192.168.1.5" in result.output
    assert not stub.requests[-1][1]["dry_run"]


def test_import_of_what_cannot_be_added(stub):
    result = routes("import", "island-01", "-", "--json", given="<bad/>")
    assert result.exit_code == 1
    assert json.loads(result.output)["reason"] == "type 'PROFIBUS', expected TCP_IP"


def test_import_of_what_is_no_text(stub):
    result = routes("import", "island-01", "-", given=b"<?xml version='1.0'?>\xff")
    assert result.exit_code == 1
    assert "-: 'utf-8' codec can't decode" in result.stderr
    assert stub.requests == []


def test_export(stub, tmp_path):
    result = routes("export", "island-01")
    assert result.stdout == "<TcConfig>island-01</TcConfig>\n"
    assert result.stderr == "island-01: routes without AMS/TCP are not exported: island-02\n"
    file = tmp_path / "out.xml"
    result = routes("export", "island-01", str(file))
    assert result.stdout == f"{file}: AMS/TCP routes of island-01 written\n"
    assert file.read_text() == "<TcConfig>island-01</TcConfig>\n"
