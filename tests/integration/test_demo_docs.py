"""Pages whose examples run on the demo plant: ADS, slaves by ADS, gateway client, traces."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import pytest

from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until
from tests.support.pages import ROOT, commands, run_examples

pytestmark = pytest.mark.net

DOCS = ROOT / "docs"
BUSES = ("island-01", "island-02", "island-03")
GATEWAY_PAGES = ("gateway-client.md", "zh/gateway-client.md")
_EXAMPLE = re.compile(r"```console\n\$ eapctl ((?:trace|scan)\b[^\n]*)\n(.*?)```", re.DOTALL)
TRACES = [
    example
    for page in ("trace.md", "commands.md")
    for example in _EXAMPLE.findall((DOCS / page).read_text())
]


@pytest.fixture(scope="module")
def demo(module_farm: Plants) -> Appliance:
    """Return the demo plant, whose buses are in OP."""
    appliance = module_farm.run(ROOT / "config" / "demo.yaml")
    for station in BUSES:
        wait_until(lambda station=station: is_up(appliance, station))
    return appliance


def is_up(demo: Appliance, station: str) -> bool:
    answer = demo.request("read", station=station, names=["bus0.state"])
    return answer["values"] == {"bus0.state": 8}


@pytest.mark.usefixtures("demo")
def test_ads_page_examples_run() -> None:
    pytest.importorskip("pyads", reason="needs pyads: pip install pyads")
    run_examples(DOCS / "ads.md", at_least=25)


@pytest.mark.usefixtures("demo")
def test_slaves_by_ads_page_examples_run() -> None:
    pytest.importorskip("pyads", reason="needs pyads: pip install pyads")
    run_examples(DOCS / "slaves-by-ads.md", at_least=30)


def blocks(page: str) -> list[str]:
    return re.findall(
        r"^```python\n(.*?)^```$", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL
    )


@pytest.mark.usefixtures("demo")
def test_gateway_client_page_prints_expected_values(capsys: pytest.CaptureFixture[str]) -> None:
    """Of one page: the other has the same program."""
    program = "\n".join(blocks(GATEWAY_PAGES[0]))
    exec(compile(program, GATEWAY_PAGES[0], "exec"), {"__name__": "client"})
    printed = capsys.readouterr().out
    for word in (
        "b'drive'",
        "SDO abort 0x06020000",
        "b'EtherCAT master island-01/bus0'",
        "5a0e0000",
    ):
        assert word in printed


def test_gateway_client_imports_only_socket_and_struct() -> None:
    for page in GATEWAY_PAGES:
        program = "\n".join(blocks(page))
        assert re.findall(r"^(?:import|from) (\w+)", program, re.MULTILINE) == ["socket", "struct"]


def test_gateway_client_is_the_same_program_in_both_languages() -> None:
    first, second = ([_code(block) for block in blocks(page)] for page in GATEWAY_PAGES)
    assert first == second


def _code(block: str) -> str:
    """Return a block without comments and descriptions."""
    described = re.sub(r'^ *""".*?"""\n', "", block, flags=re.MULTILINE)
    return re.sub(r" *# .*", "", described)


def test_trace_and_scan_print_the_shown_output(demo: Appliance) -> None:
    assert len(TRACES) == 2
    wait_until(lambda: "(up)" in demo.command("trace", "island-03/bus0/1001"))
    wait_until(lambda: demo.command("scan").count(" OP ") == 8)
    for words, printed in TRACES:
        done = run_eapctl(demo.runtime, *shlex.split(words))
        assert done.returncode == 0, done.stderr
        lines = plain(done.stdout)
        assert lines[: len(plain(printed))] == plain(printed)


@pytest.fixture
def _own_folder(tmp_path: Path) -> Iterator[None]:
    with chdir(tmp_path):
        yield


@pytest.mark.usefixtures("_own_folder")
def test_recordings_page_examples_run_and_print_the_shown_output(demo: Appliance) -> None:
    page = (DOCS / "recordings.md").read_text()
    page = page.partition("\n## Recording\n")[2].partition("\n### Conditions\n")[0]
    examples = [
        example
        for block in re.findall(r"```console\n(.*?)```", page, re.DOTALL)
        for example in commands(block)
    ]
    assert len(examples) >= 9
    for command, printed in examples:
        if command == "eapctl record snapshot":
            wait_until(lambda: '"ring_s":0.0' not in demo.command("record", "list", "--json"))
        done = run_eapctl(demo.runtime, *shlex.split(command)[1:])
        assert done.returncode == 0, (command, done.stderr)
        if printed:
            assert countless(done.stdout) == countless(printed)


def countless(text: str) -> list[str]:
    """Return the lines without folders and numbers of messages."""
    text = re.sub(r"/\S*/", "/", text)
    return re.sub(r"\d+ (messages|frames), (none|\d+) lost", r"N \1, N lost", text).splitlines()


def plain(text: str) -> list[str]:
    """Return the lines without times, rules and spaces."""
    timeless = re.sub(r"\d+(\.\d+)? (µs|ms|s)\b", "TIME", text.replace("─", ""))
    return [" ".join(line.split()) for line in timeless.splitlines() if line.strip()]
