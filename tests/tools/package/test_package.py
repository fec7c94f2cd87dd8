"""Parts of the packages that need no build: man pages, bill of materials, versions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from eap.cli.group import main as eapctl
from tools.package import sbom
from tools.package.deb import debian_version
from tools.package.manpages import pages

COMMANDS = sorted(eapctl.list_commands(None))


def test_man_pages_cover_all_commands_and_have_no_stray_requests():
    found = dict(pages("0.1.0", "2026-11-23"))
    assert {f"eapctl-{name}.1" for name in COMMANDS} <= set(found)
    assert "eapctl-pd-set.1" in found
    assert all(
        f"\\fBeapctl\\-{name.replace('-', chr(92) + '-')}\\fR(1)" in found["eapctl.1"]
        for name in COMMANDS
    )
    requests = (".TH", ".SH", ".TP", ".PP", ".br", ".nf", ".fi")
    for text in found.values():
        lines = text.splitlines()
        assert lines[0].endswith('"2026-11-23" "eap-appliance 0.1.0" "EAP appliance"')
        assert [
            each for each in lines if each.startswith((".", "'")) and not each.startswith(requests)
        ] == []
    assert "eapctl log debug routing" in found["eapctl-log.1"]


def distribution(folder: Path, name: str, *metadata: str) -> None:
    info = folder / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    lines = ["Metadata-Version: 2.4", f"Name: {name}", "Version: 1.0", *metadata]
    (info / "METADATA").write_text("\n".join(lines) + "\n")


def test_bill_names_all_that_is_installed_and_is_the_same_each_time(tmp_path):
    distribution(
        tmp_path, "eap-appliance", "Requires-Dist: A_b>=1", "Requires-Dist: gone; extra == 'x'"
    )
    distribution(tmp_path, "A_b", "License-Expression: MIT")
    distribution(tmp_path, "zz", "Classifier: License :: OSI Approved :: BSD License")
    (tmp_path / "eap/web/static").mkdir(parents=True)
    (tmp_path / "eap/web/static/uPlot.js").write_text("// uPlot 1.6.32, MIT")
    text = sbom.bill(tmp_path)
    assert text == sbom.bill(tmp_path)
    bill = json.loads(text)
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert bill["metadata"]["component"]["purl"] == "pkg:pypi/eap-appliance@1.0"
    assert [(each["name"], each["licenses"]) for each in bill["components"]] == [
        ("A_b", [{"expression": "MIT"}]),
        ("zz", [{"license": {"name": "BSD License"}}]),
        ("uPlot", [{"license": {"id": "MIT"}}]),
    ]
    assert bill["dependencies"][0] == {
        "ref": "pkg:pypi/eap-appliance@1.0",
        "dependsOn": ["pkg:pypi/a-b@1.0"],
    }


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("0.2.0", "0.2.0"),
        ("0.2.0.dev3+gabc", "0.2.0~dev3+gabc"),
        ("0.2.0.post3+gabc.dirty", "0.2.0+post3+gabc.dirty"),
    ],
)
def test_debian_orders_development_before_release(version, expected):
    assert debian_version(version) == expected
