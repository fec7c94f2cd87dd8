"""``eapctl od write --from``."""

from __future__ import annotations

from contextlib import ExitStack

import pytest
from click.testing import CliRunner

from eap.cli.group import main
from eap.od.model import OdState
from tests.support.controlstub import ControlStub
from tests.support.oddevice import MemoryDevice, methods, mixer


@pytest.fixture
def device(runtime):
    device = MemoryDevice(mixer())
    with ExitStack() as stack:
        ControlStub("line", ["mixer"], methods(device), stack)
        yield device


def write(*words: str, text: str = ""):
    return CliRunner().invoke(main, ["od", "write", "mixer", "--from", *words], input=text)


def test_one_entry(device):
    assert write("-", text="0xD000:7 = UDINT 1").output == "mixer: 1 entry written\n"
    assert device.dictionary[0xD000].entries[7].value == 1


def test_refusal(device):
    device.state = OdState.OP
    result = write("-", text="0xD000:7 = UDINT 1")
    assert result.exit_code == 1
    assert "nothing was written before" in result.stderr


def test_files_that_are_none(device, tmp_path):
    assert write(str(tmp_path / "no.od")).exit_code == 1
    result = write("-", text="rubbish")
    assert result.exit_code == 2
    assert result.stderr.startswith("-:1: 'rubbish' is not INDEX:SUB = TYPE VALUE")
