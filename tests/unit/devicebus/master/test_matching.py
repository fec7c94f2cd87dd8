from __future__ import annotations

import msgspec
import pytest

from devicebus.errors import IdentityError
from devicebus.master.matching import (
    ExpectedSlave,
    check_bus,
    fits,
    iter_differences,
    marks_of,
    match_slaves,
    order_by_marks,
)
from devicebus.master.scan import Identity, scan
from eap.od.slave_config import ALIAS_REGISTER, BY_SERIAL, RevisionRule, SlaveConfig
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


def test_check_bus_accepts_the_expected_slaves():
    check_bus([COUPLER, VALVE, DRIVE], FOUND)
    exact = ExpectedSlave(name="v", vendor=0xE5A, product=2, revision=0x10000, serial=12, alias=5)
    check_bus([COUPLER, exact, DRIVE], FOUND)


def test_check_bus_missing_slave_is_one_difference():
    assert differences(COUPLER, VALVE, DRIVE, found=[FOUND[0], FOUND[2]]) == [
        "the valve is missing after coupler, expected vendor 0x00000E5A, product 0x00000002"
    ]
    (line,) = differences(COUPLER, VALVE, found=FOUND[1:2])
    assert line.startswith("the coupler is missing at the start")


def test_check_bus_additional_slave_is_one_difference():
    (line,) = differences(COUPLER, DRIVE)
    assert line == (
        "slave 1002 (valve): vendor 0x00000E5A, product 0x00000002,"
        " revision 0x00010000, expected no slave here"
    )


def test_check_bus_other_slave_is_a_difference():
    (line,) = differences(COUPLER, DRIVE, DRIVE)
    assert line == (
        "slave 1002 (valve): vendor 0x00000E5A, product 0x00000002, revision 0x00010000,"
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


def test_check_bus_unreadable_slave_has_its_reason():
    broken = FOUND[1]._replace(fault="slave 1002: broken", identity=Identity(0, 0, 0))
    (line,) = differences(COUPLER, VALVE, DRIVE, found=[FOUND[0], broken, FOUND[2]])
    assert line == "slave 1002 (valve): slave 1002: broken, expected the valve"


def test_check_bus_reports_all_differences():
    with pytest.raises(IdentityError) as caught:
        check_bus([VALVE, DRIVE, COUPLER], FOUND)
    assert str(caught.value).startswith(
        "the bus is not as configured (3 slaves expected, 3 found):\n  "
    )
    *lines, advice = str(caught.value).splitlines()
    assert len(lines) == 4
    assert advice == "  connect the slaves as expected, or name those that are there"


def test_check_bus_swapped_slaves_are_one_difference():
    assert differences(DRIVE, VALVE, COUPLER) == [
        "the drive and the coupler are swapped: exchange the cables or the names in the bus file"
    ]
    with pytest.raises(IdentityError) as caught:
        check_bus([DRIVE, VALVE, COUPLER], FOUND)
    assert str(caught.value).splitlines()[1:] == [f"  {differences(DRIVE, VALVE, COUPLER)[0]}"]


def test_check_bus_slaves_that_are_swapped_one_way_are_two_differences():
    assert len(differences(VALVE, msgspec.structs.replace(COUPLER, serial=7), DRIVE)) == 2


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
def test_order_by_marks_finds_slaves_at_any_position(expected, there, order):
    slaves = [ExpectedSlave(name="s", vendor=1, product=1, alias=alias) for alias in expected]
    marks = [{ALIAS_REGISTER: each} for each in there]
    assert order_by_marks(slaves, marks) == order


def bus_of(*products, **marks):
    """Found slaves by their product, with values of registers by position."""
    slaves = [
        FOUND[0]._replace(position=at, station=1001 + at, identity=Identity(1, number, 0x12, 0))
        for at, number in enumerate(products)
    ]
    values = [marks_of(each) for each in slaves]
    for name, (register, value) in marks.items():
        values[int(name[1:])][register] = value
    return slaves, values


def want(product, *, optional=False, group="", alias=None, serial=None, by=ALIAS_REGISTER, **more):
    config = SlaveConfig(optional=optional, group=group, identification=by, **more)
    return ExpectedSlave(
        name=f"s{product}", vendor=1, product=product, alias=alias, serial=serial, config=config
    )


@pytest.mark.parametrize(
    ("expected", "found", "numbers"),
    [
        ("1 2 3", "1 2 3", (0, 1, 2)),
        ("1 2? 3", "1 3", (0, 2)),
        ("1 2? 3", "1 2 3", (0, 1, 2)),
        ("1? 2? 3?", "", ()),
        ("1? 2? 3?", "2", (1,)),
        # Of equal ones the first are present, as far as the others leave them.
        ("1 2? 2? 3", "1 2 3", (0, 1, 3)),
        ("1 2? 2", "1 2", (0, 2)),
        ("1 2 2? 2? 2 3", "1 2 2 2 3", (0, 1, 2, 4, 5)),
        ("2? 1 2? 1 3?", "1 2 1", (1, 2, 3)),
    ],
)
def test_match_slaves_leaves_out_optional_ones_that_are_absent(expected, found, numbers):
    wanted = [want(int(each[0]), optional="?" in each) for each in expected.split()]
    assert match_slaves(wanted, *bus_of(*map(int, found.split()))) == numbers


@pytest.mark.parametrize(
    ("expected", "found", "text"),
    [
        ("1 2? 3", "1 2", "s3 is missing after"),
        ("1 2? 3", "1 4 3", "slave 1002 (coupler): vendor 0x00000001, product 0x00000004"),
        ("1 2? 3", "1 2 2 3", "expected no slave here"),
        ("1 2?", "", "s1 is missing at the start"),
    ],
)
def test_match_slaves_reports_what_no_optional_slave_explains(expected, found, text):
    wanted = [want(int(each[0]), optional="?" in each) for each in expected.split()]
    with pytest.raises(IdentityError) as caught:
        match_slaves(wanted, *bus_of(*map(int, found.split())))
    _, line, _ = str(caught.value).splitlines()
    assert text in line


GROUP = [want(1), want(2, group="tool", alias=5), want(3, group="tool"), want(4)]


@pytest.mark.parametrize(
    ("products", "at", "numbers"),
    [
        ((1, 2, 3, 4), 1, (0, 1, 2, 3)),
        ((1, 4, 2, 3), 2, (0, 3, 1, 2)),
        ((1, 4), None, (0, 3)),
        ((1, 2, 4), 1, (0, 1, 3)),
    ],
)
def test_match_slaves_finds_a_group_anywhere(products, at, numbers):
    marks = {} if at is None else {f"p{at}": (ALIAS_REGISTER, 5)}
    assert match_slaves(GROUP, *bus_of(*products, **marks)) == numbers


def test_match_slaves_tells_equal_groups_by_their_marks():
    wanted = [
        want(1),
        want(2, group="a", alias=5, by=0x134),
        want(2, group="b", alias=6, by=0x134),
        want(2, optional=True, serial=7, by=BY_SERIAL),
    ]
    found, marks = bus_of(1, 2, 2, p1=(0x134, 6))
    found[2] = found[2]._replace(identity=Identity(1, 2, 0x12, 7))
    marks[2][BY_SERIAL] = 7
    assert match_slaves(wanted, found, marks) == (0, 2, 3)


def test_match_slaves_names_a_wrong_identification():
    wanted = [want(1), want(2, alias=5, by=0x134)]
    with pytest.raises(IdentityError, match="identification 6, expected s2 with identification 5"):
        match_slaves(wanted, *bus_of(1, 2, p1=(0x134, 6)))


@pytest.mark.parametrize(
    ("rule", "text"),
    [
        ("exact", ", revision 0x00000013"),
        ("at_least", ", revision 0x00000013 or later"),
        ("same_low", ", a revision that ends in 0013"),
        ("any", ""),
        ("same_high", ""),
    ],
)
def test_revision_that_the_rule_refuses_is_told_with_the_rule(rule, text):
    wanted = ExpectedSlave(
        name="s", vendor=1, product=2, revision=0x13,
        config=SlaveConfig(revision_rule=RevisionRule(rule)),
    )  # fmt: skip
    lines = list(iter_differences([wanted], bus_of(2)[0]))
    expected = (
        "slave 1001 (coupler): vendor 0x00000001, product 0x00000002, revision 0x00000012,"
        f" expected s with vendor 0x00000001, product 0x00000002{text}"
    )
    assert lines == ([expected] if text else [])
