"""docs/gateway-client.md tells the truth, in both languages: its blocks run on the demo plant."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.appliance import Appliance, Plants, wait_until

pytestmark = pytest.mark.net

ROOT = Path(__file__).parents[2]
PAGES = ("docs/gateway-client.md", "docs/zh/gateway-client.md")


def blocks(page: str) -> list[str]:
    return re.findall(
        r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL
    )


def run(page: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run what a user would copy, and return what it prints."""
    program = "\n".join(blocks(page))
    exec(compile(program, page, "exec"), {"__name__": "client"})
    return capsys.readouterr().out


def is_up(demo: Appliance, station: str) -> bool:
    answer = demo.request("read", station=station, names=["bus0.state"])
    return answer["values"] == {"bus0.state": 8}


def test_examples_print_what_they_ask_for(farm: Plants, capsys: pytest.CaptureFixture[str]) -> None:
    """Those of one page: the other has the same program."""
    demo = farm.run(ROOT / "config" / "demo.yaml")
    for station in ("island-01", "island-02"):
        wait_until(lambda station=station: is_up(demo, station))
    told = run(PAGES[0], capsys)
    for word in (
        "b'drive'",
        "SDO abort 0x06020000",
        "b'EtherCAT master island-01/bus0'",
        "5a0e0000",
    ):
        assert word in told


def test_only_socket_and_struct_are_imported() -> None:
    for page in PAGES:
        program = "\n".join(blocks(page))
        assert re.findall(r"^(?:import|from) (\w+)", program, re.MULTILINE) == ["socket", "struct"]


def test_both_pages_have_the_same_program() -> None:
    first, second = ([_code(block) for block in blocks(page)] for page in PAGES)
    assert first == second


def _code(block: str) -> str:
    """What is left of a block without comments and descriptions."""
    described = re.sub(r'^ *""".*?"""\n', "", block, flags=re.MULTILINE)
    return re.sub(r" *# .*", "", described)
