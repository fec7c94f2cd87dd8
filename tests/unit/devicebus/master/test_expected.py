from __future__ import annotations

import pytest

from devicebus.errors import IdentityError
from devicebus.master.expected import ExpectedSlave, arrange, check_bus, fits, iter_differences
from devicebus.master.scan import Identity, scan
from tests.support.busline import Bench, Line, run, segment, slave

FOUND = run(
    Line(
        Bench(),
        segment(
            slave("coupler", product=1),
            slave("valve", product=2, serial=12, alias=5),
            slave("drive", product=3),
        ),
    ),
    scan(),
)
COUPLER, VALVE, DRIVE = (
    ExpectedSlave(name=f"the {name}", vendor=0xE5A, product=number)
    for number, name in enumerate(("coupler", "valve", "drive"), 1)
)


def differences(*expected, found=FOUND):
    return list(iter_differences(expected, found))


def test_the_bus_as_expected():
    check_bus([COUPLER, VALVE, DRIVE], FOUND)
    exact = ExpectedSlave(name="v", vendor=0xE5A, product=2, revision=0x10000, serial=12, alias=5)
    check_bus([COUPLER, exact, DRIVE], FOUND)


def test_a_missing_slave_is_one_difference():
    assert differences(COUPLER, VALVE, DRIVE, found=[FOUND[0], FOUND[2]]) == [
        "the valve is missing after coupler, expected vendor 0x00000E5A, product 0x00000002"
    ]
    (line,) = differences(COUPLER, VALVE, found=FOUND[1:2])
    assert line.startswith("the coupler is missing at the start")


def test_a_slave_too_many_is_one_difference():
    (line,) = differences(COUPLER, DRIVE)
    assert line == (
        "position 1 (station 1002): vendor 0x00000E5A, product 0x00000002,"
        " revision 0x00010000, expected no slave here"
    )


def test_another_slave_in_its_place():
    (line,) = differences(COUPLER, DRIVE, DRIVE)
    assert line == (
        "position 1 (station 1002): vendor 0x00000E5A, product 0x00000002, revision 0x00010000,"
        " expected the drive with vendor 0x00000E5A, product 0x00000003"
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"revision": 2}, "0x00000002, revision 0x00000002"),
        ({"serial": 99}, "0x00000002, serial 99"),
        ({"alias": 6}, "alias 5, expected v with alias 6"),
    ],
)  # fmt: skip
def test_details_are_compared_when_they_are_named(options, text):
    valve = ExpectedSlave(name="v", vendor=0xE5A, product=2, **options)
    (line,) = differences(COUPLER, valve, DRIVE)
    assert text in line


def test_an_unreadable_slave_says_why():
    broken = FOUND[1]._replace(fault="slave 1002: broken", identity=Identity(0, 0, 0))
    (line,) = differences(COUPLER, VALVE, DRIVE, found=[FOUND[0], broken, FOUND[2]])
    assert line == "position 1 (station 1002): slave 1002: broken, expected the valve"


def test_all_differences_are_told_at_once():
    with pytest.raises(IdentityError) as caught:
        check_bus([VALVE, DRIVE, COUPLER], FOUND)
    assert str(caught.value).startswith(
        "the bus is not as configured (3 slaves expected, 3 found):\n  "
    )
    assert len(str(caught.value).splitlines()) == 4


def test_whether_a_slave_fits():
    assert fits(VALVE, Identity(0xE5A, 2, 1, 1))
    assert not fits(VALVE, Identity(0xE5B, 2, 1, 1))


@pytest.mark.parametrize(
    ("expected", "there", "order"),
    [
        ((None, None), (0, 0), (0, 1)),
        ((0, 5, None, 6, None), (0, 5, 0, 6, 0), (0, 1, 2, 3, 4)),
        ((0, 5, None, 6, None), (0, 6, 0, 5, 0), (0, 3, 4, 1, 2)),
        ((5, 6, 7), (7, 5, 6), (2, 0, 1)),
        ((5, 6), (6, 9), (0, 1)),
        ((5, 6), (6, 5, 5), (0, 1)),
        ((5, 5), (5, 5), (0, 1)),
        ((5, 6), (6,), (0, 1)),
        ((None, 6), (6, 3), (0, 1)),
    ],
)
def test_slaves_with_an_alias_are_found_wherever_they_are(expected, there, order):
    slaves = [ExpectedSlave(name="s", vendor=1, product=1, alias=alias) for alias in expected]
    assert arrange(slaves, there) == order
