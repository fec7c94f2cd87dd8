"""``eapctl top`` without a screen: rows for scripts and plain terminals."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from tests.unit.eap.cli.conftest import Appliance

pytestmark = pytest.mark.net

CONTRACT = {"name", "state", "tx_per_s", "rx_per_s", "lost", "late", "age_us", "bus"}


def top(*words: str) -> Result:
    return CliRunner().invoke(main, ["top", "--interval", "0.1", *words])


def test_once_prints_one_object_for_each_station(appliance: Appliance) -> None:
    result = top("--once", "--json")
    assert (result.exit_code, result.stderr) == (0, "")
    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert [row["name"] for row in rows] == ["mixer", "filler"]
    assert all(set(row) >= CONTRACT for row in rows)
    assert isinstance(rows[0]["tx_per_s"], float)


def test_count_prints_all_stations_so_many_times(other_appliance: Appliance) -> None:
    result = top("--count", "3", "--json")
    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(rows) == 3 * 4
    assert {row["plant"] for row in rows} == {"hall", "line"}


def test_plant_filter_and_sort_choose_rows(other_appliance: Appliance) -> None:
    def names(*words: str) -> list[str]:
        result = top("--once", "--json", *words)
        assert result.exit_code == 0, result.stderr
        return [json.loads(line)["name"] for line in result.stdout.splitlines()]

    assert names("--plant", "hall") == ["oven", "mixer"]
    assert names("--filter", "name=mi*") == ["mixer", "mixer"]
    assert names("--sort", "name") == ["filler", "mixer", "mixer", "oven"]
    assert names("--filter", "lost>1000000") == []


def test_piped_rows_are_a_table(appliance: Appliance) -> None:
    lines = top("--once").stdout.splitlines()
    assert "line: " in lines[0]
    assert lines[1].split()[:6] == ["Station", "State", "Tx/s", "Rx/s", "Lost", "Late"]
    assert [line.split()[0] for line in lines[3:5]] == ["mixer", "filler"]


def test_wrong_filter_key_or_host_is_a_usage_error() -> None:
    for words, reason in (
        (["--filter", "lst>0"], "--filter: no key 'lst', did you mean lost?"),
        (["--sort", "lst"], "'lst' is not one of"),
        (["--connect", "10.0.0.5:5.1"], "Invalid value for '--connect'"),
        (["--connect", "5.1.1.1.1.1"], "is not HOST or HOST:NETID"),
        (["--count", "0"], "Invalid value for '--count'"),
    ):
        result = top(*words)
        assert result.exit_code == 2
        assert reason in result.stderr


def test_nothing_that_runs_is_an_error_with_the_remedy(runtime: Path) -> None:
    result = top("--once", "--json")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "no appliance runs: start one with 'eapctl run PLANT'" in result.stderr


def test_screen_without_textual_is_a_plain_view(
    appliance: Appliance, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours = ("eap.cli.routes_tui", "eap.cli.top_tui")
    for name in [name for name in sys.modules if name.startswith(ours)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "textual", None)
    monkeypatch.setattr("eap.cli.top._is_screen", lambda: True)
    monkeypatch.setattr("eap.cli.top.repaint", lambda parts: sys.exit(len(parts) and 17))
    result = top()
    assert result.exit_code == 17
    assert "pip install 'eap-appliance[tui]'" in result.stderr
