"""Metrics of a running plant: by the page, alone, and as a real Prometheus scrapes them."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from base64 import b64encode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from tests.support.appliance import Appliance, plants
from tests.support.eventually import wait_until
from tests.support.passwords import HASH, PASSWORD

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
ALONE = "http://127.9.63.9:9464/metrics"
PAGE = "http://127.9.63.9:8080/metrics"
PLANT = f"""\
plant: watched
defaults: {{cycle_us: 10000}}
stations:
  - name: one
    net_id: 127.9.63.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.63.1", net_id: 127.9.63.1.2.1}}
    variables: {{ticks: UDINT}}
    sources: {{ticks: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: two/eap0}}]
    publish: [{{name: state, frame: out, id: 1, variables: [ticks]}}]
  - name: two
    net_id: 127.9.63.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.63.2", net_id: 127.9.63.2.2.1}}
    subscribe: [{{name: from-one, port: eap0, from: one/state, timeout_ms: 200}}]
metrics: 127.9.63.9:9464
web:
  listen: 127.9.63.9:8080
  users: [{{name: prometheus, password: "{HASH}"}}]
"""


@pytest.fixture(scope="module")
def plant() -> Iterator[Appliance]:
    with plants() as folder:
        found = folder.run(folder.write(PLANT))
        wait_until(lambda: bool(received()))
        yield found


def fetch(url: str, user: str = "") -> tuple[int, str, str]:
    """Return status, content type and body."""
    request = urllib.request.Request(url)
    if user:
        login = b64encode(f"{user}:{PASSWORD}".encode()).decode()
        request.add_header("Authorization", f"Basic {login}")
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, answer.headers["Content-Type"], answer.read().decode()
    except urllib.error.HTTPError as exc:
        with exc:
            return exc.code, exc.headers["Content-Type"], exc.read().decode()
    except OSError:  # it does not listen yet
        return 0, "", ""


def samples(text: str) -> dict[str, list[tuple[dict[str, str], float]]]:
    found: dict[str, list[tuple[dict[str, str], float]]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            found.setdefault(sample.name, []).append((sample.labels, sample.value))
    return found


def received() -> float:
    """Return how many PDs station two has received by the metrics."""
    status, _, text = fetch(ALONE)
    values = samples(text).get("eap_pd_received_total", []) if status == 200 else []
    return sum(value for labels, value in values if labels["station"] == "two")


def test_metrics_alone_count_as_status_does(plant: Appliance) -> None:
    before = received()
    wait_until(lambda: received() > before)
    _, kind, text = fetch(ALONE)
    assert kind.startswith("application/openmetrics-text; version=1.0.0")
    found = samples(text)
    states = {
        labels["station"]: labels["state"] for labels, value in found["eap_station_state"] if value
    }
    assert states == {"one": "OP", "two": "OP"}
    processes = {labels["process"] for labels, value in found["eap_process_up"] if value}
    assert processes == {"supervisor", "engine", "services", "web", "metrics"}


def test_metrics_of_the_page_need_its_user(plant: Appliance) -> None:
    wait_until(lambda: fetch(PAGE)[0] == 401)
    wait_until(lambda: fetch(PAGE, "prometheus")[0] == 200)
    assert "eap_pd_received_total" in samples(fetch(PAGE, "prometheus")[2])


def test_restarted_engine_continues_the_counters(plant: Appliance) -> None:
    before = received()
    pid = plant.pid("engine")
    os.kill(pid, signal.SIGKILL)
    plant.wait_for_another("engine", pid)
    wait_until(lambda: received() > before)
    found = samples(fetch(ALONE)[2])
    restarts = {labels["process"]: value for labels, value in found["eap_process_restarts_total"]}
    assert restarts["engine"] == 1


@pytest.mark.prometheus
def test_prometheus_scrapes_all_series_and_knows_the_rules_and_panels(
    plant: Appliance, tmp_path: Path
) -> None:
    shutil.copy(ROOT / "docs/monitoring/alerts.yml", tmp_path)
    config = {
        "scrape_configs": [
            {
                "job_name": "eap",
                "scrape_interval": "1s",
                "static_configs": [{"targets": ["127.9.63.9:9464"]}],
            }
        ],
        "rule_files": ["alerts.yml"],
    }
    (tmp_path / "prometheus.yml").write_text(json.dumps(config))
    server = subprocess.Popen(
        [
            "prometheus",
            f"--config.file={tmp_path}/prometheus.yml",
            f"--storage.tsdb.path={tmp_path}/data",
            "--web.listen-address=127.9.63.8:9090",
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until(lambda: bool(query("eap_pd_received_total")), timeout_s=60)
        (scraped,) = query("scrape_samples_scraped")
        given = sum(map(len, samples(fetch(ALONE)[2]).values()))
        assert float(scraped["value"][1]) == pytest.approx(given, abs=20)
        rules = asked("rules")["data"]["groups"][0]["rules"]
        assert len(rules) >= 10
        for rule in rules:
            query(rule["query"])
        for expression in panel_queries():
            query(expression)
    finally:
        server.terminate()
        server.wait(30)


@pytest.mark.prometheus
def test_alert_rules_are_valid() -> None:
    done = subprocess.run(
        ["promtool", "check", "rules", str(ROOT / "docs/monitoring/alerts.yml")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.prometheus
def test_alerts_fire_for_what_is_wrong_and_for_nothing_else(tmp_path: Path) -> None:
    series = {
        "healthy": ["eap_info 1", "eap_unreachable 0", "eap_station_cycles_total 9",
                    'eap_pd_running{pd="left"} 1', 'eap_pd_age_seconds{pd="left"} 0.02'],
        "silent": ["eap_info 1", "eap_unreachable 1"],
        "partly-silent": ["eap_info 1", "eap_unreachable 1", "eap_station_cycles_total 9"],
        "empty": ["eap_info 1", "eap_unreachable 0"],
        "waits": ["eap_info 1", "eap_station_cycles_total 9", 'eap_pd_running{pd="left"} 0'],
        "stale": ["eap_info 1", "eap_station_cycles_total 9", 'eap_pd_running{pd="left"} 0',
                  'eap_pd_age_seconds{pd="left"} 30'],
    }  # fmt: skip
    given = []
    for instance, lines in series.items():
        for line in lines:
            name, _, value = line.rpartition(" ")
            name, _, labels = name.partition("{")
            labels = ",".join([f'job="eap",instance="{instance}"', *filter(None, [labels[:-1]])])
            given.append({"series": f"{name}{{{labels}}}", "values": f"{value}x20"})
    fired = {
        "EapPlantSilent": ["silent", "partly-silent", "empty"],
        "EapPdNotRunning": ["waits", "stale"],
        "EapStationNotInOp": [],
        "EapBusDown": [],
    }
    expressions = [
        {
            "expr": f'count by (instance) (ALERTS{{alertname="{name}",alertstate="firing"}})',
            "eval_time": "1m",
            "exp_samples": [
                {"labels": f'{{instance="{instance}"}}', "value": 1} for instance in instances
            ],
        }
        for name, instances in fired.items()
    ]
    rules = str(ROOT / "docs/monitoring/alerts.yml")
    test = {"interval": "5s", "input_series": given, "promql_expr_test": expressions}
    path = tmp_path / "test.yml"
    path.write_text(json.dumps({"rule_files": [rules], "tests": [test]}))
    done = subprocess.run(
        ["promtool", "test", "rules", str(path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def panel_queries() -> Iterator[str]:
    """Yield the queries of the dashboard with its variables filled in."""
    dashboard = json.loads((ROOT / "docs/monitoring/grafana-dashboard.json").read_text())
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            text = target["expr"].replace("$__rate_interval", "1m")
            yield re.sub(r"\$(plant|station)", ".*", text)


def asked(path: str, **parameters: str) -> Any:
    url = f"http://127.9.63.8:9090/api/v1/{path}?{urllib.parse.urlencode(parameters)}"
    status, _, text = fetch(url)
    if status in {0, 503}:  # it starts
        return {"status": "not there yet", "data": {"result": []}}
    return json.loads(text)


def query(expression: str) -> list[dict[str, Any]]:
    """Return the present result of a query, which Prometheus understands."""
    answer = asked("query", query=expression)
    assert answer["status"] in {"success", "not there yet"}, (expression, answer)
    result: list[dict[str, Any]] = answer["data"]["result"]
    return result
