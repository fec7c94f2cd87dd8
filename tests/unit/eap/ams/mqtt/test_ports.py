from __future__ import annotations

from eap.ams.mqtt.messages import FIRST_PORT, LAST_PORT, ClientPorts
from eap.ids import NetId
from tests.support.ams import NOTIFICATION, Ams, parse

OWN = "5.1.1.1.1.1"
TARGET = "6.1.1.1.2.1:1001"
TOOL, SECOND = "192.168.0.9.1.1:33000", "192.168.0.9.1.1:33001"


def asked_by(ports: ClientPorts, source: str) -> str:
    """Return the source that others see of a request of *source*."""
    out = parse(ports.to_network(Ams(TARGET, source, invoke_id=7, body=b"what").octets()))
    assert (out.target, out.invoke_id, out.body) == (TARGET, 7, b"what")
    return out.source


def test_client_asks_in_the_name_of_the_router_and_gets_its_answers() -> None:
    ports = ClientPorts(NetId.parse(OWN))
    asked = Ams(TARGET, TOOL, invoke_id=7, body=b"what")
    out = parse(ports.to_network(asked.octets()))
    assert out == asked._replace(source=f"{OWN}:{FIRST_PORT}")
    assert parse(ports.to_client(out.answer().octets())) == asked.answer()
    note = Ams(out.source, TARGET, command=NOTIFICATION, body=b"news")
    assert parse(ports.to_client(note.octets())) == note._replace(target=TOOL)


def test_each_client_has_a_port_and_keeps_it() -> None:
    ports = ClientPorts(NetId.parse(OWN))
    assert [asked_by(ports, each) for each in (TOOL, SECOND, TOOL)] == [
        f"{OWN}:{FIRST_PORT}", f"{OWN}:{FIRST_PORT + 1}", f"{OWN}:{FIRST_PORT}",
    ]  # fmt: skip
    assert len(ports) == 2


def test_programs_of_the_router_itself_keep_their_ports_unless_given_out() -> None:
    ports = ClientPorts(NetId.parse(OWN))
    assert asked_by(ports, f"{OWN}:30000") == f"{OWN}:30000"
    assert asked_by(ports, f"{OWN}:{FIRST_PORT + 9}") == f"{OWN}:{FIRST_PORT}"


def test_answers_and_notifications_of_this_station_go_out_as_they_are() -> None:
    ports = ClientPorts(NetId.parse(OWN))
    answer = Ams(TARGET, "6.1.1.1.1.1:33000").answer().octets()
    note = Ams(TARGET, "5.1.1.1.2.1:65535", command=NOTIFICATION).octets()
    assert (ports.to_network(answer), ports.to_network(note)) == (answer, note)


def test_requests_and_what_is_for_nobody_come_in_as_they_are() -> None:
    ports = ClientPorts(NetId.parse(OWN))
    source = asked_by(ports, TOOL)
    request = Ams(source, TARGET).octets()
    assert ports.to_client(request) == request
    for target in (f"{OWN}:{FIRST_PORT + 1}", f"{OWN}:30000", f"5.1.1.1.2.1:{FIRST_PORT}"):
        answer = Ams(TARGET, target).answer().octets()
        assert ports.to_client(answer) == answer


def test_client_silent_for_longest_makes_room() -> None:
    ports = ClientPorts(NetId.parse(OWN))
    first, second = asked_by(ports, TOOL), asked_by(ports, SECOND)
    for number in range(LAST_PORT - FIRST_PORT - 1):
        asked_by(ports, f"7.1.1.1.{number >> 8}.1:{number & 0xFF}")
    ports.to_client(Ams(TARGET, first).answer().octets())
    assert asked_by(ports, "8.1.1.1.1.1:1") == second
    assert asked_by(ports, TOOL) == first
    assert asked_by(ports, SECOND) == f"{OWN}:{FIRST_PORT + 2}"
    assert len(ports) == LAST_PORT - FIRST_PORT + 1
