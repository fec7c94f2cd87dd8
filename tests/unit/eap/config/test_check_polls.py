from __future__ import annotations

import pytest

from eap.config.load import load
from eap.pd.spec import REQUESTER, TriggerSpec

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
FRAME = "port: eap0, to: requester}"
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
def test_what_goes_together_is_well(load_edited, edits):
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
            "27: PD 'more' goes to who asks for it (frame 'answer', line 24), but nothing does; ",
        ),
        (
            [(FRAME, "port: eap0, to: requester, divider: 2}")],
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
            [(FRAME, "port: eap1, to: requester}")],
            "26: PD 'part' leaves port eap1, but 'asked' arrives at eap0 (line 28); one port for b",
        ),
        (
            [(CLIENT, "from: mill/part, poll: reqest,")],
            "16: station desk publishes no 'reqest', did you mean request?; one of request, news",
        ),
        (
            [(CLIENT, "from: mill/part,")],
            "16: mill/part is sent only to who asks for it (line 26); poll: the PD of this station",
        ),
        (
            [(SERVER, "variables: [turns]}"), (FRAME, "port: eap0, to: desk/eap0}")],
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
def test_what_does_not_go_together_is_one_finding(load_edited, edits, finding):
    texts = [f"{f.line}: {f.message}; {f.expected}" for f in load_edited(*edits).findings]
    assert len(texts) == 1
    assert texts[0].startswith(finding)


def test_the_ports_of_question_and_answer_are_the_same(load_edited):
    edits = [(CLIENT, f"{FOREIGN} poll: news,")]
    (finding,) = load_edited(*edits).findings
    assert finding.path == "stations[0].subscribe[0].poll"
    assert finding.message == "'part' arrives at port eap0, but 'news' leaves eap1 (line 11)"


def test_an_answer_is_no_request(load_edited):
    """Each line that makes a chain is named."""
    anybody = "from: {publisher: any, id: 71}, variables: {t: UDINT}"
    result = load_edited((NEWS, CHAIN.replace("from: mill/part, poll: cut", anybody)))
    messages = [f.message for f in result.findings if f.path.endswith(".poll")]
    assert messages == ["PD 'cut' answers mill/part, which is polled itself (line 26)"]


def test_an_answer_is_no_request_although_nobody_knows_who_asked(load_edited):
    (finding,) = load_edited(
        ("from: desk/request}", f"{FOREIGN} poll: news}}"),
        ("name: news, port: eap0, from: desk/news", "name: new, port: eap0, from: desk/news"),
        (SERVER, f"{SERVER}\n      - {{name: news, frame: out, id: 74, variables: [turns]}}"),
        (FRAME, f"{FRAME}\n      - {{name: out, port: eap0, to: desk/eap0}}"),
        (CLIENT, f"{FOREIGN} poll: request,"),
    ).findings  # fmt: skip
    assert finding.message == "PD 'part' answers 'asked', which is an answer itself (line 30)"


def test_a_question_is_no_answer(load_edited):
    more = f"{NEWS}      - {{name: saw, port: eap0, {FOREIGN} poll: part}}\n"
    (finding,) = load_edited((NEWS, more)).findings
    message = "'saw' is asked for by 'part', which is polled itself (line 26)"
    assert (finding.line, finding.message) == (30, message)


def test_polls_do_not_go_in_a_circle(load_edited):
    result = load_edited(
        ("from: desk/request", "from: saw/cut, poll: part"),
        (CLIENT, f"{FOREIGN} poll: request,"),
        (NEWS, CHAIN[CHAIN.index("\n  - name: saw") :]),
    )
    circles = [f.message for f in result.findings if "circle" in f.message]
    assert circles == [
        "polls go in a circle: mill/part, saw/cut, mill/part",
        "polls go in a circle: saw/cut, mill/part, saw/cut",
    ]


def test_what_was_reported_already_is_not_blamed_again(load_edited):
    result = load_edited(("{name: asked, port: eap0,", "{name: asked, port: eap0, nonsense: 1, "))
    assert [f.message for f in result.findings] == ["unknown key 'nonsense'"]
    broken = load_edited(("from: desk/request}", "from: [1]}"))
    assert [f.path for f in broken.findings] == ["stations[1].subscribe[0].from"]
    broken = load_edited(
        ("{name: request, frame: ask, id: 70", "{name: request, frame: ask, id: x")
    )
    assert len(broken.findings) == 1
