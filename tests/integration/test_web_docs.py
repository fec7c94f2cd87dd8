"""The examples of docs/web.md and docs/web-api.md, on the demo plant."""

from __future__ import annotations

import asyncio
import json
import re
import shlex
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from eap.config.web_sections import Panel
from eap.runtime.plantfile import load_plant
from tests.support.appliance import Appliance, Plants, plants, wait_until
from tests.support.passwords import SECRET_HASH

pytestmark = pytest.mark.net

REPOSITORY = Path(__file__).parents[2]
API = (REPOSITORY / "docs/web-api.md").read_text()
PAGE = (REPOSITORY / "docs/web.md").read_text()
REFERENCE = (REPOSITORY / "docs/plant-file.md").read_text()
REQUESTS = re.findall(r"```sh\ncurl (.*?)\n```\n\n```json\n(.*?)\n```", API, re.DOTALL)


@pytest.fixture(scope="module")
def demo() -> Iterator[Appliance]:
    with plants() as folder:
        yield Plants.run(folder, REPOSITORY / "config/demo.yaml")


async def request(words: str) -> Any:
    """Do the request that ``curl`` would do with *words*."""
    options = shlex.split(words)
    headers, body, url = {}, None, ""
    while options:
        match options.pop(0):
            case "-H":
                name, _, value = options.pop(0).partition(": ")
                headers[name] = value
            case "-d":
                body = options.pop(0)
            case url:
                pass
    method = "GET" if body is None else "POST"
    async with (
        aiohttp.ClientSession(headers=headers) as session,
        session.request(method, url, data=body) as answer,
    ):
        assert answer.status == 200, await answer.text()
        return await answer.json()


def is_served() -> bool:
    async def ask() -> bool:
        try:
            async with aiohttp.ClientSession() as session:
                url = "http://127.0.0.1:8080/api/v1/variables"
                async with session.get(url) as answer:
                    return len({name.partition("/")[0] for name in await answer.json()}) == 3
        except OSError:
            return False

    return asyncio.run(ask())


@pytest.mark.parametrize(("words", "expected"), REQUESTS, ids=lambda text: text[-40:])
def test_requests_are_answered_as_shown(demo, words, expected):
    wait_until(is_served)
    answer = asyncio.run(request(words))
    shown = json.loads(expected)
    assert list(answer) == list(shown)
    assert [type(each) for each in answer.values()] == [type(each) for each in shown.values()]


def test_websocket_is_as_shown(demo):
    (dialog,) = re.findall(r"```text\n(< .*?)\n```", API, re.DOTALL)
    wait_until(is_served)

    async def play() -> None:
        async with (
            asyncio.timeout(30),
            aiohttp.ClientSession() as session,
            session.ws_connect("http://127.0.0.1:8080/api/v1/ws") as socket,
        ):
            for line in dialog.splitlines():
                shown = json.loads(line[2:])
                if line.startswith(">"):
                    await socket.send_json(shown)
                    continue
                while (message := await socket.receive_json())["type"] != shown["type"]:
                    pass
                assert list(message) == list(shown)
                assert message["type"] != "subscribed" or message == shown
                for name, value in shown.get("values", {}).items():
                    assert len(message["values"][name]) == len(value) == 3

    asyncio.run(play())


def test_answers_have_the_fields_of_the_page(demo):
    wait_until(is_served)
    (row,) = re.findall(r"^\| `plant` \| (`stations`.*)", API, re.MULTILINE)
    plant = asyncio.run(request("http://127.0.0.1:8080/api/v1/plant"))
    for name in ("stations", "flows", "links"):
        (text,) = re.findall(rf"`{name}`: (.*?)(?:; `|$)", row)
        assert set(plant[name][0]) - {"plant"} <= set(re.findall(r"`(\w+)`", text)), name
    assert {"buses", "findings", "unreachable"} <= set(plant)


def test_plants_of_the_page_are_right(tmp_path):
    for name in ("page.crt", "page.key"):
        (tmp_path / name).write_text("")
    examples = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    whole = examples[0]
    for example in examples:
        plant = tmp_path / "plant.yaml"
        text = example if example.startswith("plant:") else whole.partition("web:")[0] + example
        plant.write_text(re.sub(r'"scrypt[^"]*"', f'"{SECRET_HASH}"', text))
        assert [str(each) for each in load_plant(plant).findings] == [], example


def test_example_of_the_reference_is_right(tmp_path):
    (example,) = re.findall(r"```yaml\n(web:\n.*?)```", REFERENCE, re.DOTALL)
    (tmp_path / "mixer.svg").write_text(
        '<svg xmlns="http://www.w3.org/2000/svg"><rect id="motor"/><rect id="tank"/></svg>'
    )
    for name in ("page.crt", "page.key"):
        (tmp_path / name).write_text("")
    plant = tmp_path / "plant.yaml"
    plant.write_text(
        textwrap.dedent("""\
        plant: line
        stations:
          - name: mixer
            net_id: 10.0.0.1.1.1
            ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.1.2.1}]
            variables: {speed: REAL, setpoint: UINT}
        """)
        + example
    )
    assert [str(each) for each in load_plant(plant).findings] == []


def test_reference_has_every_kind_and_key_of_panels():
    section = REFERENCE.partition("\n## Page\n")[2].partition("\n## ")[0]
    for kind in Panel.__args__:
        (row,) = re.findall(rf"^\| `{kind.__struct_config__.tag}` \|.*", section, re.MULTILINE)
        keys = [field for field in kind.__struct_fields__ if field not in {"at", "title"}]
        names = {"low": "min", "high": "max", "role": "for", "level": "from"}
        assert not [key for key in keys if f"`{names.get(key, key)}`" not in row], kind
