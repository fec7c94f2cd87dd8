"""Files of keys, the commands that change them, and what a plant file says about signatures."""

from __future__ import annotations

import os

import pytest

from eap.config.pd_keys import MAX_KEYS, format_keys, parse_keys, read_keys
from eap.errors import EnvironmentalError
from eap.ops.pd_keys import add_key, list_keys, remove_key, sign_with
from eap.pd.authentication import Keys
from eap.pd.spec import Authentication

ONE, TWO = "11" * 32, "22" * 32
SIGN = ("to: 127.0.9.2", "to: 127.0.9.2, sign: true")
REQUIRE = ("timeout_ms: 50", "timeout_ms: 50, auth: required")


def test_first_key_of_a_file_signs():
    keys = parse_keys(f"# comment\n\n2 {TWO}  # of spring\n1 {ONE}\n".encode())
    assert keys == Keys({2: bytes.fromhex(TWO), 1: bytes.fromhex(ONE)}, 2)
    assert parse_keys(format_keys(keys).encode()) == keys


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no key in it"),
        ("# 1\n", "no key in it"),
        (f"1 {ONE}\n1 {TWO}", "line 2: key 1 is there already"),
        (f"0 {ONE}", "line 1: key 0, expected 1 to 65535"),
        (f"65536 {ONE}", "line 1: key 65536"),
        (ONE, "line 1: no number"),
        (f"1 {ONE} x", "line 1: no number"),
        (f"1 {ONE[:-2]}", "line 1: key of 31 bytes, expected 32"),
        ("1 xyz", "line 1: no number"),
        ("\n".join(f"{number} {ONE}" for number in range(1, MAX_KEYS + 2)), "65 keys, at most 64"),
        ("#" * (1 << 17), "more than 65536 bytes"),
    ],
)
def test_wrong_files_are_named_without_telling_a_key(text, reason):
    with pytest.raises(ValueError, match=reason) as error:
        parse_keys(text.encode())
    assert "11" * 8 not in str(error.value)


def test_commands_add_exchange_and_remove_keys(tmp_path):
    path = tmp_path / "plant.keys"
    (first,) = add_key(path)
    assert (first.number, first.signs) == (1, True)
    assert path.stat().st_mode & 0o777 == 0o600
    assert [(key.number, key.signs) for key in add_key(path)] == [(1, True), (2, False)]
    with pytest.raises(EnvironmentalError, match="key 1 signs; let another one sign first"):
        remove_key(path, 1)
    assert [key.number for key in sign_with(path, 2)] == [2, 1]
    assert read_keys(path).signing == 2
    assert [key.number for key in remove_key(path, 1)] == [2]
    for change in (sign_with, remove_key):
        with pytest.raises(EnvironmentalError, match="there is no key 7; it has 2"):
            change(path, 7)
    assert [key.number for key in list_keys(path)] == [2]


def test_files_that_others_may_read_and_pipes_are_refused(tmp_path):
    path = tmp_path / "plant.keys"
    add_key(path)
    path.chmod(0o640)
    with pytest.raises(EnvironmentalError, match=f"others may read its keys: chmod 600 {path}"):
        read_keys(path)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(EnvironmentalError, match="no regular file"):
        read_keys(pipe)


@pytest.fixture
def keys(tmp_path):
    path = tmp_path / "plant.keys"
    add_key(path)
    return "plant: pair", f"plant: pair\ndefaults: {{pd_keys: {path}}}"


def test_signature_and_keys_reach_the_specification(load_plant, keys, tmp_path):
    result = load_plant(keys, SIGN, REQUIRE)
    assert result.findings == ()
    left, right = result.plant.stations
    assert left.frames[0].sign
    assert right.subscriptions[0].auth is Authentication.REQUIRED
    assert left.pd_keys == right.pd_keys == str(tmp_path / "plant.keys")


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        ([SIGN], "frame 'out' is signed, but left has no keys"),
        ([REQUIRE], "looks at signatures, but right has no keys"),
        (
            [("from: left/state", "from: left/state, auth: count")],
            "looks at the signature of left/state, but frame 'out' (line",
        ),
        (
            [
                REQUIRE,
                ("from: left/state", "foreign: true, from: {publisher: any, id: 4}"),
            ],
            "'seen' looks at signatures of any publisher",
        ),
        (
            [SIGN, ("frame: out, id: 1", "frame: out, id: 65534")],
            "frame 'out' is signed and carries a PD with id 65534",
        ),
    ],
)
def test_what_cannot_be_checked_is_a_finding(load_plant, keys, edits, finding):
    has_keys = "has no keys" not in finding
    result = load_plant(*([keys] if has_keys else []), *edits)
    assert result.plant is None
    assert any(finding in each.message for each in result.findings), result.findings
