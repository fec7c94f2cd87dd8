"""The page beside a plant that runs: values, writes, audit, kills, TLS, another host, by hand."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from tests.support.appliance import EAPCTL, Appliance, Plants, plants
from tests.support.eventually import wait_until
from tests.support.passwords import HASH, PASSWORD

pytestmark = pytest.mark.net

HIDE_AIOHTTP = """\
import importlib.util as u
find = u.find_spec
u.find_spec = lambda name, *more: None if name == "aiohttp" else find(name, *more)
"""
URL = "http://127.9.61.9:8080"
PLANT = f"""\
plant: paged
defaults: {{cycle_us: 10000}}
stations:
  - name: one
    net_id: 127.9.61.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.61.1", net_id: 127.9.61.1.2.1}}
    variables:
      ticks: UDINT
      setpoint: {{type: UINT, unit: degC, default: 50}}
    sources: {{ticks: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: two/eap0}}]
    publish: [{{name: state, frame: out, id: 1, variables: [ticks, setpoint]}}]
  - name: two
    net_id: 127.9.61.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.61.2", net_id: 127.9.61.2.2.1}}
    variables: {{locked: UINT}}
    subscribe: [{{name: from-one, port: eap0, from: one/state, timeout_ms: 200}}]
    access: [{{name: no-pages, deny: [write], transports: [web]}}]
web:
  listen: 127.9.61.9:8080
  anonymous: viewer
  users:
    - {{name: otto, role: operator, password: "{HASH}"}}
    - {{name: elsa, role: engineer, password: "{HASH}"}}
  pages:
    - name: Line
      panels:
        - {{kind: value, of: [one/ticks, two/from-one.ticks]}}
        - {{kind: set, of: one/setpoint, min: 0, max: 100, comment: required}}
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def plant(folder: Plants) -> Appliance:
    found = folder.run(folder.write(PLANT))
    wait_for_page(found)
    return found


def page_of(plant: Appliance) -> dict[str, Any]:
    process: dict[str, Any] = plant.status()["processes"]["web"]
    return process


def wait_for_page(plant: Appliance, *, other_than: int = 0) -> None:
    def runs() -> bool:
        page = page_of(plant)
        return (
            page["pid"] not in {None, other_than} and "step" not in page and not page.get("fault")
        )

    wait_until(runs)


def fetch(method: str, path: str, user: str = "", url: str = URL, **more: Any) -> tuple[int, Any]:
    async def ask() -> tuple[int, Any]:
        headers = {}
        if user:
            headers["Authorization"] = aiohttp.encode_basic_auth(user, PASSWORD)
        async with (
            asyncio.timeout(30),
            aiohttp.ClientSession(headers=headers) as session,
            session.request(method, url + path, **more) as answer,
        ):
            return answer.status, await answer.json()

    return asyncio.run(ask())


def value_of(name: str) -> dict[str, Any]:
    status, found = fetch("GET", f"/api/v1/{name}")
    assert status == 200, found
    value: dict[str, Any] = found
    return value


def knows_stations() -> bool:
    return len(fetch("GET", "/api/v1/variables")[1]) > 5


def test_status_shows_the_page_and_its_address(plant: Appliance):
    assert page_of(plant)["url"] == f"{URL}/"
    assert "web" in plant.command("status")


def test_values_of_both_stations_move(plant: Appliance):
    wait_until(knows_stations)
    before = value_of("one/ticks")["value"]
    wait_until(lambda: value_of("two/from-one.ticks")["value"] > before)
    received = value_of("two/from-one.ticks")
    assert received["quality"] is not None
    assert not received["stale"]
    states = fetch("GET", "/api/v1/*/state")[1]
    assert {name: each["value"] for name, each in states.items()} == {
        "one/state": "OP",
        "two/state": "OP",
    }


def test_operator_sets_a_value_with_name_and_comment_in_the_audit(plant: Appliance, folder: Plants):
    wait_until(knows_stations)
    body = {"value": 72, "comment": "trial 7"}
    assert fetch("POST", "/api/v1/one/setpoint", json=body)[0] == 403
    assert fetch("POST", "/api/v1/one/setpoint", "otto", json={"value": 72})[0] == 422
    assert fetch("POST", "/api/v1/one/setpoint", "otto", json=body)[0] == 200
    wait_until(lambda: value_of("one/setpoint")["value"] == 72)
    wait_until(lambda: plant.values("two")["from-one.setpoint"] == 72)
    lines = Path(plant.status()["audit"]["file"]).read_text().splitlines()
    last = json.loads(lines[-1])
    assert (last["operation"], last["asked"]) == ("write", {"values": {"setpoint": 72}})
    assert (last["user"], last["comment"], last["error"]) == ("otto", "trial 7", "")
    assert last["host"].startswith("127.")


def test_access_rule_denies_what_the_role_allows(plant: Appliance):
    wait_until(knows_stations)
    status, answer = fetch("POST", "/api/v1/two/locked", "elsa", json={"value": 1})
    assert status == 403
    assert "rule no-pages refuses it" in answer["error"]["message"]
    status, answer = fetch("POST", "/api/v1/one/ticks", "elsa", json={"value": 1})
    assert (status, "written by the engine" in answer["error"]["message"]) == (403, True)
    assert plant.values("two")["locked"] == 0


def test_killed_page_costs_the_plant_nothing_and_comes_back(plant: Appliance):
    before, page = plant.status(), page_of(plant)
    os.kill(page["pid"], signal.SIGKILL)
    wait_for_page(plant, other_than=page["pid"])
    after = plant.status()
    assert page_of(plant)["restarts"] == page["restarts"] + 1
    for name in ("engine", "services"):
        assert after["processes"][name]["pid"] == before["processes"][name]["pid"]
    wait_until(knows_stations)
    (rx,) = after["stations"][1]["pd"]["rx"]
    assert rx["lost"] == before["stations"][1]["pd"]["rx"][0]["lost"]


def test_websocket_survives_a_killed_engine_and_killed_services(plant: Appliance):
    wait_until(knows_stations)

    async def follow() -> None:
        async with (
            asyncio.timeout(90),
            aiohttp.ClientSession() as session,
            session.ws_connect(f"{URL}/api/v1/ws") as socket,
        ):
            await socket.send_json({"subscribe": ["page:Line", "events"]})

            async def until(stale: bool) -> None:
                while True:
                    message = await socket.receive_json()
                    ticks = message.get("values", {}).get("one/ticks")
                    if message["type"] == "values" and ticks[2] is stale:
                        return

            for process in ("services", "engine"):
                await until(stale=False)
                pid = await asyncio.to_thread(plant.pid, process)
                os.kill(pid, signal.SIGKILL)
                what = ""
                while f"{process}" not in what:
                    message = await socket.receive_json()
                    if message["type"] == "events":
                        what = " ".join(each["where"] for each in message["events"])
            await until(stale=False)

    asyncio.run(follow())


def by_hand(plant: Appliance, *words: str) -> subprocess.Popen[str]:
    environment = os.environ | {"EAP_RUNTIME_DIR": str(plant.runtime)}
    return subprocess.Popen(
        [*EAPCTL, "web", *words], stderr=subprocess.PIPE, env=environment, text=True
    )


def test_page_by_hand_shows_another_host_by_ads_and_ends_by_sigint(plant: Appliance):
    listen = "127.9.61.10:8081"
    with by_hand(plant, "--connect", "127.9.61.1", "--listen", listen) as page:
        assert page.stderr is not None
        assert f"http://{listen}/" in page.stderr.readline()

        def shows_ticks() -> bool:
            return fetch("GET", "/api/v1/one/ticks", url=f"http://{listen}")[0] == 200

        wait_until(shows_ticks)
        status, answer = fetch(
            "POST", "/api/v1/one/setpoint", json={"value": 33}, url=f"http://{listen}"
        )
        assert (status, answer) == (200, {"written": "one/setpoint", "value": 33})
        wait_until(lambda: plant.values("one")["setpoint"] == 33)
        page.send_signal(signal.SIGINT)
        assert page.wait(10) == 0
        assert "Traceback" not in page.stderr.read()


def test_page_with_tls_serves_https_only(plant: Appliance, tmp_path: Path):
    key, certificate = tmp_path / "page.key", tmp_path / "page.crt"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "2", "-subj", "/CN=page", "-addext", "subjectAltName=IP:127.9.61.11",
         "-keyout", key, "-out", certificate],
        check=True, capture_output=True,
    )  # fmt: skip
    file = tmp_path / "plant.yaml"
    tls = f"web:\n  tls: {{certificate: {certificate}, key: {key}}}"
    file.write_text(PLANT.replace("web:", tls).replace("127.9.61.9:8080", "127.9.61.11:8443"))
    with by_hand(plant, str(file)) as page:
        assert page.stderr is not None
        assert "https://127.9.61.11:8443/" in page.stderr.readline()
        context = ssl.create_default_context(cafile=certificate)

        async def ask() -> dict[str, Any]:
            url = "https://127.9.61.11:8443/api/v1"
            async with asyncio.timeout(30), aiohttp.ClientSession() as session:
                body = {"user": "otto", "password": PASSWORD}
                async with session.post(f"{url}/login", json=body, ssl=context) as answer:
                    assert "Secure" in answer.headers["Set-Cookie"]
                    assert "Strict-Transport-Security" in answer.headers
                with pytest.raises(aiohttp.ClientError):
                    await session.get(url.replace("https", "http"))
                async with session.get(f"{url}/session", ssl=context) as answer:
                    found: dict[str, Any] = await answer.json()
                    return found

        assert asyncio.run(ask())["can_log_in"]
        page.terminate()
        assert page.wait(10) == 0


def test_port_in_use_is_named_in_status_and_the_plant_runs(folder: Plants, plant: Appliance):
    text = PLANT.replace("plant: paged", "plant: second").replace("127.9.61.1", "127.9.62.1")
    second = folder.run(folder.write(text.replace("127.9.61.2", "127.9.62.2"), "second.yaml"))
    wait_until(lambda: "cannot listen on 127.9.61.9:8080" in page_of(second).get("fault", ""))
    assert second.station("one")["state"] == "OP"
    assert "cannot listen" in second.command("status")
    code, _, err = second.stop()
    assert code == 0
    assert err.count("cannot listen") == 1


def test_password_option_prints_a_line_that_works(tmp_path: Path):
    done = subprocess.run(
        [*EAPCTL, "web", "--password", "an na"],
        input="a good secret\n",
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('- {name: "an na", role: operator, password: "scrypt$32768$8$1$')
    file = tmp_path / "plant.yaml"
    users = PLANT.partition("  users:\n")[0] + "  users:\n    " + done.stdout
    file.write_text(users)
    checked = subprocess.run([*EAPCTL, "check", file], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr


def test_missing_aiohttp_is_named_with_its_remedy(tmp_path: Path):
    (tmp_path / "sitecustomize.py").write_text(HIDE_AIOHTTP)
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(
        [sys.executable, "-m", "eap", "web", "config/demo.yaml"],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr == (
        "aiohttp is not installed: the page needs it; pip install 'eap-appliance[web]'\n"
    )


def test_plant_runs_without_aiohttp_and_status_says_how_to_install_it(
    folder: Plants, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "sitecustomize.py").write_text(HIDE_AIOHTTP)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    text = PLANT.replace("plant: paged", "plant: bare").replace("127.9.61.1", "127.9.63.1")
    bare = folder.run(folder.write(text.replace("127.9.61.2", "127.9.63.2"), "bare.yaml"))
    remedy = "aiohttp is not installed: pip install 'eap-appliance[web]'"
    wait_until(lambda: page_of(bare).get("fault") == remedy)
    shown = bare.command("status")
    assert "not running: aiohttp is not installed" in " ".join(shown.split())
    assert bare.station("one")["state"] == "OP"
    code, _, err = bare.stop()
    assert (code, err.count("aiohttp")) == (0, 1)
