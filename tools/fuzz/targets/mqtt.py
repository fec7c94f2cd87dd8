"""Messages by MQTT: whatever comes, no exception, bounded memory, and no answer to an answer."""

from __future__ import annotations

from eap.ams.mqtt.network import MqttNetwork, PacketReceived, Publish
from eap.ams.routes import RouteTable
from eap.ams.spec import MqttSpec
from eap.codec.ams import AmsHeader, StateFlags
from eap.ids import NetId
from tools.fuzz.messages import cut

_OWN = NetId.parse("5.1.1.1.1.1")
_TOPICS = (
    "hall/5.1.1.1.1.1/ams",
    "hall/5.1.1.1.1.1/ams/res",
    "hall/6.1.1.1.1.1/info",
    "hall/5.1.1.1.1.1/info",
)


def fuzz_one(data: bytes) -> None:
    """Publish *data* everywhere; then cut, each piece where its first octet says."""
    spec = MqttSpec(network="hall", host="", no_retain=True)
    network = MqttNetwork(spec, _OWN, "fuzz", transport="mqtt:hall", table=RouteTable())
    network.connected(0)
    for topic in _TOPICS:
        _feed(network, topic, data)
    _feed(network, data[:40].decode(errors="replace"), data)
    _feed(network, _TOPICS[2], b"<info><online>" + data + b"</online></info>")
    for message in cut(data):
        topic = _TOPICS[message[0] & 3] if message else _TOPICS[0]
        _feed(network, topic, message[1:])
    network.handle_timeout(1 << 60)


def _feed(network: MqttNetwork, topic: str, payload: bytes) -> None:
    for action in network.receive_message(topic, payload, 1):
        if isinstance(action, Publish) and "/ams" in action.topic:
            header = AmsHeader.decode(action.payload[-AmsHeader.SIZE :])
            if not header.state_flags & StateFlags.RESPONSE:
                raise AssertionError("what was asked is answered with a request")
        elif isinstance(action, PacketReceived):
            back = network.message_for(action.connection, action.packet)
            network.receive_message(back.topic, back.payload, 1)
