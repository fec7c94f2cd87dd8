from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.mqtt.messages import TopicKind, Topics, check_network
from eap.ids import NetId

OWN, OTHER = NetId.parse("5.1.1.1.1.1"), NetId.parse("6.1.1.1.1.1")
TOPICS = Topics("hall/line-1", OWN)


def test_topics_are_those_of_the_documentation() -> None:
    assert TOPICS.info == "hall/line-1/5.1.1.1.1.1/info"
    assert TOPICS.filters == ("hall/line-1/5.1.1.1.1.1/ams/#", "hall/line-1/+/info")
    assert TOPICS.of("6.1.1.1.1.1", TopicKind.REQUESTS) == "hall/line-1/6.1.1.1.1.1/ams"
    assert TOPICS.of("6.1.1.1.1.1", TopicKind.ANSWERS) == "hall/line-1/6.1.1.1.1.1/ams/res"


@pytest.mark.parametrize("kind", TopicKind)
def test_topic_is_read_as_it_was_written(kind: TopicKind) -> None:
    assert TOPICS.parse(TOPICS.of(str(OTHER), kind)) == (OTHER, kind)


@pytest.mark.parametrize(
    "topic",
    [
        "hall/line-2/5.1.1.1.1.1/info",
        "hall/line-1",
        "hall/line-1/5.1.1.1.1/info",
        "hall/line-1/05.1.1.1.1.1/info",
        "hall/line-1/5.1.1.1.1.1",
        "hall/line-1/5.1.1.1.1.1/",
        "hall/line-1/5.1.1.1.1.1/ams/res/x",
        "hall/line-1/5.1.1.1.1.1/INFO",
        "hall/line-1/5.1.1.1.1.999/info",
    ],
)
def test_other_topics_mean_nothing(topic: str) -> None:
    assert TOPICS.parse(topic) is None


@given(st.text())
def test_no_topic_raises(text: str) -> None:
    TOPICS.parse(text)
    TOPICS.parse(f"hall/line-1/{text}")


@pytest.mark.parametrize(
    "name", ["", "a+b", "a#", "$SYS", "/a", "a/", "a\0", "a\n", "x" * 129], ids=repr
)
def test_name_that_no_network_can_have_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="is no name of a network"):
        check_network(name)
    with pytest.raises(ValueError, match="is no name of a network"):
        Topics(name, OWN)
