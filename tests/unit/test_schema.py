"""The stream's schema: what is sent is what it says, to the byte; its page is what it writes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import msgpack
import pytest

from softfinger.daemon.client.records import read
from softfinger.daemon.wire import schema, schema_docs
from softfinger.daemon.wire.packer import packer
from tests.harness.golden_wire import (
    arguments,
    flat,
    golden_file,
    sample,
)

PAGE = Path(schema.__file__).with_name("STREAM.md")
KINDS = {"int": int, "float": float, "bool": bool, "str": str, "bin": bytes}


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_what_is_sent_is_what_the_schema_says(topic: bytes) -> None:
    sent = flat(sample(topic))
    assert list(sent) == [field.name for field in schema.TOPICS[topic].fields]
    for field in schema.TOPICS[topic].fields:
        assert type(sent[field.name]) is KINDS[field.kind], field.name
        assert field.meaning


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_golden_bytes(topic: bytes) -> None:
    """What an analysis tool was written against must go on arriving, to the byte."""
    golden = golden_file(topic).read_bytes()
    assert packer(topic)(*arguments(topic)) == golden
    assert msgpack.unpackb(golden) == sample(topic)


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_a_client_reads_what_was_sent(topic: bytes) -> None:
    sent = sample(topic)
    assert dataclasses.asdict(read(schema.TOPICS[topic].record, sent)) == sent


@pytest.mark.parametrize("topic", schema.TOPICS)
def test_the_json_schema_names_every_field(topic: bytes) -> None:
    told = schema_docs.json_schema(topic)
    assert json.loads(json.dumps(told)) == told
    assert told["type"] == "object"
    for name in flat(sample(topic)):
        place = told
        for part in name.split("."):
            place = place["properties"][part]
        assert place["description"]


def test_the_page_is_the_one_in_the_repository() -> None:
    assert PAGE.read_text(encoding="utf-8") == schema_docs.page(), (
        "run python -m softfinger.daemon.wire.schema_docs"
    )
