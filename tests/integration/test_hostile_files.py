"""Hostile files: each is a finding, and nothing of it is executed or read."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.appliance import run_eapctl

LAUGHS = "\n".join(
    ['<?xml version="1.0"?>', "<!DOCTYPE l [", '<!ENTITY a0 "ha">']
    + [f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 10)]
    + ["]>", "<EtherCATConfig>&a9;</EtherCATConfig>"]
)
OUTSIDE = (
    '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY x SYSTEM "file:///etc/passwd">]>'
    "<EtherCATConfig>&x;</EtherCATConfig>"
)


@pytest.mark.parametrize("text", [LAUGHS, OUTSIDE, "<a>" * 100_000])
def test_hostile_import_files_are_findings(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bomb.xml"
    file.write_text(text)
    done = run_eapctl(tmp_path, "import", str(file), "--output-file", str(tmp_path / "plant.yaml"))
    assert done.returncode == 2
    assert "bomb.xml" in done.stderr
    assert "root:" not in done.stdout + done.stderr
    assert not (tmp_path / "plant.yaml").exists()


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*{'a' if not n else f'b{n - 1}'}"
        f", *{'a' if not n else f'b{n - 1}'}]\n" for n in range(40)),
        "[" * 100_000,
        "plant: !!python/object/apply:os.system [id]\nstations: []\n",
    ],
)  # fmt: skip
def test_hostile_plant_files_are_findings(tmp_path: Path, text: str) -> None:
    file = tmp_path / "bomb.yaml"
    file.write_text(text)
    done = run_eapctl(tmp_path, "check", str(file))
    assert done.returncode == 2
    assert "bomb.yaml" in done.stderr
    assert "uid=" not in done.stdout + done.stderr
