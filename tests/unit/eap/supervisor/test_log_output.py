"""Log of an appliance in its forms."""

from __future__ import annotations

import json
import logging
import os
import socket
import sys

import pytest

from eap.runtime.log import VARIABLE, LogLine, area_of, line_of
from eap.supervisor.log_output import Log, LogForm, Output

LINE = LogLine("2026-11-23T09:00:00.000+00:00", "warning", "services", "routing", "hop down")


@pytest.fixture
def pipe(monkeypatch):
    monkeypatch.setenv(VARIABLE, "")
    read_end, write_end = os.pipe()
    os.set_blocking(read_end, False)
    yield read_end, write_end
    os.close(read_end)
    os.close(write_end)


def written(read_end: int) -> str:
    try:
        return os.read(read_end, 65536).decode()
    except BlockingIOError:
        return ""


def encoded(line: LogLine) -> str:
    return json.dumps({name: getattr(line, name) for name in line.__struct_fields__})


def test_text_is_passed_on_as_it_came(pipe):
    log = Log(Output(pipe[1]))
    log.begin(LogForm.TEXT, "hall")
    assert VARIABLE not in os.environ
    assert log.pass_on("engine", "engine: no such interface") == "engine: no such interface"
    log.write(LINE)
    assert written(pipe[0]) == "engine: no such interface\nservices: hop down\n"


def test_json_has_an_object_a_line_whatever_a_process_wrote(pipe):
    log = Log(Output(pipe[1]))
    log.begin(LogForm.JSON, "hall")
    assert os.environ[VARIABLE] == "json"
    assert log.pass_on("services", encoded(LINE)) == "services: hop down"
    assert log.pass_on("engine", "engine: no such interface") == "engine: no such interface"
    assert log.pass_on("engine", '{"half') == 'engine: {"half'
    nested = '{"later": ' + "[" * 2000
    assert log.pass_on("engine", nested) == f"engine: {nested}"
    log.write(LINE)
    first, second, third, _, fourth = map(json.loads, written(pipe[0]).splitlines())
    assert first == fourth == {
        "time": "2026-11-23T09:00:00.000+00:00",
        "level": "warning",
        "process": "services",
        "area": "routing",
        "message": "hop down",
    }  # fmt: skip
    assert (second["level"], second["process"]) == ("error", "engine")
    assert second["message"] == "no such interface"
    assert third["message"] == '{"half'


@pytest.mark.net
def test_journal_gets_fields(pipe, tmp_path):
    path = str(tmp_path / "socket")
    log = Log(Output(pipe[1]), path)
    log.begin(LogForm.JOURNAL, "hall")
    log.write(LINE)
    assert written(pipe[0]) == "services: hop down\n", "journald is away: the line is not lost"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.bind(path)
        log.write(LINE)
        assert journal.recv(4096).decode().splitlines() == [
            "MESSAGE=services: hop down",
            "PRIORITY=4",
            "SYSLOG_IDENTIFIER=eapctl",
            "EAP_PLANT=hall",
            "EAP_PROCESS=services",
            "EAP_AREA=routing",
        ]
        log.pass_on("engine", "a\0b")
        assert b"PRIORITY=3\n" in journal.recv(4096)
        log.write(LogLine("", "error", "web", "web", "failed", trace="Traceback\n  x"))
        text = b"web: failed\nTraceback\n  x"
        assert journal.recv(4096).startswith(
            b"MESSAGE\n" + len(text).to_bytes(8, "little") + text + b"\nPRIORITY=3\n"
        )
    assert written(pipe[0]) == ""
    log.close()
    log.write(LINE)
    assert written(pipe[0]) == "services: hop down\n"


def test_auto_is_text_without_journald(pipe, monkeypatch):
    monkeypatch.setenv("JOURNAL_STREAM", "1:2")
    log = Log(Output(pipe[1]))
    log.begin(LogForm.AUTO, "hall")
    log.write(LINE)
    assert written(pipe[0]) == "services: hop down\n"


@pytest.mark.parametrize(
    ("logger", "area"),
    [
        ("eap.services.routing.station_router", "routing"),
        ("eap.services.process", "process"),
        ("eap.supervisor.process", "supervisor"),
        ("eap.net.mqtt", "net"),
        ("eap", "eap"),
        ("asyncio", "asyncio"),
    ],
)
def test_area_is_the_package_that_logs(logger, area):
    assert area_of(logger) == area


def test_line_of_a_record_has_its_traceback():
    try:
        int("why")
    except ValueError:
        record = logging.LogRecord(
            "eap.web.feed", logging.CRITICAL, __file__, 1, "%s failed", ("x",), sys.exc_info()
        )
    line = line_of(record, "web")
    assert (line.level, line.area, line.message) == ("error", "web", "x failed")
    assert line.trace.endswith("'why'")
    assert line.time.endswith("+00:00")
