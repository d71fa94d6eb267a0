"""Test recording files and their replay in virtual time."""

import numpy as np
import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import RecordingError, TactileError
from softfinger.daemon.profile.settings import TactileSettings
from softfinger.daemon.tactile.replay import ReplayTactile
from tests.harness.tactile import read_frames

FRAMES = np.arange(5 * 4 * 6, dtype=np.uint16).reshape(5, 4, 6)


def replay(path, clock, **keys) -> ReplayTactile:
    settings = TactileSettings.model_validate(
        {
            "backend": "replay",
            "rows": 4,
            "cols": 6,
            "rate": 100.0,
            "recording": (str(path), ""),
            "latency": 0.002,
            **keys,
        }
    )
    return ReplayTactile(settings, clock, 0)


def numbers(sensor, clock, times):
    found = []
    for t in times:
        clock.sleep_until(t)
        frame = sensor.latest()
        found.append((frame.seq, int(frame.data[0, 0]) // 24))
    return found


def test_frames_are_replayed_at_their_times_and_repeated_from_the_start(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, frames=FRAMES, t=np.array([7.0, 7.01, 7.05, 7.06, 7.08]))
    clock = VirtualClock(start=3.0)
    sensor = replay(path, clock)
    sensor.open()
    found = numbers(sensor, clock, (3.0, 3.009, 3.010, 3.049, 3.05, 3.079, 3.08, 3.0999, 3.1, 3.11))
    assert found == [
        (1, 0), (1, 0), (2, 1), (2, 1), (3, 2), (4, 3), (5, 4), (5, 4), (6, 0), (7, 1),
    ]  # fmt: skip
    frame = sensor.latest()
    assert frame.t_arrival == pytest.approx(3.11)
    assert frame.t_sample == pytest.approx(3.108)
    clock.sleep_until(1000.0)
    assert sensor.latest().seq == 5 * int(997.0 / 0.1) + 1


def test_without_repetition_the_replay_ends_with_an_invalid_frame(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, frames=FRAMES)
    clock = VirtualClock()
    sensor = replay(path, clock, replay_again=False)
    sensor.open()
    assert numbers(sensor, clock, (0.045,)) == [(5, 4)]
    assert sensor.latest().valid
    assert numbers(sensor, clock, (0.051, 9.0)) == [(6, 4), (6, 4)]
    assert not sensor.latest().valid


def test_a_folder_of_frames_is_read_in_numerical_order(tmp_path):
    for k in range(5):
        np.save(tmp_path / f"frame{k * 3}.npy", FRAMES[k])  # frame12 must follow frame9.
    recording = read_frames(tmp_path, 1.0, 50.0)
    assert np.array_equal(recording.counts, FRAMES)
    assert recording.t.tolist() == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08])
    np.save(tmp_path / "t.npy", np.array([1.0, 2, 3, 5, 8]))
    assert read_frames(tmp_path, 1.0, 50.0).t.tolist() == [0, 1, 2, 4, 7]


def test_cells_and_true_contacts_of_an_archive_are_read(tmp_path):
    live = np.ones((4, 6), bool)
    live[1, 2] = False
    d = np.linspace(0, 0.008, 5)
    np.savez_compressed(tmp_path / "run.npz", frames=FRAMES, t=np.arange(5) * 0.1, live=live, d=d)
    read = read_frames(tmp_path / "run.npz", 1.0, 1.0)
    assert np.array_equal(read.counts, FRAMES)
    assert np.array_equal(read.live, live)
    assert np.array_equal(read.truths["d"], d)


@pytest.mark.parametrize(
    ("held", "told"),
    [
        ({"other": FRAMES[0]}, r"found other \(4, 6\), expected an array 'frames'"),
        (
            {"a": FRAMES, "b": FRAMES},
            r"found a \(5, 4, 6\), b \(5, 4, 6\), expected an array 'frames'",
        ),
        ({"other": np.array(["x"])}, "expected an array 'frames'"),
        ({}, "found no arrays, expected an array 'frames'"),
        ({"frames": FRAMES[0]}, r"expected \[n, rows, cols\]"),
        ({"frames": FRAMES[:0]}, "shape"),
        ({"frames": FRAMES.astype(complex)}, "expected numbers"),
        ({"frames": -FRAMES.astype(float)}, "outside 0 to 65535"),
        ({"frames": FRAMES * np.nan}, "outside 0 to 65535"),
        ({"frames": FRAMES * 1e305}, "outside 0 to 65535"),
        ({"frames": FRAMES, "t": np.zeros(5)}, "expected increasing times"),
        ({"frames": FRAMES, "t": np.arange(4)}, "5 numbers"),
        ({"frames": FRAMES, "d": np.full(5, np.nan)}, "d: found a number that is not finite"),
        ({"frames": FRAMES, "live": np.ones(3)}, "live: found shape"),
        ({"frames": FRAMES, "live": np.zeros((4, 6), bool)}, "live: found only False"),
        ({"frames": np.array([{}], dtype=object)}, "run.npz"),
    ],
)
def test_invalid_recordings_are_reported(tmp_path, held, told):
    path = tmp_path / "run.npz"
    np.savez(path, **held)
    with pytest.raises(RecordingError, match=told):
        read_frames(path, 0.001, 100.0)


@pytest.mark.parametrize(
    "header",
    ["{'descr': '<f8', ", "{[]: 1}", "-" * 3000 + "1", "  a\n b",
     "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 4, 4), }",
     f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({10**20}, 0, 4), }}"],
)  # fmt: skip
def test_a_damaged_header_is_reported(header, tmp_path):
    text = f"{header}\n".encode()
    start = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little")
    (tmp_path / "a.npy").write_bytes(start + text + bytes(999))
    with pytest.raises(RecordingError, match=r"a\.npy: the \.npy header is damaged: "):
        read_frames(tmp_path / "a.npy", 4.0, 100.0)


def test_unreadable_files_are_reported(tmp_path):
    with pytest.raises(RecordingError, match="No such file"):
        read_frames(tmp_path / "none.npz", 1.0, 1.0)
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 no zip")
    with pytest.raises(RecordingError, match=r"bad\.npz"):
        read_frames(tmp_path / "bad.npz", 1.0, 1.0)
    with pytest.raises(RecordingError, match=r"does not contain an \.npy file"):
        read_frames(tmp_path, 1.0, 1.0)
    with pytest.raises(TactileError, match="found no file for the left finger"):
        replay("", VirtualClock())
