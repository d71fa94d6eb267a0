"""Test FlexiTac framing at the byte level."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from softfinger.daemon.tactile.flexitac import MARKER, FlexiTacDecoder

ROWS, COLS = 4, 5
CELLS = ROWS * COLS
STRIDE = CELLS + 2

payloads = st.binary(min_size=CELLS, max_size=CELLS)
# Images that often contain the marker, or bytes that form a marker with an adjacent byte.
nasty = st.lists(
    st.sampled_from([b"\xaa", b"\x55", b"\xaa\x55", b"\x00", b"\x01"]), min_size=CELLS
).map(lambda parts: b"".join(parts)[:CELLS])


def decode(decoder: FlexiTacDecoder, pieces: list[bytes]) -> list[bytes]:
    """Feed the data byte by byte; return the decoded frames.

    A decoder that synchronises late may complete several frames at once. Such a decoder returns
    only the newest frame.
    """
    found = []
    for piece in pieces:
        for k in range(len(piece)):
            decoded = decoder.feed(piece[k : k + 1], 0.0)
            if decoded is not None:
                assert decoded.data.shape == (decoder.rows, decoder.cols)
                assert decoded.data.dtype == np.uint16
                found.append(decoded.data.astype(np.uint8).tobytes())
    return found


def frame(payload: bytes) -> bytes:
    return MARKER + payload


def numbered(count: int, cells: int = CELLS, first: int = 0) -> list[bytes]:
    """Return different images that contain no marker bytes."""
    return [bytes([(first + k) % 100]) * cells for k in range(count)]


def balance(decoder: FlexiTacDecoder, fed: int) -> None:
    """Check that every byte belongs to a frame, is counted as skipped, or is still buffered."""
    counters = decoder.counters()
    held = len(decoder._buffer)
    assert counters["frames"] * decoder.frame_bytes + counters["skipped_bytes"] + held == fed


def test_a_clean_stream_gives_every_frame_once_the_next_marker_confirms_it():
    images = numbered(5)
    decoder = FlexiTacDecoder(ROWS, COLS)
    assert decode(decoder, [frame(image) for image in images]) == images[:4]
    assert decoder.pending
    last = decoder.settle()
    assert last.data.astype(np.uint8).tobytes() == images[4]
    assert decoder.settle() is None
    assert decoder.counters() == {
        "frames": 5,
        "resyncs": 0,
        "skipped_bytes": 0,
        "ambiguous": 0,
    }


def test_with_gaps_a_frame_is_delivered_at_once_unless_it_may_be_spliced():
    decoder = FlexiTacDecoder(ROWS, COLS, byte_time=1e-4)
    images = numbered(9)
    spare = bytearray(numbered(1)[0])
    spare[3:5] = MARKER
    decoder.feed(frame(images[0]) + frame(images[1]), 0.0)
    assert decoder.settle() is not None
    for k in range(2, 5):
        decoded = decoder.feed(frame(images[k]), 0.01 * k)
        assert decoded.data[0, 0] == k
        assert decoded.t == 0.01 * k
    # The two pieces of the first frame arrive within the frame time. The two pieces of the second
    # frame arrive with a gap between them.
    assert decoder.feed(frame(images[5])[:7], 0.05) is None
    assert decoder.feed(frame(images[5])[7:], 0.052) is not None
    assert decoder.feed(frame(images[6])[:7], 0.06) is None
    assert decoder.feed(frame(images[6])[7:], 0.07) is None
    assert decoder.settle() is not None
    # If an image contains the marker, the decoder waits for the next frame.
    assert decoder.feed(frame(bytes(spare)), 0.08) is None
    assert decoder.settle() is None
    decoded = decoder.feed(frame(images[7]), 0.09)
    assert decoded.data[0, 0] == 7
    assert decoder.counters()["frames"] == 9
    # Without a gap after the frame, the next marker confirms the frame.
    assert decoder.feed(frame(images[8]), 0.0903) is None
    assert decoder.feed(MARKER, 0.0904) is not None


def test_a_single_marker_is_not_enough_for_a_lock():
    decoder = FlexiTacDecoder(ROWS, COLS)
    assert decode(decoder, [frame(bytes(CELLS))]) == []
    assert not decoder.locked
    assert decoder.settle() is None
    decoder.feed(MARKER, 0.0)
    assert decoder.locked


def test_trailing_bytes_after_a_frame_are_reported():
    decoder = FlexiTacDecoder(ROWS, COLS)
    one = frame(bytes(CELLS))
    decoder.feed(one * 2 + MARKER, 1.0)
    assert decoder.feed(one[2:] + one[:5], 2.0).behind == 5
    late = decoder.feed(one[5:] + one, 3.0)  # The second frame may still be incomplete.
    assert late.behind == len(one)


@given(
    images=st.lists(st.one_of(payloads, nasty), min_size=1, max_size=8),
    start=st.integers(0, STRIDE),
    cuts=st.lists(st.integers(0, 8 * STRIDE), max_size=12),
)
@example(images=[b"\xaa\x55" * 10] * 4, start=0, cuts=[])
@example(images=[b"\x00" * 19 + b"\xaa"] * 4, start=0, cuts=[22, 44])
def test_frames_do_not_depend_on_how_the_stream_is_split(images, start, cuts):
    stream = b"".join(frame(image) for image in images)[start:]
    whole = FlexiTacDecoder(ROWS, COLS)
    expected = decode(whole, [stream])
    balance(whole, len(stream))

    pieces = FlexiTacDecoder(ROWS, COLS)
    newest = []
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    for left, right in itertools.pairwise(edges):
        decoded = pieces.feed(stream[left:right], 0.0)
        if decoded is not None:
            newest.append(decoded.data.astype(np.uint8).tobytes())
    assert pieces.counters() == whole.counters()
    assert set(newest) <= set(expected)
    if newest:
        assert newest[-1] == expected[-1]


@given(
    images=st.lists(nasty, min_size=2, max_size=6),
    start=st.integers(0, STRIDE),
)
def test_no_wrong_frame_for_any_images(images, start):
    """Check that the decoder returns only frames that were sent, from any start in the stream."""
    # Append two frames that do not contain AA 55, because a constant image would remain ambiguous.
    images = [*images, *numbered(2)]
    stream = b"".join(frame(image) for image in images)[start:]
    found = decode(FlexiTacDecoder(ROWS, COLS), [stream, MARKER])
    assert found == images[len(images) - len(found) :]
    assert images[-1] in found


def test_a_constant_image_that_contains_the_marker_is_ambiguous():
    image = bytearray(CELLS)
    image[7:9] = MARKER
    stream = frame(bytes(image)) * 30
    decoder = FlexiTacDecoder(ROWS, COLS)
    assert decode(decoder, [stream[5:]]) == []
    assert decoder.counters()["ambiguous"] > 0
    assert "several times" in decoder.diagnosis()
    # Once the image changes, only one position is possible.
    found = decode(decoder, [frame(image) for image in numbered(3)])
    assert found[-1] == numbered(3)[1]


def test_a_lock_persists_with_a_constant_image_that_contains_the_marker():
    image = bytearray(CELLS)
    image[7:9] = MARKER
    decoder = FlexiTacDecoder(ROWS, COLS)
    images = [*numbered(2), *[bytes(image)] * 40]
    assert decode(decoder, [*map(frame, images), MARKER]) == images
    assert decoder.counters()["resyncs"] == 0


def test_a_quiet_line_does_not_confirm_a_frame_that_could_be_incomplete():
    decoder = FlexiTacDecoder(ROWS, COLS)
    decode(decoder, [frame(image) for image in numbered(3)])
    assert decoder.settle() is not None
    torn = frame(bytes(CELLS))[:-1]
    # The frame lacks its last byte and is followed by the first byte of the next marker.
    decoder.feed(torn + MARKER[:1], 0.0)
    assert decoder.pending
    assert decoder.settle() is None
    # If the next marker is lost, the bytes after the frame cause the decoder to reject the frame.
    decoder = FlexiTacDecoder(ROWS, COLS)
    decode(decoder, [frame(image) for image in numbered(3)])
    spliced = frame(bytes(CELLS))[:-4] + bytes([9]) * (CELLS - 3)
    assert decode(decoder, [spliced, *map(frame, numbered(3, first=20)), MARKER]) == [
        numbered(3)[2],
        *numbered(3, first=20),
    ]


@pytest.mark.parametrize(("rows", "cols"), [(4, 4), (5, 5), (16, 16), (44, 44), (256, 256)])
def test_a_grid_of_another_size_is_recognised_by_the_marker_spacing(rows, cols):
    rng = np.random.default_rng(3)
    decoder = FlexiTacDecoder(32, 32)
    cells = rows * cols
    for _ in range(max(12, 15 * 1026 // cells)):
        image = rng.integers(0, 200, cells, dtype=np.uint8).tobytes()
        assert decoder.feed(frame(image), 0.0) is None
    assert decoder.found_cells == cells
    assert f"{cells} cells" in decoder.diagnosis()
    assert "1024 cells" in decoder.diagnosis()


def test_another_size_is_recognised_with_a_constant_image_that_contains_markers():
    image = bytes(40) + MARKER + bytes(14) + MARKER + bytes(198)
    decoder = FlexiTacDecoder(32, 32)
    for _ in range(12):
        decoder.feed(frame(image), 0.0)
    assert decoder.found_cells == 256
