"""Fuzz every tactile framing and the ASCII export reader with random and mutated bytes."""

import random

import numpy as np

from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS
from softfinger.daemon.tactile.cobs import CobsDecoder
from softfinger.daemon.tactile.decoder import Decoder
from softfinger.daemon.tactile.flexitac import FlexiTacDecoder
from softfinger.daemon.tactile.glove import GloveDecoder
from softfinger.daemon.tactile.tekscan import TekscanError, parse
from tests.fuzz import Report, mutated

ROWS, COLS = 4, 5
DECODERS = {"flexitac": FlexiTacDecoder, "glove": GloveDecoder, "cobs": CobsDecoder}
LIMITS = {"flexitac": 255, "glove": 1023, "cobs": 65535}
TARGETS = (*DECODERS, "ascii")
EXPORT = """\
SENSOR_TYPE 5051
ROWS 2
ROW_SPACING 1.27 mm
COLS 3
COL_SPACING 0.127 cm
SENSEL_AREA 1.6129 mm2
NOISE_TRESHOLD 3
SECONDS_PER_FRAME 0.04
UNITS kPa
ASCII_DATA @@
Frame 1
0,5.5,B
7,255,1
Frame 2
1,2,B
3,4,5
@@
"""
WORDS = (
    *[",", "B", "Frame", "@@", "nan", "inf", "-1", "1e999", "1e300", "é", "mm3"],
    *("Frame 9", "ROWS 0", "ROWS 7", "UNITS x", "UNITS RAW"),
    *("\n", "\x00", "9" * 30, "ASCII_DATA @@", " "),
)


def _stream(source: random.Random, target: str, sent: dict[bytes, int]) -> bytes:
    if source.random() < 0.05:
        return source.randbytes(source.randrange(200))
    parts = []
    for _ in range(source.randrange(1, 4)):
        limit = source.choice((2, 200, LIMITS[target] + 1))
        values = [source.randrange(limit) for _ in range(ROWS * COLS)]
        counts = np.array(values, np.uint16).reshape(ROWS, COLS)
        sent[counts.tobytes()] = 1
        parts.append(ENCODERS[target].encode(counts, source.randrange(70000), source.random()))
    return b"".join(parts)


def fuzz_framing(target: str, count: int, seed: int) -> Report:
    """Feed ``count`` mutated streams to a decoder, which must still find the valid frames."""
    source = random.Random(seed)
    decoder: Decoder = DECODERS[target](ROWS, COLS)
    fed, frames, foreign = 0, 0, 0
    wrong: list[str] = []
    sent: dict[bytes, int] = {}
    for k in range(count):
        if k % 1000 == 0:
            sent.clear()
        data = mutated(source, _stream(source, target, sent))
        cut = source.randrange(len(data) + 1)
        found = [decoder.feed(data[:cut], k * 0.01), decoder.feed(data[cut:], k * 0.01)]
        if source.random() < 0.1:
            found.append(decoder.settle())
        decoder.missing, decoder.pending, decoder.lost  # noqa: B018
        fed += len(data)
        for decoded in found:
            if decoded is None:
                continue
            frames += 1
            if decoded.data.shape != (ROWS, COLS) or int(decoded.data.max()) > LIMITS[target]:
                wrong.append(f"input {k}: a frame out of range")
            foreign += decoded.data.tobytes() not in sent
        if k % 997 == 0:
            decoder.diagnosis()
            if min(decoder.counters().values()) < 0 or decoder.counters()["skipped_bytes"] > fed:
                wrong.append(f"input {k}: counters {decoder.counters()}")
    last = None
    for k in range(12):
        counts = np.full((ROWS, COLS), 100 + k, np.uint16)
        decoded = decoder.feed(ENCODERS[target].encode(counts, k, 0.0), 1e6 + k)
        last = decoded or last
    last = decoder.settle() or last
    if last is None or int(last.data[0, 0]) < 110:
        wrong.append("good frames were not found again")
    return Report(frames, wrong, foreign)


def fuzz_ascii(count: int, seed: int) -> Report:
    """Read ``count`` mutated exports; each must yield readings or a TekscanError."""
    source = random.Random(seed)
    frames = 0
    wrong: list[str] = []
    for k in range(count):
        text = EXPORT
        for _ in range(source.randrange(4)):
            at = source.randrange(len(text) + 1)
            skip = source.choice((0, 0, 1, 5, source.randrange(40)))
            text = text[:at] + source.choice(WORDS) + text[at + skip :]
        if source.random() < 0.3:
            text = mutated(source, text.encode()).decode("latin-1")
        try:
            export = parse(text)
        except TekscanError:
            continue
        frames += 1
        if np.isinf(export.values).any():
            wrong.append(f"input {k}: readings that are no pressures")
        if not (np.diff(export.t) > 0).all() or len(export.t) != len(export.values):
            wrong.append(f"input {k}: times or cells")
    return Report(frames, wrong)


def fuzz(target: str, count: int, seed: int) -> Report:
    """Fuzz one of TARGETS; propagate exceptions from the code under test."""
    if target == "ascii":
        return fuzz_ascii(count, seed)
    return fuzz_framing(target, count, seed)
