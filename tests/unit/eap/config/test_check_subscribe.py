from __future__ import annotations

import pytest

FROM = "from: left/state"
VARIABLES = ", variables: {a: REAL, b: UDINT}}"


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        ([("seen, port: eap0", "seen, port: eap9")], "21: station right has no port 'eap9'"),
        (
            [(FROM, "from: left/sate")],
            "21: nobody in this plant publishes 'left/sate', did you mean",
        ),
        (
            [(FROM, "from: {publisher: 9.9.9.9.9.9, id: 7}")],
            "21: nobody in this plant publishes id",
        ),
        (
            [(FROM, "from: {publisher: any, id: 7}")],
            "21: nobody in this plant publishes id 7 as any",
        ),
        ([(FROM, "from: {publisher: x, id: 7}, foreign: true")], "21: 'x' is not an AMS NetID"),
        (
            [(FROM, "from: else/state, foreign: true")],
            "21: else/state is foreign; publisher and id",
        ),
        (
            [(FROM, f"{FROM}, foreign: true")],
            "21: 'seen' is foreign, but this plant publishes it a",
        ),
        (
            [(FROM, "from: {publisher: 127.0.9.1.2.1, id: 1, step: 1}")],
            "21: left/state is in this plant, which gives cycle_us and step; both to be left out",
        ),
        (
            [(FROM, f"{FROM}, source: somewhere")],
            "21: source of 'seen' is 'somewhere' on udp://127.0.9.2; an IPv4 address or any",
        ),
        (
            [(FROM, f'{FROM}, source: "02:00:00:00:00:01"')],
            "21: source of 'seen' is '02:00:00:00:00:01' on udp://127.0.9.2; an IPv4 address",
        ),
        (
            [(FROM, f"{FROM}, source: 239.1.2.3")],
            "21: source of 'seen' is '239.1.2.3' on udp://127.0.9.2; an IPv4 address or any",
        ),
        (
            [(FROM, f"{FROM}, version: 2")],
            "21: version 2 of 'seen', but left/state has 3 (line 15)",
        ),
        ([("b: UDINT}", "b: UINT}")], "21: b is UINT, but left/state sends count as UDINT (line 1"),
        (
            [(", b: UDINT", "")],
            "21: 'seen' has 1 variables, but left/state has 2 (line 15); REAL, ",
        ),
        ([("{a: REAL, b: UDINT}", "{}")], "21: subscription 'seen' has no variables; at least one"),
        (
            [(FROM, "from: {publisher: 127.0.9.1.2.1, id: 1}"), (VARIABLES, "}")],
            "21: subscription 'seen' has no variables; its variables",
        ),
        (
            [("timeout_ms: 50", "timeout_ms: 9")],
            "21: timeout_ms 9 of 'seen' is shorter than the de",
        ),
        (
            [("id: 1, version: 3,", "id: 1, version: 3, cycle_us: 60000,")],
            "21: timeout_ms 50 of 'seen' is shorter than the 60000 us between two of left/state; a",
        ),
        (
            [("to: 127.0.9.2", "to: 127.0.9.3")],
            "21: left/state goes to 127.0.9.3 (line 13), which does not reach right/eap0 (udp://12",
        ),
    ],
)
def test_what_would_receive_nothing_is_a_finding(findings, edits, finding):
    found = findings(*edits)
    assert len(found) == 1
    assert found[0].startswith(finding)


@pytest.mark.parametrize(
    "source",
    [
        "from: {publisher: 127.0.9.1.2.1, id: 1}",
        "from: {publisher: any, id: 1}",
        "from: {publisher: 9.9.9.9.9.9, id: 7}, foreign: true",
        "from: {publisher: any, id: 7, cycle_us: 1000, step: 2}, foreign: true",
        f"{FROM}, version: 3",
        f"{FROM}, version: 2, ignore_version: true",
    ],
)
def test_these_have_a_publisher_or_say_that_it_is_foreign(load_plant, source):
    assert load_plant((FROM, source)).plant


def test_a_pd_is_received_once_on_a_port(findings):
    second = (
        "\n      - {name: again, port: eap0, from: {publisher: 127.0.9.1.2.1, id: 1}, variables: "
    )
    found = findings((VARIABLES, f"{VARIABLES}{second}{{c: REAL, d: UDINT}}}}"))
    assert found == [
        (
            "22: id 1 of 127.0.9.1.2.1 is received twice on port eap0 (first in line 21); one "
            "subscription for each PD on a port"
        )
    ]


def test_names_of_subscriptions_are_unique(findings):
    second = "\n      - {name: seen, port: eap0, foreign: true, from: {publisher: any, id: 9}, "
    found = findings((VARIABLES, f"{VARIABLES}{second}variables: {{c: REAL}}}}"))
    assert found == ["22: subscription 'seen' exists already (line 21); a name of its own"]


def test_an_error_of_the_publisher_is_told_once(findings):
    assert len(findings(("to: 127.0.9.2", "to: nowhere"))) == 1
    assert len(findings(("frame: out", "frame: uot"))) == 1
    assert len(findings(("count: UDINT", "count: UDIMT"))) == 1
    assert len(findings(("from: left/state", "from: left/state, foreign: [1]"))) == 1
