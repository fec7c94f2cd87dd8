"""Tables with a row for each mailbox protocol: a forgotten row fails here, with its place."""

from __future__ import annotations

import pytest

from devicebus.mailbox import conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.sim.device import Device
from devicebus.sim.devices.protocols import build_mailbox
from devicebus.sim.spec import MailboxSpec
from devicebus.wire.sii import SiiProtocol
from eap.codec.mailbox import MailboxType
from eap.gateway import requests
from eap.od.dictionary import ObjectDictionary

PROTOCOLS = [kind for kind in MailboxType if kind is not MailboxType.ERR]


@pytest.mark.parametrize(
    ("table", "place"),
    [
        (conversation._RULES, "_RULES of devicebus/mailbox/conversation.py"),
        (requests._PROTOCOLS, "_PROTOCOLS of eap/gateway/requests.py"),
    ],
    ids=["conversation", "gateway"],
)
def test_table_has_a_row_for_each_mailbox_type(table, place):
    missing = [kind.name for kind in MailboxType if kind not in table]
    assert not missing, f"add {', '.join(missing)} to {place}"


def only(kind):
    """Return the mailbox of a slave with one protocol."""
    names = {each.name.lower() for each in PROTOCOLS} & {*MailboxSpec.__struct_fields__}
    return MailboxSpec(**{name: name == kind.name.lower() for name in names})


@pytest.mark.parametrize("kind", PROTOCOLS)
def test_mailbox_spec_has_a_field_for_each_mailbox_type(kind):
    assert kind.name.lower() in MailboxSpec.__struct_fields__, (
        f"add {kind.name.lower()} to MailboxSpec of devicebus/sim/spec.py"
    )


@pytest.mark.parametrize("kind", PROTOCOLS)
def test_simulated_slave_has_a_server_for_each_mailbox_type(kind):
    server = build_mailbox(only(kind), (), Device("d", ObjectDictionary()), MailboxSizes())
    assert list(server.protocols) == [kind], (
        f"add {kind.name} to build_mailbox of devicebus/sim/devices/protocols.py"
    )


@pytest.mark.parametrize("kind", PROTOCOLS)
def test_sii_image_has_the_bit_of_each_mailbox_type(kind):
    assert SiiProtocol.of(kind), f"add {kind.name} to SiiProtocol of devicebus/wire/sii.py"
