"""Metrics as the parser of prometheus_client reads them."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from eap.live import metrics
from eap.live.findings import StatusReport
from eap.live.metrics import FAMILIES, MetricsWriter
from tests.support.statusdocument import bus_port, document, frame, rx, tx, with_findings

Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def report(**parts: Any) -> StatusReport:
    return with_findings(document(**parts))


def samples(text: str) -> Samples:
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def value(found: Samples, name: str, **labels: str) -> float | None:
    wanted = {"plant": "line"} | labels
    return found.get((name, frozenset(wanted.items())))


@pytest.fixture
def writer() -> MetricsWriter:
    return MetricsWriter()


def test_counts_and_times_of_a_pd(writer: MetricsWriter) -> None:
    pd = rx("left", lost=3, age_us=4200, quality=21, discarded={"wrong_length": 2})
    found = samples(writer.write(report(rx=[pd], tx=[tx("state")])))
    where = {"station": "mixer", "port": "eap0", "pd": "left"}
    assert value(found, "eap_pd_received_total", **where) == 123_400
    assert value(found, "eap_pd_lost_total", **where) == 3
    assert value(found, "eap_pd_age_seconds", **where) == 0.0042
    assert value(found, "eap_pd_quality_seconds", **where) == 0.0021
    assert value(found, "eap_pd_discarded_total", reason="wrong_length", **where) == 2
    assert value(found, "eap_pd_jitter_seconds", quantile="0.99", **where) == 0.000111
    assert value(found, "eap_pd_running", **where) == 1
    assert (
        value(found, "eap_pd_triggered_total", **(where | {"pd": "state", "reason": "cycle"})) == 9
    )


def test_unknown_numbers_have_no_series(writer: MetricsWriter) -> None:
    found = samples(writer.write(report(rx=[rx("left", lost=None, age_us=None, state="waiting")])))
    where = {"station": "mixer", "port": "eap0", "pd": "left"}
    assert value(found, "eap_pd_lost_total", **where) is None
    assert value(found, "eap_pd_age_seconds", **where) is None
    assert value(found, "eap_pd_running", **where) == 0
    assert value(found, "eap_process_cpu_ratio", process="services") is None
    assert value(found, "eap_process_cpu_ratio", process="engine") == 0.0425


def test_states_of_stations_and_slaves(writer: MetricsWriter) -> None:
    found = samples(writer.write(report(state="SAFEOP", ports=[bus_port()])))
    states = {
        state: value(found, "eap_station_state", station="mixer", state=state)
        for state in ("INIT", "PREOP", "SAFEOP", "OP")
    }
    assert states == {"INIT": 0, "PREOP": 0, "SAFEOP": 1, "OP": 0}
    where = {"station": "mixer", "port": "bus0"}
    assert value(found, "eap_bus_slaves", state="OP", **where) == 1
    assert value(found, "eap_bus_slaves", state="unknown", **where) == 1
    assert value(found, "eap_bus_lost_exchanges_total", **where) == 3
    press = where | {"slave": "press", "address": "1002"}
    assert value(found, "eap_slave_faulty", **press) == 1
    assert value(found, "eap_findings", severity="error") == 1


def test_the_next_report_has_its_own_numbers(writer: MetricsWriter) -> None:
    where = {"station": "mixer", "port": "eap0", "frame": "out"}
    for sent in (90, 91):
        found = samples(writer.write(report(frames=[frame("out", sent=sent)])))
        assert value(found, "eap_frame_sent_total", **where) == sent
    gone = samples(writer.write(report()))
    assert value(gone, "eap_frame_sent_total", **where) is None


def test_bridge_has_its_state_and_counters(writer: MetricsWriter) -> None:
    status = document()
    bridge = {"peer": "mqtt://b:1883", "is_up": False, "reason": "refused", "since": 0.0,
              "clients": None, "sent": 500, "received": 4, "refused": 1, "dropped": 2}  # fmt: skip
    status["processes"]["mqtt"] = {"pid": 103, "bridge": bridge}
    found = samples(writer.write(with_findings(status)))
    counts = ("up", "sent_values_total", "refused_writes_total", "dropped_total", "clients")
    assert [value(found, f"eap_bridge_{each}", bridge="mqtt") for each in counts] == [
        0, 500, 1, 2, None,
    ]  # fmt: skip


@pytest.mark.parametrize("is_up", [False, True])
def test_bridge_to_controllers_is_up_with_all_of_them(writer: MetricsWriter, is_up: bool) -> None:
    status = document()
    bridge = {"peer": "", "is_up": False, "peers": [{"is_up": True}, {"is_up": is_up}]}
    counts = dict.fromkeys(("clients", "sent", "received", "refused", "dropped"), 0)
    status["processes"]["s7"] = {"pid": 103, "bridge": bridge | counts}
    found = samples(writer.write(with_findings(status)))
    assert value(found, "eap_bridge_up", bridge="s7") == is_up


def test_silent_appliances_are_counted(writer: MetricsWriter) -> None:
    found = samples(writer.write(report(), 2))
    assert found["eap_unreachable", frozenset()] == 2


def test_every_family_has_help_and_a_name_with_its_unit() -> None:
    names = [family.name for family in FAMILIES]
    assert len(names) == len(set(names))
    for family in FAMILIES:
        assert family.help.endswith(".")
        assert not family.name.endswith(("_us", "_ns", "_ms", "_total"))


def test_series_beyond_the_limit_are_counted(
    writer: MetricsWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = samples(writer.write(report(rx=[rx(f"pd{n}") for n in range(50)])))
    monkeypatch.setattr(metrics, "MAX_SERIES", 200)
    found = samples(writer.write(report(rx=[rx(f"pd{n}") for n in range(50)])))
    left_out = found["eap_metrics_left_out", frozenset()]
    assert left_out > 0
    assert len(found) + left_out == len(full)
    # What concerns the whole appliance and its stations is there whatever the number of PDs.
    assert value(found, "eap_station_state", station="mixer", state="OP") == 1


@given(st.text(min_size=1, max_size=20))
def test_any_name_is_one_label(name: str) -> None:
    found = samples(MetricsWriter().write(report(rx=[rx(name)])))
    where = {"station": "mixer", "port": "eap0", "pd": name}
    assert value(found, "eap_pd_received_total", **where) == 123_400
