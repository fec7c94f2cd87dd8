"""Opening pairs of UDP sockets: sorting, groups, and what goes wrong."""

from __future__ import annotations

import socket

import pytest

from eap.errors import EnvironmentalError
from eap.net import ipsocket
from eap.net.ipsocket import (
    AddressKeeper,
    describe_holder,
    find_holders,
    open_ams_broadcast,
    open_ams_listener,
    open_ams_socket,
    open_udp_group_pair,
    open_udp_pair,
    open_udp_receiver,
)
from tests.support.addresses import own_address
from tests.unit.eap.net.conftest import ip

pytestmark = pytest.mark.net

PORT = 34980


def close(*pairs):
    for pair in pairs:
        for sock in pair:
            sock.close()


def received(sock):
    sock.setblocking(False)
    got = set()
    while True:
        try:
            got.add(sock.recv(100)[0])
        except BlockingIOError:
            return got


def send_all_types(sock, destination):
    for frame_type in range(16):
        sock.sendto(bytes([frame_type, frame_type << 4]), (destination, PORT))
    sock.sendto(b"\xee", (destination, PORT))


ENGINE = {n for n in range(16) if n not in (2, 3, 5)} | {0xEE}


def test_kernel_sorts_unicast_by_type():
    pair, other = open_udp_pair("127.0.3.14"), open_udp_pair("127.0.3.15")
    try:
        send_all_types(other[0], "127.0.3.14")
        assert received(pair[0]) == ENGINE
        assert received(pair[1]) == {2, 3, 5}
    finally:
        close(pair, other)


@pytest.mark.parametrize("group", ["239.88.164.1", "255.255.255.255"])
def test_each_process_gets_its_types_of_a_group(group):
    sender = open_udp_pair("127.0.3.14")
    pairs = [open_udp_group_pair(group, address) for address in ("127.0.3.14", "127.0.3.15")]
    try:
        send_all_types(sender[0], group)
        for engine, services in pairs:
            assert received(engine) == ENGINE
            assert received(services) == {2, 3, 5}
        assert received(sender[0]) == set()
    finally:
        close(sender, *pairs)


def test_udp_receiver_gets_all_types_and_is_exclusive():
    receiver, other = open_udp_receiver("127.0.3.14", PORT), open_udp_pair("127.0.3.15")
    try:
        send_all_types(other[0], "127.0.3.14")
        assert received(receiver) == {*range(16), 0xEE}
        with pytest.raises(EnvironmentalError, match=r"127\.0\.3\.14"):
            open_udp_receiver("127.0.3.14", PORT)
    finally:
        close((receiver,), other)


def test_second_appliance_is_refused_though_the_port_could_be_shared():
    pair = open_udp_pair("127.0.3.16")
    try:
        with pytest.raises(EnvironmentalError, match=r"^UDP 127.0.3.16:34980 is in use by process"):
            open_udp_pair("127.0.3.16")
    finally:
        close(pair)


def test_client_that_got_the_port_by_chance_is_named_with_the_cure():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.bind(("127.0.3.17", PORT))
        client.connect(("127.0.3.18", 53))
        with pytest.raises(EnvironmentalError) as caught:
            open_udp_pair("127.0.3.17")
    message = str(caught.value)
    assert "a client connected to 127.0.3.18:53" in message
    assert "ip_local_reserved_ports=34980" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: open_udp_pair("203.0.113.9"),
        lambda: open_udp_group_pair("239.88.164.1", "203.0.113.9"),
        lambda: open_udp_group_pair("255.255.255.255", "203.0.113.9"),
    ],
)
def test_foreign_address_is_named(attempt):
    with pytest.raises(EnvironmentalError, match=r"203\.0\.113\.9 is not an address of this mach"):
        attempt()


LINE = "  7: {local} {remote} 07 0:0 00:0 0 0 0 {inode} 2 0 0\n"
PORTHOLDER_PORT = "88A4"


@pytest.fixture
def proc(tmp_path):
    """A /proc with nobody on any port."""
    (tmp_path / "net").mkdir()
    for name in ("udp", "udp6", "tcp"):
        (tmp_path / "net" / name).write_text("header\n")
    sysctl = tmp_path / "sys/net/ipv4"
    sysctl.mkdir(parents=True)
    (sysctl / "ip_local_port_range").write_text("32768\t60999\n")
    (sysctl / "ip_local_reserved_ports").write_text("\n")
    return tmp_path


def add_socket(proc, local, *, remote="00000000:0000", inode=4711, table="udp"):
    with (proc / "net" / table).open("a") as file:
        file.write(LINE.format(local=local, remote=remote, inode=inode))


def add_process(proc, pid, command, inode=4711):
    folder = proc / str(pid) / "fd"
    folder.mkdir(parents=True)
    (folder / "3").symlink_to(f"socket:[{inode}]")
    (proc / str(pid) / "cmdline").write_bytes(command.replace(" ", "\0").encode() + b"\0")


def describe(proc, protocol="UDP"):
    return describe_holder(protocol, "127.0.1.1", 34980, proc=proc)


def test_holder_is_named_with_its_command(proc):
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}")
    add_process(proc, 42, "named -u bind")
    (proc / "77").mkdir()  # a process that ended, or that this user may not look into
    (proc / "sys/net/ipv4/ip_local_port_range").write_text("40000 60999")
    assert describe(proc) == (
        "UDP 127.0.1.1:34980 is in use by process 42 (named -u bind): "
        "stop it or choose another address"
    )


@pytest.mark.parametrize("table", ["udp", "udp6"])
def test_wildcard_holder_is_found(proc, table):
    digits = "00000000" if table == "udp" else "0" * 32
    add_socket(proc, f"{digits}:{PORTHOLDER_PORT}", table=table)
    add_process(proc, 43, "server")
    assert [holder.pid for holder in find_holders("UDP", "127.0.1.1", 34980, proc=proc)] == [43]


@pytest.mark.parametrize(
    "local", ["0201007F:88A4", "0101007F:88A5", "000080FE00000000FF005450B9FC5DFE:88A4"]
)
def test_other_sockets_do_not_matter(proc, local):
    add_socket(proc, local, table="udp6" if len(local) > 20 else "udp")
    assert find_holders("UDP", "127.0.1.1", 34980, proc=proc) == []
    assert "by an unknown process" in describe(proc)


def test_our_own_appliance_is_recognised(proc):
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}")
    add_process(proc, 44, "/usr/bin/python eapctl run plant.yaml")
    assert describe(proc).endswith("stop that appliance or give this one another address")


def test_holder_text_shortens_long_paths(proc):
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}")
    add_process(proc, 44, f"/{'long/' * 30}python /{'long/' * 30}eapctl run plant.yaml")
    text = describe(proc)
    assert "by process 44 (python eapctl run plant.yaml): stop that appliance" in text


def test_a_command_that_is_no_text_is_shown_all_the_same(proc):
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}")
    add_process(proc, 45, "server")
    (proc / "45" / "cmdline").write_bytes(b"serv\xffer\0-x\0")
    assert "process 45 (serv\ufffder -x)" in describe(proc)


def test_describe_holder_recognizes_client_on_ephemeral_port(proc):
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}", remote="08080808:0035")
    text = describe(proc)
    assert "an unknown process, a client connected to 8.8.8.8:53; clients get any port" in text
    assert "32768 to 60999" in text
    assert text.endswith("`sysctl -w net.ipv4.ip_local_reserved_ports=34980`")


@pytest.mark.parametrize("reserved", ["34980", "1-9,34000-35000"])
def test_reserved_port_is_nobodys_by_chance(proc, reserved):
    (proc / "sys/net/ipv4/ip_local_reserved_ports").write_text(reserved + "\n")
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}")
    assert "reserved_ports" not in describe(proc)


def test_missing_sysctl_is_no_trouble(proc):
    (proc / "sys/net/ipv4/ip_local_reserved_ports").unlink()
    add_socket(proc, f"0101007F:{PORTHOLDER_PORT}", table="tcp")
    assert describe(proc, "TCP").endswith("stop it or choose another address")


pytestmark = pytest.mark.net


def test_ams_sockets_second_open_names_remedy():
    address = own_address(0)
    with open_ams_listener(address) as listener, open_ams_socket(address) as datagrams:
        assert listener.getsockname() == (address, 48898)
        assert datagrams.getsockname() == (address, 48899)
        for open_again, port in ((open_ams_listener, 48898), (open_ams_socket, 48899)):
            with pytest.raises(EnvironmentalError) as refused:
                open_again(address)
            text = str(refused.value)
            assert f"{address}:{port} is in use by process" in text
            assert text.endswith(
                "; without AMS at this address the station runs too: `ams: false` at its EAP "
                "ports there"
            )


def test_listener_is_free_again_at_once_with_connections_in_time_wait():
    address = own_address(0)
    for _ in range(2):
        with (
            open_ams_listener(address) as listener,
            socket.create_connection((address, 48898)),
        ):
            listener.accept()[0].close()


def test_foreign_address_is_refused():
    for opener in (open_ams_listener, open_ams_socket):
        with pytest.raises(EnvironmentalError, match=r"192\.0\.2\.1"):
            opener("192.0.2.1")


@pytest.mark.parametrize(
    ("group", "bound"), [("", "127.255.255.255"), ("255.255.255.255", "255.255.255.255")]
)
def test_ams_broadcast_reaches_each_station(group, bound):
    sockets = [open_ams_broadcast(address, group) for address in ("127.9.6.1", "127.9.6.2")]
    try:
        assert [sock.getsockname() for sock in sockets] == [(bound, 48899)] * 2
        if not group:
            with open_ams_socket(own_address(0)) as asking:
                asking.sendto(b"who?", (bound, 48899))
                for sock in sockets:
                    sock.settimeout(5)
                    assert sock.recvfrom(10) == (b"who?", asking.getsockname())
    finally:
        for sock in sockets:
            sock.close()


def test_a_network_without_broadcasts_is_a_warning(monkeypatch, caplog):
    monkeypatch.setattr(ipsocket, "broadcast_of", lambda address: "")
    assert open_ams_broadcast("127.9.6.1", "") is None
    assert "tools do not find 127.9.6.1 by broadcast (UDP 48899): the network has no" in caplog.text


def test_a_broadcast_address_that_is_taken_is_a_warning(caplog):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.255.255.255", 48899))
        assert open_ams_broadcast("127.9.6.1", "") is None
    assert "Address already in use" in caplog.text


@pytest.mark.root
def test_keeper_joins_interfaces_made_again_more_often_than_a_socket_has_memberships(cable):
    near, far = cable
    keeper = AddressKeeper()
    ip(f"addr add 10.99.1.1/24 dev {near}")
    pair = open_udp_group_pair("239.99.1.1", "10.99.1.1", PORT)
    try:
        for sock in pair:
            keeper.keep_group(sock, "239.99.1.1", "10.99.1.1")
        for _ in range(24):  # the kernel's limit is 20 (net.ipv4.igmp_max_memberships)
            keeper.look()
            ip(f"link del {near}")
            keeper.look()
            ip(f"link add {near} type veth peer name {far}")
            ip(f"addr add 10.99.1.1/24 dev {near}")
        ip(f"link set {near} up")
        keeper.look()
        joined = socket.inet_aton("239.99.1.1") + socket.inet_aton("10.99.1.1")
        for sock in pair:
            with pytest.raises(OSError, match="Address already in use"):
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, joined)
    finally:
        close(pair)
