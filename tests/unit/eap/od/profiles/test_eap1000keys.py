from __future__ import annotations

import pytest

from eap.od.profiles import eap1000 as profile
from eap.od.profiles import eap1000keys as keys
from eap.od.profiles.eap1000keys import Derived, Live
from eap.pd.device import DeviceState
from eap.pd.spec import Substitute, Wake, Writer


@pytest.mark.parametrize(
    ("index", "names"),
    [
        (0x6000, keys.Var),
        (0x8000, keys.Frame),
        (0xD000, keys.Tx),
        (0xE000, keys.Rx),
        (0xF100, keys.Status),
        (0xF800, keys.Configured),
        (0xF810, keys.Port),
    ],
)
def test_each_name_is_that_of_its_entry_and_none_is_missing(index, names):
    row = profile.row_of(index)
    table = {
        entry.name.removesuffix(" {n}").upper().replace(" ", "_").replace("-", "_"): entry.subindex
        for entry in row.entries
    }
    assert {each.name: each.value for each in names} == table


def test_received_variables_have_what_sent_ones_have_but_a_writer():
    sent, received = profile.TX_VARIABLE, profile.RX_VARIABLE
    assert [e.name for e in sent.entries if e.subindex != keys.Var.WRITER] == [
        e.name for e in received.entries
    ]


def test_every_key_is_shown_by_an_entry():
    entries = [entry for row in profile.ALL for entry in row.entries]
    assert {entry.live for entry in entries} - {""} == set(Live)
    assert {entry.derived for entry in entries} - {""} == set(Derived)


def test_numbers_stand_for_the_words_of_specifications():
    assert {each.name for each in keys.WrittenBy} == {each.name for each in Writer}
    assert {each.name for each in keys.Substituted} == {each.name for each in Substitute}
    assert {each.name for each in keys.Waking} == {each.name for each in Wake}
    assert (
        profile.row_of(0xF100)
        .row(1)
        .description.startswith(
            ", ".join(
                f"{state.value} {name}" for state, name in zip(DeviceState, _STATES, strict=True)
            )
        )
    )


_STATES = ("Init", "PreOp", "SafeOp", "Op")
