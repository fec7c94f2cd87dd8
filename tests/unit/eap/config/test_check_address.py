from __future__ import annotations

import pytest

LEFT, RIGHT = '"udp://127.0.9.1"', '"udp://127.0.9.2"'
ETHERNET = ((LEFT, '"ethernet://eth0"'), (RIGHT, '"ethernet://eth1"'))
TO = "to: 127.0.9.2}"
RIGHT_ID = "net_id: 127.0.9.2.2.1}"
TCP = RIGHT_ID, "net_id: 127.0.9.2.2.1, tcp: true}"
SENDS_BACK = """
    variables: {back: UINT}
    frames:
      - {name: back, port: eap0, to: TARGET}
    publish:
      - {name: back, frame: back, id: 9, variables: [back]}
    subscribe:"""


def to(text):
    return TO, f"to: {text}}}"


def back(target):
    return "\n    subscribe:", SENDS_BACK.replace("TARGET", target)


def test_net_id_with_the_mac_of_its_port(load_plant):
    mac = RIGHT_ID, "net_id: 127.0.9.2.2.1, mac: 02-00-00-00-00-0A}"
    for text in ("right/eap0", "127.0.9.2.2.1", "127.0.9.2.1.1"):
        result = load_plant(*ETHERNET, to(text), mac)
        assert result.findings == ()
        frame = result.plant.stations[0].frames[0]
        assert (frame.destination, frame.mac) == ("127.0.9.2.2.1", "02:00:00:00:00:0a")


@pytest.mark.parametrize("target", ["multicast", "broadcast", "02:00:00:00:00:01"])
def test_net_id_is_learned_from_what_its_port_sends(load_plant, target):
    result = load_plant(*ETHERNET, to("right/eap0"), back(target))
    assert result.findings == ()
    frame = result.plant.stations[0].frames[0]
    assert (frame.destination, frame.mac) == ("127.0.9.2.2.1", "")


def test_net_id_is_learned_only_from_groups_that_its_sender_has_joined(findings):
    group = "01:01:05:04:00:07"
    assert len(findings(*ETHERNET, to("right/eap0"), back(group))) == 1
    join = "net_id: 127.0.9.1.2.1}", f'net_id: 127.0.9.1.2.1, join: ["{group}"]}}'
    assert findings(*ETHERNET, to("right/eap0"), back(group), join) == []
    publish = "    publish:\n      - {name: state,"
    takes = publish, f"    subscribe: [{{name: b, port: eap0, from: right/back}}]\n{publish}"
    assert findings(*ETHERNET, to("right/eap0"), back(group), takes) == []


def test_net_id_on_udp_is_the_address_of_its_port(load_plant):
    result = load_plant(to("127.0.9.2.2.1"))
    assert result.plant.stations[0].frames[0].destination == "127.0.9.2"


def test_net_id_that_nothing_tells(findings):
    (only,) = findings(*ETHERNET, to("127.0.9.2.2.1"))
    assert only.startswith(
        "13: frame 'out' goes to the NetID of right/eap0, whose MAC address noth"
    )
    assert only.endswith("; such a frame, or mac: on that port (line 19)")


def test_two_that_wait_for_each_other(findings):
    assert len(findings(*ETHERNET, to("right/eap0"), back("left/eap0"))) == 2
    mac = "net_id: 127.0.9.1.2.1}", 'net_id: 127.0.9.1.2.1, mac: "02:00:00:00:00:01"}'
    assert findings(*ETHERNET, to("right/eap0"), back("left/eap0"), mac) == []


def test_frame_to_its_own_net_id(findings):
    found = findings(*ETHERNET, to("127.0.9.1.2.1"))
    assert "13: frame 'out' goes to the NetID of its own port; another port" in found


def test_net_id_outside_the_plant_is_left_to_be_heard(load_plant):
    result = load_plant(
        *ETHERNET, to("5.5.5.5.1.1"), ("timeout_ms: 50", "timeout_ms: 50, foreign: true"),
        ("from: left/state", "from: {publisher: 5.5.5.5.1.1, id: 4}"),
    )  # fmt: skip
    assert result.findings == ()
    assert result.plant.stations[0].frames[0].destination == "5.5.5.5.1.1"


def test_monitoring(load_plant):
    frame = load_plant(to("127.0.9.2, monitor_interval_ms: 500")).plant.stations[0].frames[0]
    assert (frame.monitor_interval_ms, frame.monitor_ip) == (500, "")
    text = "02:00:00:00:00:01, monitor_interval_ms: 2000, monitor_ip: 10.0.0.2"
    frame = load_plant(*ETHERNET, to(text)).plant.stations[0].frames[0]
    assert (frame.monitor_interval_ms, frame.monitor_ip) == (2000, "10.0.0.2")
    for edits in ([], [to("255.255.255.255, monitor_interval_ms: 0")]):
        assert load_plant(*edits).plant.stations[0].frames[0].monitor_interval_ms == 0


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        (
            [to("255.255.255.255, monitor_interval_ms: 500")],
            "13: frame 'out' is monitored but goes to many; it only on a unicast frame",
        ),
        (
            [*ETHERNET, to("multicast, monitor_interval_ms: 500, monitor_ip: 10.0.0.2")],
            "13: frame 'out' is monitored but goes to many; it only on a unicast frame",
        ),
        (
            [to("tcp://127.0.9.2, monitor_interval_ms: 500"), TCP],
            "13: frame 'out' is monitored but goes to tcp://127.0.9.2 by udp://127.0.9.1; E",
        ),
        (
            [to("127.0.9.2, monitor_interval_ms: 99")],
            "13: monitor_interval_ms is 99; at least 100, or 0 for never",
        ),
        (
            [to("127.0.9.2, monitor_interval_ms: 500, monitor_ip: 127.0.9.2")],
            "13: frame 'out' has a monitor_ip, but its own address says whom to look for",
        ),
        (
            [*ETHERNET, to("02:00:00:00:00:01, monitor_ip: 10.0.0.2")],
            "13: frame 'out' has a monitor_ip but no monitor_interval_ms; both or none",
        ),
        *(
            (
                [*ETHERNET, to(f"02:00:00:00:00:01, monitor_interval_ms: 500, monitor_ip: {text}")],
                f"13: monitor_ip is '{text}'; the IPv4 address of one host",
            )
            for text in ("there", "127.0.0.1", "224.0.0.1", "255.255.255.255", "0.0.0.0")
        ),
    ],
)
def test_what_cannot_be_monitored(findings, edits, finding):
    (only,) = findings(*edits)
    assert only.startswith(finding)
