"""Test that messages match the schema byte for byte, and that the schema page is up to date."""

import dataclasses
import json
import math
from pathlib import Path

import msgpack
import pytest

from softfinger.daemon.client.stream import read
from softfinger.daemon.types import SceneParts, State
from softfinger.daemon.wire import schema, schema_docs
from softfinger.daemon.wire.publisher import packer
from tests.harness.golden_wire import arguments, flat, golden_file, message_maker, sample

PAGE = Path(schema.__file__).with_name("STREAM.md")
KINDS = {"int": int, "float": float, "bool": bool, "str": str, "bin": bytes}


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_sent_messages_match_the_schema(topic):
    sent = flat(sample(topic))
    assert list(sent) == [field.name for field in schema.TOPICS[topic].fields]
    for field in schema.TOPICS[topic].fields:
        assert type(sent[field.name]) is KINDS[field.kind], field.name
        assert field.meaning


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_messages_equal_golden_bytes(topic):
    """Existing analysis tools require that no byte of the messages changes."""
    golden = golden_file(topic).read_bytes()
    assert packer(topic)(*arguments(topic)) == golden
    assert msgpack.unpackb(golden) == sample(topic)


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_a_client_reads_sent_messages(topic):
    sent = sample(topic)
    assert dataclasses.asdict(read(schema.TOPICS[topic].record, sent)) == sent


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_the_json_schema_names_every_field(topic):
    told = schema_docs.json_schema(topic)
    assert json.loads(json.dumps(told)) == told
    assert told["type"] == "object"
    for name in flat(sample(topic)):
        place = told
        for part in name.split("."):
            place = place["properties"][part]
        assert place["description"]


def test_non_finite_numbers_are_sent_unchanged():
    state = State()  # Before the first reading, the time is −∞ and the grip goals are NaN.
    assert message_maker(schema.INPUT)(state, (None, None))["reading"]["t"] == -math.inf
    sent = message_maker(schema.STATE)(state, SceneParts((True, True), True, True))
    assert math.isnan(sent["goal_force"])


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_integers_use_the_shortest_form(topic):
    assert packer(topic)(*arguments(topic)) == msgpack.packb(sample(topic), use_bin_type=True)


def test_the_schema_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == schema_docs.page(), (
        "run python -m softfinger.daemon.wire.schema_docs"
    )
