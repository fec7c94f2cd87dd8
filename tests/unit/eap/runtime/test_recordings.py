"""Folders of recordings, and the findings about them."""

from __future__ import annotations

import pytest

from eap.errors import EnvironmentalError
from eap.runtime.folder import find_appliances
from eap.runtime.recordings import (
    KEPT,
    SHOWN_S,
    RecordingFolder,
    RecordingState,
    find_recordings,
    forget_old_recordings,
    recording_findings,
)


@pytest.fixture(autouse=True)
def _runtime(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))


def state(name="line", **more):
    return RecordingState(name=name, kind="values", plant="demo", selected=3, **more)


def test_recording_is_found_while_it_runs_and_after_its_end():
    with RecordingFolder.claim("line") as folder:
        folder.write(state(state="recording", started_at=5.0))
        ((_, found),) = find_recordings()
        assert found.state == "recording"
        folder.write(state(state="ended", reason="stopped", ended_at=9.0))
    ((_, found),) = find_recordings()
    assert (found.state, found.failed) == ("ended", False)
    assert find_appliances() == []  # its folder is none of an appliance


def test_recording_whose_recorder_has_gone_was_killed():
    with RecordingFolder.claim("line") as folder:
        folder.write(state(state="recording"))
        folder.log.write_text("Traceback\nMemoryError: none left\n\n")
    ((_, found),) = find_recordings()
    assert (found.state, found.failed) == ("killed", True)
    assert found.reason == "the recorder was killed: MemoryError: none left"
    assert found.ended_at is not None


def test_name_is_free_again_when_its_recording_is_over():
    with RecordingFolder.claim("line") as folder:
        folder.write(state(state="recording"))
        with pytest.raises(EnvironmentalError, match="'line' runs already: choose another name"):
            RecordingFolder.claim("line")
    with RecordingFolder.claim("line"):
        assert find_recordings() == []


def test_name_that_is_too_long_for_a_socket_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / ("x" * 60)))
    with pytest.raises(EnvironmentalError, match="too long for a socket's path"):
        RecordingFolder.claim("y" * 60)


def test_recordings_that_ended_long_ago_are_forgotten():
    for number in range(KEPT + 3):
        with RecordingFolder.claim(f"r{number}") as folder:
            folder.write(state(f"r{number}", state="ended", started_at=float(number)))
    forget_old_recordings()
    assert [each.name for _, each in find_recordings()] == [f"r{n}" for n in range(3, KEPT + 3)]


@pytest.mark.parametrize(
    ("more", "severity", "what"),
    [
        ({"state": "recording"}, "info", "recording, 3 variables"),
        ({"state": "waiting", "reason": "it is away"}, "info", "waiting, 3 variables: it is away"),
        ({"state": "recording", "lost": 7}, "warning", "recording, 3 variables, 7 lost"),
        (
            {"state": "recording", "reason": "no answer"},
            "warning",
            "recording, 3 variables: no answer",
        ),
        (
            {"state": "recording", "not_stored": 5, "reason": "no answer"},
            "warning",
            "recording, 3 variables, 5 not stored: no answer",
        ),
        (
            {"state": "ended", "reason": "disk full", "failed": True, "ended_at": 90.0},
            "warning",
            "ended: disk full",
        ),
    ],
)
def test_recordings_are_findings_of_their_plant(more, severity, what):
    with RecordingFolder.claim("line") as folder:
        folder.write(state(**more))
        (finding,) = recording_findings("demo", 100.0)
        assert (finding["severity"], finding["where"]) == (severity, "recording line")
        assert finding["what"] == what
        assert recording_findings("other", 100.0) == []


def test_recordings_that_ended_as_wanted_or_long_ago_are_no_findings():
    with RecordingFolder.claim("line") as folder:
        folder.write(state(state="ended", reason="stopped", ended_at=90.0))
    assert recording_findings("demo", 100.0) == []
    with RecordingFolder.claim("line") as folder:
        folder.write(state(state="ended", failed=True, ended_at=90.0))
    assert len(recording_findings("demo", 100.0)) == 1
    assert recording_findings("demo", 91.0 + SHOWN_S) == []
