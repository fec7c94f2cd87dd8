"""The search for the holder of a port, on a /proc of our own making."""

from __future__ import annotations

import pytest

from eap.net.portholder import describe_holder, find_holders

LINE = "  7: {local} {remote} 07 0:0 00:0 0 0 0 {inode} 2 0 0\n"
PORT = "88A4"


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
    add_socket(proc, f"0101007F:{PORT}")
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
    add_socket(proc, f"{digits}:{PORT}", table=table)
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
    add_socket(proc, f"0101007F:{PORT}")
    add_process(proc, 44, "/usr/bin/python eapctl run plant.yaml")
    assert describe(proc).endswith("stop that appliance or give this one another address")


def test_long_paths_do_not_hide_whose_process_it_is(proc):
    add_socket(proc, f"0101007F:{PORT}")
    add_process(proc, 44, f"/{'long/' * 30}python /{'long/' * 30}eapctl run plant.yaml")
    text = describe(proc)
    assert "by process 44 (python eapctl run plant.yaml): stop that appliance" in text


def test_a_command_that_is_no_text_is_shown_all_the_same(proc):
    add_socket(proc, f"0101007F:{PORT}")
    add_process(proc, 45, "server")
    (proc / "45" / "cmdline").write_bytes(b"serv\xffer\0-x\0")
    assert "process 45 (serv\ufffder -x)" in describe(proc)


def test_client_on_an_ephemeral_port_is_told_from_a_server(proc):
    add_socket(proc, f"0101007F:{PORT}", remote="08080808:0035")
    text = describe(proc)
    assert "an unknown process, a client connected to 8.8.8.8:53; clients get any port" in text
    assert "32768 to 60999" in text
    assert text.endswith("`sysctl -w net.ipv4.ip_local_reserved_ports=34980`")


@pytest.mark.parametrize("reserved", ["34980", "1-9,34000-35000"])
def test_reserved_port_is_nobodys_by_chance(proc, reserved):
    (proc / "sys/net/ipv4/ip_local_reserved_ports").write_text(reserved + "\n")
    add_socket(proc, f"0101007F:{PORT}")
    assert "reserved_ports" not in describe(proc)


def test_missing_sysctl_is_no_trouble(proc):
    (proc / "sys/net/ipv4/ip_local_reserved_ports").unlink()
    add_socket(proc, f"0101007F:{PORT}", table="tcp")
    assert describe(proc, "TCP").endswith("stop it or choose another address")
