"""Rules that are not tested by way of a plant file or a dictionary."""

from __future__ import annotations

import pytest

from eap.ids import DestinationKind
from eap.pd.rules import data_budget, duplicates, frame_budget, is_group, is_name


@pytest.mark.parametrize(
    ("scheme", "kind", "octets"),
    [
        ("udp", DestinationKind.IP, 1472),
        ("udp", DestinationKind.TCP, 2049),
        ("udp", None, 1472),
        ("tcp", DestinationKind.TCP, 2049),
        ("tcp", None, 2049),
        ("ethernet", DestinationKind.MAC, 1500),
        ("ethernet", DestinationKind.NET_ID, 1500),
        ("ethernet", None, 1500),
        ("loop", DestinationKind.MAC, 2049),
        ("loop", None, 2049),
    ],
)
def test_frame_budget_is_that_of_the_wire(scheme, kind, octets):
    assert frame_budget(scheme, kind) == octets


@pytest.mark.parametrize(("scheme", "octets"), [("ethernet", 1478), ("tcp", 2027), ("udp", 2027)])
def test_data_budget_is_that_of_the_largest_frame_with_one_pd(scheme, octets):
    assert data_budget(scheme) == octets


@pytest.mark.parametrize(
    ("text", "scheme", "is_one"),
    [
        ("239.1.1.1", "udp", True),
        ("10.1.1.1", "udp", False),
        ("01:01:05:04:00:07", "ethernet", True),
        ("02:01:05:04:00:07", "ethernet", False),
        ("239.1.1.1", "ethernet", False),
        ("239.1.1.1", "tcp", False),
        ("01:01:05:04:00:00", "loop", False),
    ],
)
def test_group_is_of_the_kind_of_its_interface(text, scheme, is_one):
    assert is_group(text, scheme) is is_one


def test_names_have_no_spaces_and_no_slashes():
    assert [text for text in ("level", "a b", "a/b", "", "größe") if is_name(text)] == [
        "level", "größe",
    ]  # fmt: skip


def test_duplicates_are_yielded_with_first_of_key():
    assert list(duplicates([(1, "a"), (2, "b"), (1, "c"), (1, "d")])) == [("c", "a"), ("d", "a")]
