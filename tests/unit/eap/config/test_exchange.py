from __future__ import annotations

import pytest

from eap.config.load import load
from eap.pd.spec import REQUESTER, TriggerSpec

PD = "id: 1, version: 3,"
FRAME = "to: 127.0.9.2}"
TIMEOUT = "timeout_ms: 50, "


def pd(text):
    return PD, f"id: 1, version: 3, {text},"


def frame(text):
    return FRAME, f"to: 127.0.9.2, {text}}}"


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        (
            [("out, port: eap0", "out, port: eap1")],
            "13: station left has no port 'eap1', did you m",
        ),
        ([("frame: out", "frame: uot")], "15: station left has no frame 'uot', did you mean out"),
        ([("[speed, count]", "[sped, count]")], "15: station left has no variable 'sped', did you"),
        ([("[speed, count]", "[]")], "15: PD 'state' has no variables; at least one"),
        (
            [("name: out", "name: o ut"), ("frame: out", "frame: o ut")],
            "13: frame name 'o ut'; a t",
        ),
        (
            [("to: 127.0.9.2", "to: ethernet")],
            "13: destination of frame 'out': 'ethernet' is not a",
        ),
        (
            [("to: 127.0.9.2", "to: multicast")],
            "13: destination of frame 'out': multicast has no u",
        ),
        (
            [("to: 127.0.9.2", "to: rigth/eap0")],
            "13: destination of frame 'out': no port rigth/eap0 ",
        ),
        (
            [pd("cycle_us: 15000")],
            "15: cycle_us 15000 of PD 'state' is no multiple of the device c",
        ),
        (
            [pd("cycle_us: 20000, divider: 2")],
            "15: PD 'state' has a cycle_us and a divider; one of",
        ),
        ([pd("modulo: 1")], "15: 'state' has a modulo but no divider; both or none"),
        ([pd("divider: 2, modulo: 2")], "15: modulo 2 of 'state' never comes up; less than the di"),
        ([frame("modulo: 1")], "13: 'out' has a modulo but no divider; both or none"),
        (
            [pd("cycle_us: 20000, on_change: {}")],
            "15: PD 'state' is sent on change and has a cycle_us; on_change.timeout_ms for sending",
        ),
        (
            [pd("divider: 2, on_change: {}")],
            "15: PD 'state' is sent on change and has a divider; o",
        ),
        ([pd("on_change: true")], "15: on_change is true; a mapping"),
        (
            [pd("on_change: {timeout_ms: -1}")],
            "15: timeout_ms is -1; a whole number of milliseconds from 0 to 4294967295",
        ),
        (
            [pd("on_change: {inhibit_us: 4294967296}")],
            "15: inhibit_us is 4294967296; a whole number of microseconds from 0 to 4294967295",
        ),
        (
            [pd("on_change: {timeout_ms: 1, inhibit_us: 1001}")],
            "15: PD 'state' is to be sent again before changes may be; timeout_ms of at least 2",
        ),
        (
            [frame("divider: 4"), pd("divider: 6")],
            "15: PD 'state' is due every 6 cycles, but frame 'out' leaves only every 4 cycles (lin",
        ),
        (
            [frame("divider: 4"), pd("cycle_us: 60000")],
            "15: PD 'state' is due every 6 cycles, but frame 'out' leaves only every 4 cycles (lin",
        ),
        (
            [frame("divider: 4, modulo: 1"), pd("divider: 8, modulo: 4")],
            "15: PD 'state' is due at 4 of 8 cycles, but frame 'out' leaves only every 4 cycles (l",
        ),
        (
            [frame("divider: 4, modulo: 1"), pd("cycle_us: 80000")],
            "15: PD 'state' is due at 0 of 8 cycles, but frame 'out' leaves only every 4 cycles",
        ),
        (
            [(FRAME, f"{FRAME}\n      - {{name: idle, port: eap0, to: 127.0.9.2}}")],
            "14: frame 'idle' carries no PD; a PD under publish with frame: idle",
        ),
    ],
)
def test_invalid_publish_is_a_finding_of_its_line(findings, edits, finding):
    found = findings(*edits)
    assert found[0].startswith(finding)


@pytest.mark.parametrize(
    "edits",
    [
        [pd("cycle_us: 20000, event: true")],
        [pd("on_change: {}, event: true")],
        [pd("on_change: {timeout_ms: 20, inhibit_us: 20000}")],
        [pd("event: true")],
        [frame("divider: 4, modulo: 1"), pd("divider: 8, modulo: 5")],
        [frame("divider: 4"), pd("cycle_us: 80000")],
        [frame("divider: 4, modulo: 3")],
        [frame("divider: 4, modulo: 3"), pd("on_change: {}")],
    ],
)
def test_triggers_that_go_together_pass(load_plant, edits):
    assert load_plant((TIMEOUT, ""), *edits).plant


def test_pd_ids_are_unique_for_each_publisher(findings, load_plant):
    second = "\n      - {name: more, frame: out, id: 1, variables: [count]}"
    old = "variables: [speed, count]}"
    [finding] = findings((old, old + second))
    assert finding.startswith(
        "16: PD id 1 is used twice by publisher 127.0.9.1.2.1 (first in line 15); an id of its own"
    )
    port = "net_id: 127.0.9.1.2.1}"
    other = '\n      - {name: eap1, kind: eap, interface: "udp://127.0.9.3", net_id: 127.0.9.1.3.1}'
    away = "\n      - {name: away, port: eap1, to: 127.0.9.2}"
    assert load_plant(
        (port, port + other),
        (FRAME, FRAME + away),
        (old, old + second.replace("frame: out", "frame: away")),
    ).plant


BUDGETS = [
    ("udp://127.0.9.1", "udp://127.0.9.2", "127.0.9.2", 1450),
    ("udp://127.0.9.1", "udp://127.0.9.2", "239.1.1.1", 1450),
    ("ethernet://eth0", "ethernet://eth0", "multicast", 1478),
    ("tcp://127.0.9.1", "tcp://127.0.9.2", "right/eap0", 2027),
    ("loop://line", "loop://line", "right/eap0", 2027),
]


@pytest.mark.parametrize(("left", "right", "to", "largest"), BUDGETS)
def test_a_frame_is_as_large_as_its_wire_allows(findings, left, right, to, largest):
    edits = [
        ('"udp://127.0.9.1"', f'"{left}"'),
        ('"udp://127.0.9.2"', f'"{right}"'),
        ("to: 127.0.9.2", f"to: {to}"),
        ("    sources:\n      count: {kind: counter}\n", ""),
        ("[speed, count]", "[count]"),
    ]
    sizes = [("count: UDINT", "count: BLOCK({})"), ("{a: REAL, b: UDINT}", "{{b: BLOCK({})}}")]
    fitting = [(old, new.format(largest)) for old, new in sizes]
    assert findings(*edits, *fitting) == []
    [finding] = findings(*edits, *((old, new.format(largest + 1)) for old, new in sizes))
    total = largest + 23
    assert finding.startswith(
        f"11: frame 'out' has {total} bytes with its 1 PDs; at most {total - 1}"
    )


def test_the_budget_counts_every_pd_of_a_frame(findings):
    old = "variables: [speed, count]}"
    more = "".join(
        f"\n      - {{name: pd{n}, frame: out, id: {n}, variables: [big]}}" for n in (2, 3)
    )
    size = [("count: UDINT", "count: UDINT\n      big: BLOCK(720)"), (old, old + more)]
    [finding] = findings(*size)
    assert finding.startswith("14: frame 'out' has 1486 bytes with its 3 PDs; at most 1472 to 127")


def test_frames_leave_by_eap_ports(findings):
    bus = "{name: bus0, kind: bus, interface: sim://b.yaml, net_id: 127.0.9.1.3.1}"
    found = findings(
        ("net_id: 127.0.9.1.2.1}", f"net_id: 127.0.9.1.2.1}}\n      - {bus}"),
        ("out, port: eap0", "out, port: bus0"),
    )
    assert "14: port bus0 is a bus port; one of eap0" in found


def test_near_names_include_what_is_received(findings):
    old = "timeout_ms: 50, variables: {a: REAL, b: UDINT}}"
    relay = """
    frames: [{name: back, port: eap0, to: left/eap0}]
    publish: [{name: echo, frame: back, id: 1, variables: [seen.speeed]}]"""
    [finding] = findings((old, "timeout_ms: 50}" + relay))
    assert finding.startswith(
        "23: station right has no variable 'seen.speeed', did you mean seen.s"
    )


def test_a_received_variable_may_be_sent_again(load_plant):
    old = "timeout_ms: 50, variables: {a: REAL, b: UDINT}}"
    relay = """
    frames: [{name: back, port: eap0, to: left/eap0}]
    publish: [{name: echo, frame: back, id: 1, variables: [%s]}]"""
    assert load_plant((old, old + relay % "b, a")).plant
    taken_over = load_plant((old, "timeout_ms: 50}" + relay % "seen.count, seen.speed")).plant
    assert taken_over.stations[1].frames[0].pds[0].variables == ("seen.count", "seen.speed")


def test_bus_variable_can_be_published(findings):
    port = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
    bus = "{name: bus0, kind: bus, interface: sim://line.yaml, net_id: 127.0.9.1.3.1}"

    def sent(name, *more):
        return findings((port, f"{port}\n      - {bus}"), ("[speed, count]", name), *more)

    free = ("{a: REAL, b: UDINT}", "{a: BOOL}")
    assert sent("[bus0.valves.limit]", free) == []
    found = sent("[bus0.valves.limits]")
    assert found[0].startswith(
        "16: station left has no variable 'bus0.valves.limits', did you mean bus0.valves.limit?"
    )
    assert sent("[bus0.valves.state, bus0.valves.speed]") == [
        "22: a is REAL, but left/state sends bus0.valves.state as BYTE (line 16); BYTE",
        "22: b is UDINT, but left/state sends bus0.valves.speed as INT (line 16); INT",
    ]
    assert len(sent("[bus0.valves.limit]", ("line.yaml", "broken.yaml"))) == 1


PLANT = """\
plant: polls
stations:
  - name: desk
    net_id: 127.0.9.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 127.0.9.1.2.1}
      - {name: eap1, kind: eap, interface: "udp://127.0.9.5", net_id: 127.0.9.1.3.1}
    variables: {job: UINT}
    frames:
      - {name: ask, port: eap0, to: mill/eap0}
      - {name: other, port: eap1, to: mill/eap0}
    publish:
      - {name: request, frame: ask, id: 70, variables: [job]}
      - {name: news, frame: other, id: 75, variables: [job]}
    subscribe:
      - {name: part, port: eap0, from: mill/part, poll: request, timeout_ms: 50}
  - name: mill
    net_id: 127.0.9.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.9.2", net_id: 127.0.9.2.2.1}
      - {name: eap1, kind: eap, interface: "udp://127.0.9.6", net_id: 127.0.9.2.3.1}
    variables: {turns: UDINT}
    frames:
      - {name: answer, port: eap0, to: requester}
    publish:
      - {name: part, frame: answer, id: 71, poll: asked, variables: [turns]}
    subscribe:
      - {name: asked, port: eap0, from: desk/request}
      - {name: news, port: eap0, from: desk/news}
"""

CLIENT = "from: mill/part, poll: request,"
SERVER = "poll: asked, variables: [turns]}"
ANSWER_FRAME = "port: eap0, to: requester}"
FOREIGN = "from: {publisher: 5.5.5.5.1.1, id: 9}, foreign: true, variables: {t: UDINT},"
ALSO = "\n      - {name: more, frame: answer, id: 72, variables: [turns]}"
CHAIN = (
    # The mill asks the saw with its answer to the desk.
    "\n      - {name: cut, port: eap0, from: saw/cut, poll: part}"
    "\n  - name: saw\n    net_id: 127.0.9.3.1.1\n    ports:"
    '\n      - {name: eap0, kind: eap, interface: "udp://127.0.9.3", net_id: 127.0.9.3.2.1}'
    "\n    variables: {depth: REAL}"
    "\n    frames:\n      - {name: answer, port: eap0, to: requester}"
    "\n    publish:\n      - {name: cut, frame: answer, id: 73, poll: seen, variables: [depth]}"
    "\n    subscribe:\n      - {name: seen, port: eap0, from: mill/part, poll: cut}\n"
)
NEWS = "\n      - {name: news, port: eap0, from: desk/news}\n"
FAR = f"\n      - {{name: far, port: eap0, {FOREIGN}}}\n"


@pytest.fixture
def load_edited(tmp_path):
    def of(*edits):
        text = PLANT
        for old, new in edits:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        path = tmp_path / "plant.yaml"
        path.write_text(text)
        return load(path, lambda _path: ())

    return of


def test_both_ends_of_a_poll_become_specifications(load_edited):
    result = load_edited()
    assert result.findings == ()
    desk, mill = result.plant.stations
    (asks,) = desk.frames[0].pds
    assert (desk.frames[0].destination, asks.poll_request) == ("127.0.9.2", "")
    assert desk.subscriptions[0].poll_request == "request"
    assert (desk.subscriptions[0].step, desk.subscriptions[0].sender_cycle_us) == (0, 10_000)
    (answers,) = mill.frames[0].pds
    assert (mill.frames[0].destination, answers.poll_request) == (REQUESTER, "asked")
    assert answers.trigger == TriggerSpec()
    assert mill.subscriptions[0].poll_request == ""
    assert [port.join for port in desk.ports] == [(), ()]


@pytest.mark.parametrize(
    "edits",
    [
        # Servers outside the plant, and clients.
        [(CLIENT, f"{FOREIGN} poll: request,")],
        [
            ("from: desk/request", FOREIGN.rstrip(",").replace("id: 9", "id: 90")),
            (CLIENT, f"{FOREIGN} poll: request,"),
        ],
        # Whoever sends id 70.
        [("from: desk/request", "from: {publisher: any, id: 70}, variables: {j: UINT}")],
        # A request by event, or on change.
        [("id: 70,", "id: 70, event: true,")],
        [("id: 70,", "id: 70, on_change: {timeout_ms: 100},")],
        # Answers to two requests in one frame.
        [
            (SERVER, f"{SERVER}{ALSO.replace('id: 72,', 'id: 72, poll: news,')}"),
            ("name: news, port: eap0, from: desk/news", "name: news, port: eap0, from: desk/two"),
            (
                "name: news, frame: other, id: 75, variables: [job]}",
                (
                    "name: news, frame: other, id: 75, variables: [job]}\n"
                    "      - {name: two, frame: ask, id: 76, variables: [job]}"
                ),
            ),
        ],
    ],
)
def test_matching_keys_have_no_findings(load_edited, edits):
    assert load_edited(*edits).findings == ()


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        (
            [("to: requester}", "to: 127.0.9.1}")],
            "26: PD 'part' is polled, but frame 'answer' goes to 127.0.9.1 (line 24); a fr",
        ),
        (
            [(SERVER, SERVER + ALSO)],
            "27: PD 'more' goes to the requester (frame 'answer', line 24), but nothing polls it; ",
        ),
        (
            [(ANSWER_FRAME, "port: eap0, to: requester, divider: 2}")],
            "24: frame 'answer' carries answers and has a divider; none: an answer leaves in the",
        ),
        *(
            (
                [("poll: asked,", f"poll: asked, {key}: {value},")],
                f"26: PD 'part' has both poll and {key}; one of the two",
            )
            for key, value in (
                ("cycle_us", 10_000),
                ("divider", 2),
                ("on_change", "{}"),
                ("event", "true"),
            )
        ),
        (
            [("poll: asked,", "poll: aksed,")],
            "26: station mill has no subscription 'aksed', did you mean asked?; one of asked",
        ),
        (
            [(ANSWER_FRAME, "port: eap1, to: requester}")],
            "26: PD 'part' leaves port eap1, but 'asked' arrives at eap0 (line 28); one port for b",
        ),
        (
            [(CLIENT, "from: mill/part, poll: reqest,")],
            "16: station desk publishes no 'reqest', did you mean request?; one of request, news",
        ),
        (
            [(CLIENT, "from: mill/part,")],
            "16: mill/part is sent only on request (line 26); poll: the PD of this station",
        ),
        (
            [(SERVER, "variables: [turns]}"), (ANSWER_FRAME, "port: eap0, to: desk/eap0}")],
            "16: 'part' is polled, but mill/part is sent by itself; no poll here, or poll in",
        ),
        (
            [("poll: asked,", "poll: news,")],
            "16: mill/part does not answer desk/request but mill's 'news' (line 29); one of news",
        ),
        (
            [("poll: asked,", "poll: far,"), (NEWS, FAR)],
            "16: mill/part does not answer desk/request but mill's 'far' (line 29); a PD that is",
        ),
    ],
)  # fmt: skip
def test_conflicting_keys_are_one_finding(load_edited, edits, finding):
    texts = [f"{f.line}: {f.message}; {f.expected}" for f in load_edited(*edits).findings]
    assert len(texts) == 1
    assert texts[0].startswith(finding)


def test_the_ports_of_question_and_answer_are_the_same(load_edited):
    edits = [(CLIENT, f"{FOREIGN} poll: news,")]
    (finding,) = load_edited(*edits).findings
    assert finding.path == "stations[0].subscribe[0].poll"
    assert finding.message == "'part' arrives at port eap0, but 'news' leaves eap1 (line 11)"


def test_poll_answer_cannot_be_a_request(load_edited):
    """Each line that makes a chain is named."""
    anybody = "from: {publisher: any, id: 71}, variables: {t: UDINT}"
    result = load_edited((NEWS, CHAIN.replace("from: mill/part, poll: cut", anybody)))
    messages = [f.message for f in result.findings if f.path.endswith(".poll")]
    assert messages == ["PD 'cut' answers mill/part, which is polled itself (line 26)"]


def test_poll_answer_of_unknown_requester_cannot_be_a_request(load_edited):
    (finding,) = load_edited(
        ("from: desk/request}", f"{FOREIGN} poll: news}}"),
        ("name: news, port: eap0, from: desk/news", "name: new, port: eap0, from: desk/news"),
        (SERVER, f"{SERVER}\n      - {{name: news, frame: out, id: 74, variables: [turns]}}"),
        (ANSWER_FRAME, f"{ANSWER_FRAME}\n      - {{name: out, port: eap0, to: desk/eap0}}"),
        (CLIENT, f"{FOREIGN} poll: request,"),
    ).findings  # fmt: skip
    assert finding.message == "PD 'part' answers 'asked', which is an answer itself (line 30)"


def test_poll_request_cannot_be_an_answer(load_edited):
    more = f"{NEWS}      - {{name: saw, port: eap0, {FOREIGN} poll: part}}\n"
    (finding,) = load_edited((NEWS, more)).findings
    message = "'saw' is requested by 'part', which is polled itself (line 26)"
    assert (finding.line, finding.message) == (30, message)


def test_polls_that_form_a_loop_are_a_finding(load_edited):
    result = load_edited(
        ("from: desk/request", "from: saw/cut, poll: part"),
        (CLIENT, f"{FOREIGN} poll: request,"),
        (NEWS, CHAIN[CHAIN.index("\n  - name: saw") :]),
    )
    loops = [f.message for f in result.findings if "loop" in f.message]
    assert loops == [
        "polls form a loop: mill/part, saw/cut, mill/part",
        "polls form a loop: saw/cut, mill/part, saw/cut",
    ]


def test_reported_error_has_no_further_findings(load_edited):
    result = load_edited(("{name: asked, port: eap0,", "{name: asked, port: eap0, nonsense: 1, "))
    assert [f.message for f in result.findings] == ["unknown key 'nonsense'"]
    broken = load_edited(("from: desk/request}", "from: [1]}"))
    assert [f.path for f in broken.findings] == ["stations[1].subscribe[0].from"]
    broken = load_edited(
        ("{name: request, frame: ask, id: 70", "{name: request, frame: ask, id: x")
    )
    assert len(broken.findings) == 1


FROM = "from: left/state"
VARIABLES = ", variables: {a: REAL, b: UDINT}}"


@pytest.mark.parametrize(
    ("edits", "finding"),
    [
        ([("seen, port: eap0", "seen, port: eap9")], "21: station right has no port 'eap9'"),
        (
            [(FROM, "from: left/sate")],
            "21: no station of this plant publishes 'left/sate', did you mean",
        ),
        (
            [(FROM, "from: {publisher: 9.9.9.9.9.9, id: 7}")],
            "21: no station of this plant publishes id",
        ),
        (
            [(FROM, "from: {publisher: any, id: 7}")],
            "21: no station of this plant publishes id 7 as any",
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
def test_subscription_without_sender_is_a_finding(findings, edits, finding):
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


def test_error_of_publisher_is_reported_once(findings):
    assert len(findings(("to: 127.0.9.2", "to: nowhere"))) == 1
    assert len(findings(("frame: out", "frame: uot"))) == 1
    assert len(findings(("count: UDINT", "count: UDIMT"))) == 1
    assert len(findings(("from: left/state", "from: left/state, foreign: [1]"))) == 1
