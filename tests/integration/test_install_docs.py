"""docs/install.md: its examples, and its tables against what is built."""

from __future__ import annotations

import json
import re
import tomllib

import pytest
import yaml

from eap.runtime.log import LogLine
from tests.support.pages import ROOT, commands, shell

pytestmark = pytest.mark.net

PAGE = (ROOT / "docs/install.md").read_text()


def test_examples_of_the_page_print_what_it_shows():
    blocks = re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)
    with shell() as opened:
        shown = [(each, opened.run(each)) for block in blocks for each, _ in commands(block)]
    assert shown == [pair for block in blocks for pair in commands(block)]


def test_table_of_extras_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    rows = re.findall(r"^\| `(\w+)` \|.*\| (.*?) ?\|$", PAGE, re.MULTILINE)
    assert [name for name, _ in rows] == list(project["optional-dependencies"])
    for name, brings in rows[:-1]:
        required = project["optional-dependencies"][name]
        assert all(word in " ".join(required) for word in brings.split(", ")), name


def test_line_of_the_log_has_the_fields_of_the_page():
    (example,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    assert {*json.loads(example), "trace"} == set(LogLine.__struct_fields__)


def test_container_files_are_read():
    folder = ROOT / "docs/examples/container"
    compose = yaml.safe_load((folder / "compose.yaml").read_text())
    assert set(compose["services"]) == {"eap", "mosquitto", "prometheus", "postgres"}
    mounted = re.findall(r"\./([\w.-]+):", str(compose))
    assert {"mosquitto.conf", "prometheus.yaml", "plant"} == set(mounted)
    assert "eap-appliance_*.deb" in (folder / "Containerfile").read_text()
