"""``eapctl web``: command lines that are refused before anything is served."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from eap.cli.group import main
from tests.support.passwords import HASH

PLANT = """\
plant: line
stations:
  - name: mixer
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.0.0.1", net_id: 10.0.0.1.2.1}]
web:
"""
USERS = f'  users: [{{name: a, role: operator, password: "{HASH}"}}]\n'


def web(*words: object, stdin: str = "") -> Result:
    return CliRunner().invoke(main, ["web", *map(str, words)], input=stdin)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ([], "name a plant file, or a host with --connect"),
        (["--connect", "1.2.3.4.1.1"], "is not HOST or HOST:NETID"),
        (["--connect", "h", "--listen", "8080"], "'8080' is not an address with a port"),
    ],
)
def test_wrong_command_line_is_refused(words, reason):
    done = web(*words)
    assert (done.exit_code, reason in done.stderr) == (2, True)


@pytest.mark.parametrize(
    "keys",
    [
        "  listen: 127.0.0.1:8080\n",
        USERS,
        USERS + "  tls: {certificate: a.crt, key: a.key}\n  anonymous: engineer\n",
    ],
)
def test_address_for_other_hosts_needs_users_tls_and_no_open_role(tmp_path: Path, keys):
    for name in ("a.crt", "a.key"):
        (tmp_path / name).write_text("")
    plant = tmp_path / "plant.yaml"
    plant.write_text(PLANT + keys)
    done = web(plant, "--listen", "0.0.0.0:8080")
    assert done.exit_code == 2
    assert "--listen: 0.0.0.0:8080 is reached by other hosts" in done.stderr


@pytest.mark.parametrize("password", ["", "seven77", "x" * 257])
def test_short_or_long_password_is_refused(password):
    done = web("--password", "anna", stdin=f"{password}\n")
    assert done.exit_code == 2
    assert f"the password has {len(password)} characters; expected at least 8" in done.stderr
