"""Software bill of materials of an installed folder, as CycloneDX 1.6 JSON.

    python -m tools.package.sbom FOLDER > FILE

The folder is one that ``pip install --target`` filled.  The same content gives the same bytes.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Any
from uuid import NAMESPACE_URL, uuid5

PRODUCT = "eap-appliance"
_VENDORED = re.compile(r"(uPlot) ([\d.]+)")
_REQUIRED = re.compile(r"[\w.-]+")


def bill(folder: Path) -> str:
    """Return the bill of the distributions in *folder* as JSON text."""
    found = {_key(each): each for each in distributions(path=[str(folder)])}
    product = found.pop(PRODUCT)
    others = [found[key] for key in sorted(found)]
    components = [*map(_component, others), *_vendored(folder)]
    content: dict[str, Any] = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": _component(product) | {"type": "application"}},
        "components": components,
        "dependencies": [_dependency(each, found) for each in (product, *others)],
    }
    # Of the content, and not by chance: the same package has the same number.
    number = uuid5(NAMESPACE_URL, json.dumps(content, sort_keys=True))
    return json.dumps(content | {"serialNumber": f"urn:uuid:{number}"}, indent=1) + "\n"


def _key(each: Distribution) -> str:
    return re.sub(r"[-_.]+", "-", each.metadata["Name"]).lower()


def _ref(each: Distribution) -> str:
    return f"pkg:pypi/{_key(each)}@{each.version}"


def _component(each: Distribution) -> dict[str, Any]:
    data = each.metadata
    found = {"type": "library", "bom-ref": _ref(each), "name": data["Name"]}
    found |= {"version": each.version, "purl": _ref(each)}
    if licences := data.get_all("License-Expression", []):
        return found | {"licenses": [{"expression": each} for each in licences]}
    names = [
        text.rpartition(" :: ")[2]
        for text in data.get_all("Classifier", [])
        if text.startswith("License ::")
    ]
    return found | ({"licenses": [{"license": {"name": name}} for name in names]} if names else {})


def _vendored(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the files of others in the project: the plots of the page."""
    text = (folder / "eap/web/static/uPlot.js").read_text()
    match = _VENDORED.search(text)
    assert match is not None  # noqa: S101  its head names the version
    name, version = match.groups()
    ref = f"pkg:npm/{name.lower()}@{version}"
    licence = {"licenses": [{"license": {"id": "MIT"}}]}
    yield {
        "type": "library",
        "bom-ref": ref,
        "name": name,
        "version": version,
        "purl": ref,
    } | licence


def _dependency(each: Distribution, found: dict[str, Distribution]) -> dict[str, Any]:
    names = {
        re.sub(r"[-_.]+", "-", match[0]).lower()
        for text in each.requires or ()
        if (match := _REQUIRED.match(text))
    }
    return {
        "ref": _ref(each),
        "dependsOn": [_ref(found[name]) for name in sorted(names & found.keys())],
    }


if __name__ == "__main__":
    sys.stdout.write(bill(Path(sys.argv[1])))
