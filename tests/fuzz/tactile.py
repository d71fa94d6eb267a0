"""Random and mutated bytes against every tactile framing and the reader of ASCII exports.

The tests run some thousand; ``python -m tests.fuzz.tactile --count 1000000`` runs a million of
each.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from typing import NamedTuple

import numpy as np

from softfinger.daemon.simulation.emulator.tactile_board import ENCODERS
from softfinger.daemon.tactile.cobs import CobsDecoder
from softfinger.daemon.tactile.decoder import Decoder
from softfinger.daemon.tactile.flexitac import FlexiTacDecoder
from softfinger.daemon.tactile.glove import GloveDecoder
from softfinger.daemon.tactile.tekscan import TekscanError, parse

ROWS, COLS = 4, 5
DECODERS = {"flexitac": FlexiTacDecoder, "glove": GloveDecoder, "cobs": CobsDecoder}
LIMITS = {"flexitac": 255, "glove": 1023, "cobs": 65535}
TARGETS = (*DECODERS, "ascii")
SPECIAL = bytes((0, 1, 10, 11, 42, 43, 0x55, 0xAA, 254, 255))

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


class Report(NamedTuple):
    frames: int  # that came out, or exports that were read
    foreign: int  # of them such as were never sent, where the framing can tell
    wrong: list[str]
    slowest: float  # s


def mutated(source: random.Random, data: bytes) -> bytes:
    """``data`` with up to four bytes or pieces changed, removed, put in, doubled or swapped."""
    work = bytearray(data)
    for _ in range(source.randrange(5)):
        if not work:
            break
        at = source.randrange(len(work))
        kind = source.randrange(7)
        if kind == 0:
            work[at] = source.randrange(256)
        elif kind == 1:
            work[at] ^= 1 << source.randrange(8)
        elif kind == 2:
            del work[at : at + source.randrange(1, 1 + len(work) // 2 + 1)]
        elif kind == 3:
            work.insert(at, source.choice(SPECIAL))
        elif kind == 4:
            work[at:at] = work[at : at + source.randrange(40)]
        elif kind == 5:
            work[at:at] = source.randbytes(source.randrange(30))
        else:
            del work[at:]
    return bytes(work)


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
    """Feed ``count`` mutated streams to one decoder, in pieces; then it must find good frames."""
    source = random.Random(seed)
    decoder: Decoder = DECODERS[target](ROWS, COLS)
    fed, frames, foreign, slowest = 0, 0, 0, 0.0
    wrong: list[str] = []
    sent: dict[bytes, int] = {}
    for k in range(count):
        if k % 1000 == 0:
            sent.clear()
        data = mutated(source, _stream(source, target, sent))
        cut = source.randrange(len(data) + 1)
        begin = time.perf_counter()
        found = [decoder.feed(data[:cut], k * 0.01), decoder.feed(data[cut:], k * 0.01)]
        if source.random() < 0.1:
            found.append(decoder.settle())
        decoder.missing, decoder.pending, decoder.lost  # noqa: B018
        slowest = max(slowest, time.perf_counter() - begin)
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
    return Report(frames, foreign, wrong, slowest)


def fuzz_ascii(count: int, seed: int) -> Report:
    """Read ``count`` mutated exports: each gives finite readings or a TekscanError."""
    source = random.Random(seed)
    frames, slowest = 0, 0.0
    wrong: list[str] = []
    for k in range(count):
        text = EXPORT
        for _ in range(source.randrange(4)):
            at = source.randrange(len(text) + 1)
            skip = source.choice((0, 0, 1, 5, source.randrange(40)))
            text = text[:at] + source.choice(WORDS) + text[at + skip :]
        if source.random() < 0.3:
            text = mutated(source, text.encode()).decode("latin-1")
        begin = time.perf_counter()
        try:
            export = parse(text)
        except TekscanError:
            continue
        finally:
            slowest = max(slowest, time.perf_counter() - begin)
        frames += 1
        if not (np.isfinite(export.values).all() and (export.values >= 0).all()):
            wrong.append(f"input {k}: readings that are no pressures")
        if not (np.diff(export.t) > 0).all() or export.live.shape != export.values.shape[1:]:
            wrong.append(f"input {k}: times or cells")
    return Report(frames, 0, wrong, slowest)


def fuzz(target: str, count: int, seed: int) -> Report:
    """Fuzz one of TARGETS; raises whatever the code under test raises."""
    if target == "ascii":
        return fuzz_ascii(count, seed)
    return fuzz_framing(target, count, seed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000, help="inputs for each")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=TARGETS)
    options = parser.parse_args()
    bad = 0
    for target in (options.only,) if options.only else TARGETS:
        begin = time.perf_counter()
        report = fuzz(target, options.count, options.seed)
        bad += bool(report.wrong)
        print(
            f"{target}: {options.count} inputs in {time.perf_counter() - begin:.0f} s, "
            f"{report.frames} came through, {report.foreign} of them never sent; slowest "
            f"{report.slowest * 1e3:.2f} ms; {len(report.wrong)} wrong {report.wrong[:3]}",
            flush=True,
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
