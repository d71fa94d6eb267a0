"""Test the decoder for glove-style framing, and the polling of a board on a real pty."""

import itertools
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfinger.daemon.simulation.emulator.tactile_board import encode_glove, encoder_for
from softfinger.daemon.tactile.glove import GloveDecoder, bits_of
from tests.conftest import until
from tests.harness.tactile import Rig


def counts(seed: int, rows: int = 3, cols: int = 4):
    return np.random.default_rng(seed).integers(0, 1024, (rows, cols)).astype(np.uint16)


def test_a_frame_consists_of_index_value_halves_and_newline():
    data = encode_glove(np.array([[0, 31], [32, 1023]], np.uint16), 2)
    assert data == bytes([13, 11, 11, 11, 42, 12, 11, 42, 42, 10])
    decoded = GloveDecoder(2, 2).feed(data, 3.0)
    assert decoded.t == 3.0
    assert decoded.data.tolist() == [[0, 31], [32, 1023]]
    assert encode_glove(np.full((1, 1), 60000, np.uint16)) == bytes([11, 42, 42, 10])


@pytest.mark.parametrize("full_count", [1023, 4095])
def test_a_board_sends_all_its_bits(full_count):
    sent = np.array([[0, 63, 64], [1022, full_count - 1, full_count]], np.uint16)
    data = encoder_for("glove", full_count).encode(sent, 3, 0.0)
    decoder = GloveDecoder(2, 3, bits_of(full_count))
    assert decoder.feed(data, 1.0).data.tolist() == sent.tolist()
    if full_count == 4095:
        plain = GloveDecoder(2, 3, bits_of(65535))  # This profile lacks full_count.
        assert plain.feed(data, 1.0) is None
        assert "full_count = 4095" in plain.diagnosis()


def test_trailing_bytes_after_a_frame_are_reported():
    decoder = GloveDecoder(3, 4)
    first, second, third = (encode_glove(counts(k), k) for k in range(3))
    assert decoder.feed(first + second + third[:7], 1.0).behind == 7
    assert decoder.feed(third[7:], 2.0).behind == 0


def test_the_default_board_has_2050_bytes_per_frame():
    assert GloveDecoder().frame_bytes == len(encode_glove(counts(1, 32, 32))) == 2050


@given(
    seeds=st.lists(st.integers(0, 99), min_size=1, max_size=5),
    start=st.integers(0, 25),
    cuts=st.lists(st.integers(0, 130), max_size=8),
)
def test_frames_do_not_depend_on_how_the_stream_is_split(seeds, start, cuts):
    stream = b"".join(encode_glove(counts(seed), k) for k, seed in enumerate(seeds))[start:]
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    whole, pieces = GloveDecoder(3, 4), GloveDecoder(3, 4)
    last = whole.feed(stream, 0.0)
    found = [
        decoded
        for left, right in itertools.pairwise(edges)
        if (decoded := pieces.feed(stream[left:right], 0.0)) is not None
    ]
    assert pieces.counters() == whole.counters()
    if last is None:
        assert not found
    else:
        assert np.array_equal(found[-1].data, last.data)
        assert np.array_equal(last.data, counts(seeds[-1]))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda data: data[:7] + data[8:], "lines of 24 bytes"),
        (lambda data: data[:7] + b"\x05" + data[8:], "not a valid half of a count"),
        (lambda data: data[:7] + b"\x2b" + data[8:], "not a valid half of a count"),
        (lambda data: b"\x03" + data[1:], "not a valid half of a count"),
    ],
)
def test_a_corrupted_frame_is_dropped_and_reported(spoil, told):
    decoder = GloveDecoder(3, 4)
    good = encode_glove(counts(5))
    assert decoder.feed(good, 0.0) is not None
    assert decoder.feed(spoil(good), 0.0) is None
    assert told in decoder.diagnosis()
    assert decoder.counters()["resyncs"] == 1
    assert decoder.feed(good, 0.0) is not None


def test_each_frame_is_requested_and_requested_again_after_a_lost_reply(tmp_path):
    with Rig("glove", tmp_path, fault="torn=0.5") as rig:
        rig.sensor.open()
        first = rig.sensor.latest().seq
        until(lambda: rig.sensor.latest().seq >= first + 5)
        counters = rig.sensor.counters()
        # The board sends data only on request.
        assert rig.board.sent <= counters["frames"] + counters["resyncs"] + 3
        assert rig.board.dropped == 0


def test_a_frame_whose_bytes_another_process_has_read_is_requested_again(tmp_path, monkeypatch):
    with Rig("glove", tmp_path) as rig:
        rig.sensor.open()
        port, read, taken = rig.sensor._port.fileno(), os.read, []

        def take(file, size):
            data = read(file, size)
            if file == port and not taken:
                taken.append(data)
                raise BlockingIOError
            return data

        monkeypatch.setattr(os, "read", take)
        until(lambda: taken)
        first = rig.sensor.latest().seq
        until(lambda: rig.sensor.latest().seq >= first + 5)
