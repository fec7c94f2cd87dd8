from __future__ import annotations

import pytest

from devicebus.errors import AlStatusError, BusError, FrameLostError
from devicebus.master.diagnosis import BusDiagnosis, Fault, PortErrors, SlaveDiagnosis
from devicebus.master.findings import (
    FaultPeriod,
    History,
    MailboxTimeouts,
    SlaveView,
    find_causes,
    find_silence,
    join_errors,
)

SECOND = 1_000_000_000
NAMES = {1001: "a", 1002: "b", 1003: "c", 1004: "d"}


def line(silent=(), **troubles):
    """The slaves of NAMES, of which *silent* do not answer."""
    return [
        SlaveView(at, name, at not in silent, troubles.get(name, "")) for at, name in NAMES.items()
    ]


def diagnosis(*faults):
    """Registers of the slaves of NAMES with a lost link at each of *faults*."""
    slaves = [
        SlaveDiagnosis(
            at,
            answers=True,
            ports=tuple(
                PortErrors(fault.port, True, 0, 0, 0, 1) for fault in faults if fault.station == at
            ),
        )
        for at in NAMES
    ]
    return BusDiagnosis(tuple(slaves), faults)


def whats(*arguments):
    return [each.what for each in find_causes(*arguments)]


def test_sound_bus_has_no_findings():
    assert find_causes(line()) == find_causes(line(), diagnosis(), History()) == []


@pytest.mark.parametrize(
    ("silent", "expected"),
    [
        ([1001], "a (1001) does not answer; b (1002) behind answers"),
        (
            [1003, 1004],
            (
                "c (1003) and 1 slave behind it do not answer; the last that answers before it is"
                " b (1002)"
            ),
        ),
        (
            [1002],
            (
                "b (1002) does not answer; the last that answers before it is a (1001);"
                " c (1003) behind answers"
            ),
        ),
        ([*NAMES], "none of the 4 slaves answers, although frames come back"),
    ],
)
def test_findings_silent_slaves_are_one_with_the_answering_neighbours(silent, expected):
    assert whats(line(silent)) == [expected]


def test_silent_bus_blames_no_slave():
    finding = find_silence(line(), 5)
    assert finding.what == "no frame comes back: 4 slaves cannot be reached"
    assert (finding.slaves, finding.since_ns) == (tuple(NAMES), 5)
    assert find_silence([]).what == "no frame comes back"


def test_lost_link_before_a_silent_slave_is_the_same_finding():
    (finding,) = find_causes(line([1003, 1004]), diagnosis(Fault(1002, 1, None)))
    assert finding.what.endswith(
        "the last that answers before it is b (1002), whose port 1 has lost its link"
    )
    assert (finding.port, finding.advice) == (1, "check the cable to c (1003) and its power")


def test_findings_slaves_with_one_fault_are_one():
    trouble = "in SAFEOP+ERROR: watchdog"
    assert whats(line(b=trouble, c=trouble)) == [f"b (1002), c (1003): {trouble}"]
    assert whats(line(b="it refuses OP")) == ["b (1002) refuses OP"]
    assert whats(line(b="slave 1002: refuses OP")) == ["b (1002): refuses OP"]
    assert whats(line(b="it refuses OP", c="it refuses OP")) == ["b (1002), c (1003): refuses OP"]
    everyone = line(a=trouble, b=trouble, c=trouble, d=trouble)
    assert whats(everyone) == [f"4 slaves from a (1001) to d (1004): {trouble}"]


def test_errors_that_are_still_counted_are_present():
    (finding,) = find_causes(
        line(),
        diagnosis(Fault(1002, 0, 1001)),
        History(ports={(1002, 0): FaultPeriod(9 * SECOND, SECOND)}),
    )
    assert finding.what == "errors start at port 0 of b (1002): 1 lost link"
    assert (finding.is_over, finding.since_ns, finding.until_ns) == (False, 9 * SECOND, None)


def test_errors_that_are_counted_no_longer_are_over():
    history = History(ports={(1002, 0): FaultPeriod(20 * SECOND, 12 * SECOND)})
    (finding,) = find_causes(line(), diagnosis(Fault(1002, 0, 1001)), history)
    assert finding.what == "errors started at port 0 of b (1002): 1 lost link"
    assert (finding.is_over, finding.until_ns) == (True, 12 * SECOND)


def test_findings_new_errors_behind_a_port_with_old_ones():
    history = History(
        ports={
            (1001, 1): FaultPeriod(20 * SECOND, 12 * SECOND),
            (1003, 0): FaultPeriod(SECOND, SECOND),
        }
    )
    found = find_causes(line(), diagnosis(Fault(1001, 1, 1002), Fault(1003, 0, 1002)), history)
    assert [(each.slaves, each.is_over) for each in found] == [((1003,), False), ((1001,), True)]


def test_findings_both_ends_of_a_cable_are_one():
    history = History(
        ports={
            (1002, 1): FaultPeriod(37 * SECOND, 37 * SECOND),
            (1003, 0): FaultPeriod(24 * SECOND, 24 * SECOND),
        }
    )
    (finding,) = find_causes(line(), diagnosis(Fault(1002, 1, 1003), Fault(1003, 0, 1002)), history)
    assert (finding.slaves, finding.port, finding.is_over) == ((1002,), 1, True)


def test_findings_errors_before_the_first_poll_have_no_time():
    (finding,) = find_causes(line(), diagnosis(Fault(1002, 0, 1001)), History())
    assert (finding.is_over, finding.until_ns) == (True, None)


def test_findings_mended_cut_is_one_for_slaves_and_cable():
    times = FaultPeriod(30 * SECOND, 12 * SECOND)
    over = [(SlaveView(at, NAMES[at], trouble="it does not answer"), times) for at in (1003, 1004)]
    ports = {
        (1002, 1): FaultPeriod(30 * SECOND, 30 * SECOND),
        (1003, 0): FaultPeriod(12 * SECOND, 12 * SECOND),
    }
    (finding,) = find_causes(
        line(),
        diagnosis(Fault(1002, 1, 1003), Fault(1003, 0, 1002)),
        History(tuple(over), ports=ports),
    )
    assert finding.what == (
        "c (1003), d (1004) did not answer; errors started at port 1 of b (1002): 1 lost link"
    )
    assert (finding.is_over, finding.since_ns, finding.until_ns) == (True, *times)


def test_slaves_that_were_missed_while_no_frame_came_back_are_no_finding_of_their_own():
    silence = FaultPeriod(30 * SECOND, 12 * SECOND)
    over = (
        (SlaveView(1001, "a", trouble="it does not answer"), FaultPeriod(30 * SECOND, 12 * SECOND)),
        (SlaveView(1002, "b", trouble="watchdog"), FaultPeriod(12 * SECOND, 11 * SECOND)),
    )
    (finding,) = find_causes(line(), diagnosis(), History(over, silence))
    assert finding.what == "no frame came back, so that 4 slaves could not be reached"
    assert (finding.is_over, finding.until_ns) == (True, 12 * SECOND)


def test_join_errors_single_error_is_unchanged():
    error = AlStatusError("slave 1002: refuses OP", code=1, state=4)
    assert join_errors([("b (1002)", error)]) is error


def test_join_errors_lost_frames_are_one_error():
    errors = [(f"s{n} ({n})", FrameLostError(f"FPRD 0x{n:04X}: no frame")) for n in range(1, 33)]
    error = join_errors(errors)
    assert isinstance(error, FrameLostError)
    assert str(error).startswith("frames to 32 slaves from s1 (1) to s32 (32) did not come back")


def test_join_errors_has_a_line_for_each_cause():
    errors = [
        ("a (1001)", BusError("slave 1001: AL status: working counter 0, expected 1")),
        ("b (1002)", BusError("slave 1002: AL status: working counter 0, expected 1")),
        ("c (1003)", BusError("slave 1003 (c) does not answer")),
    ]
    assert str(join_errors(errors)).splitlines() == [
        "3 slaves have failed:",
        "  a (1001), b (1002): AL status: working counter 0, expected 1",
        "  c (1003): does not answer",
    ]


ALL_MISSED = "4 slaves from a (1001) to d (1004): 8 mailbox requests without reply in time"


def missed(*, number: int = 1, late: int = 0, ago_s: int = 20, count: int = 1) -> History:
    """Mailbox requests without a reply of the first slaves."""
    slaves = [SlaveView(at, name) for at, name in NAMES.items()][:count]
    each = [MailboxTimeouts(slave, number, late, ago_s * SECOND) for slave in slaves]
    return History(mailboxes=tuple(each))


@pytest.mark.parametrize(
    ("history", "what", "is_over"),
    [
        (missed(), "a (1001): 1 mailbox request without reply in time, last 20 s ago", False),
        (
            missed(number=3, late=2),
            "a (1001): 3 mailbox requests without reply in time, 2 late replies, last 20 s ago",
            False,
        ),
        (missed(ago_s=61), "a (1001): 1 mailbox request without reply in time", True),
        (missed(number=2, count=4), f"{ALL_MISSED}, last 20 s ago", False),
    ],
)
def test_mailbox_timeouts_are_a_finding_that_becomes_past(
    history: History, what: str, is_over: bool
) -> None:
    (finding,) = find_causes(line(), None, history)
    assert (finding.what, finding.is_over, finding.since_ns) == (what, is_over, None)
    assert finding.until_ns == history.mailboxes[0].last_ns
