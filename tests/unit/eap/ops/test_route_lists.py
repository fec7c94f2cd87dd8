from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.errors import ControlError
from eap.ops.routing import list_routes, text_of_xml
from tests.support.controlstub import ControlStub
from tests.support.fakeroutes import FakeRoutes


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))


@pytest.fixture
def fake(runtime):
    routes = FakeRoutes()
    with ExitStack() as stack:
        ControlStub("line", list(routes.stations), routes.table(), stack)
        yield routes


def names(**more):
    (found,) = list_routes(None, "island-01", **more)
    return [row.name for row in found.stations[0].routes]


def test_pages_are_put_together(fake):
    fake.page = 1
    assert names() == ["island-02", "press"]
    assert names(most=1) == ["island-02"]
    assert names(match="press") == ["press"]


def test_routes_that_went_away_meanwhile_end_the_pages(fake):
    listed = fake.stations["island-01"]
    fake.page = 0
    assert names() == []
    assert listed.total == 2


def test_routes_without_an_appliance_are_refused(runtime):
    with pytest.raises(ControlError, match="no appliance runs"):
        list_routes(None, None)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "iso-8859-1"])
def test_files_in_their_encodings(encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><a>ü</a>'
    assert text_of_xml(text.encode(encoding)) == text


def test_files_in_none():
    assert text_of_xml("<a>ü</a>".encode()) == "<a>ü</a>"
    with pytest.raises(ValueError, match="unknown encoding: none"):
        text_of_xml(b'<?xml version="1.0" encoding="none"?><a/>')
