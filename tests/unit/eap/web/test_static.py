"""Files of the page: texts in all languages, and nothing that its policy would block."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from eap.config.web_sections import Panel
from eap.web.server import STATIC

TEXTS = {
    path.stem.removeprefix("text-"): json.loads(path.read_text("utf-8"))
    for path in STATIC.glob("text-*.json")
}
OWN_SCRIPTS = [path for path in sorted(STATIC.glob("*.js")) if path.name != "uPlot.js"]
CALL = re.compile(r'\bt\((?:[^()]*\? )?"([a-z_]+)"(?: : "([a-z_]+)")?')
NAMED = re.compile(r'\btn\("([a-z_]+)"')


def test_languages_have_the_same_texts():
    assert set(TEXTS) == {"en", "zh"}
    assert list(TEXTS["en"]) == list(TEXTS["zh"])
    assert all(TEXTS["en"].values())
    assert all(TEXTS["zh"].values())


def test_texts_have_the_same_parameters():
    for key, text in TEXTS["en"].items():
        parameters = sorted(re.findall(r"\{\w+\}", text))
        assert parameters == sorted(re.findall(r"\{\w+\}", TEXTS["zh"][key])), key


def test_scripts_use_texts_that_there_are_and_all_of_them():
    used: set[str] = {"panel_findings"}
    prefixes: set[str] = set()
    for path in OWN_SCRIPTS:
        text = path.read_text("utf-8")
        used |= {key for match in CALL.findall(text) for key in match if key}
        prefixes |= set(NAMED.findall(text))
    for panel in Panel.__args__:
        used.add(f"panel_{panel.__struct_config__.tag}")
    plain = {key for key in TEXTS["en"] if "." not in key}
    assert used == plain
    assert prefixes == {key.partition(".")[0] for key in TEXTS["en"] if "." in key}


@pytest.mark.parametrize("path", OWN_SCRIPTS, ids=lambda path: path.name)
def test_script_imports_files_that_there_are(path: Path):
    for name in re.findall(r'from "\./([^"]+)"', path.read_text("utf-8")):
        assert (STATIC / name).is_file(), name


def test_no_style_or_script_is_inline():
    html = (STATIC / "index.html").read_text("utf-8")
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\bsrc=)", html)
    for path in OWN_SCRIPTS:
        text = path.read_text("utf-8")
        assert not re.search(r"innerHTML|\bstyle:|eval\(|setAttribute\(\"style\"", text), path.name


def test_files_that_the_page_names_are_there():
    html = (STATIC / "index.html").read_text("utf-8")
    for name in re.findall(r'(?:href|src)="([^"#]+)"', html):
        assert (STATIC / name).is_file(), name


def test_vendored_script_has_its_licence_and_an_export():
    text = (STATIC / "uPlot.js").read_text("utf-8")
    assert "uPlot 1.6.32" in text.splitlines()[0]
    assert text.endswith("export default uPlot;\n")
    assert "MIT License" in (STATIC / "uPlot-LICENSE.txt").read_text("utf-8")
