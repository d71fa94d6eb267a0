"""Test that malformed messages in recordings are reported and skipped, without a traceback."""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.tools.recordings.analyse import analyse, open_source
from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import recompute, recorded_settings
from tests.harness.golden_wire import sample
from tests.harness.recorded_hand import write_recording

GOLDEN = Path(__file__).parents[1] / "golden" / "grasp_and_turn.mcap"
SPOILT: dict[str, Any] = {
    "no finger": ("finger", None),
    "another finger": ("finger", "thumb"),
    "no rows": ("rows", None),
    "rows as a text": ("rows", "44"),
    "more rows than data": ("rows", 45),
    "rows beyond memory": ("rows", 2**40),
    "no time": ("timestamp", [1]),
    "too little data": ("data", b"\0"),
}


def frame(k: int) -> dict[str, Any]:
    message = copy.deepcopy(sample(schema.TACTILE))
    data = np.zeros((44, 44), "<u2").tobytes()
    return {
        **message,
        "seq": k,
        "timestamp": 1e9 + 0.01 * k,
        "finger": "left",
        "rows": 44,
        "cols": 44,
        "unit": "count",
        "data": data,
    }


def settings_message() -> dict[str, Any]:
    message = copy.deepcopy(sample(schema.SETTINGS))
    calibrations = {"calibration_left": "", "calibration_right": ""}
    return {**message, **calibrations, "settings": Settings().model_dump_json()}


def recording(path: Path, spoil: tuple[str, Any] | None) -> Path:
    """Write a recording of ten frames; if ``spoil`` is given, corrupt one frame."""
    messages = [(schema.SETTINGS, settings_message())]
    for k in range(10):
        message = frame(k)
        if spoil is not None and k == 5:
            name, value = spoil
            if value is None:
                del message[name]
            else:
                message[name] = value
        messages.append((schema.TACTILE, message))
        messages.append((schema.STATE, {**sample(schema.STATE), "seq": k}))
    write_recording(path, messages)
    return path


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_malformed_frame_is_reported_and_omitted(tmp_path, spoil):
    path = recording(tmp_path / "a.mcap", spoil)
    told: list[str] = []
    found = list(Recording(path, told.append).messages([schema.TACTILE]))
    assert len(found) == 9
    assert len(told) == 1
    assert "the intact part is read" in told[0]
    source = open_source(path, Settings(), own=True)
    contacts = analyse(source, lambda _: None)
    assert contacts[0].t.size == 9
    assert Recording(path).states()["t"].size == 10


@pytest.mark.parametrize("delay", [None, "0.02"])
def test_a_message_without_a_valid_time_is_not_the_origin_of_the_times(tmp_path, delay):
    state = sample(schema.STATE) | {"timestamp": 1e9 + 1.0, "mono_ns": 6_000_000_000}
    late = frame(0) | {"delay_s": delay}
    found = write_recording(tmp_path / "a.mcap", [(schema.TACTILE, late), (schema.STATE, state)])
    assert found.states()["t"].tolist() == pytest.approx([1.0])


@pytest.mark.parametrize("name", ["settings", "calibration_left"])
def test_settings_without_text_are_reported(tmp_path, name):
    message = settings_message()
    del message[name]
    found = write_recording(tmp_path / "a.mcap", [(schema.SETTINGS, message)])
    with pytest.raises(RecordingError, match="hand/settings does not contain"):
        recorded_settings(found)


def test_recorded_settings_cannot_name_files(tmp_path):
    named = Settings().model_dump()
    files = ("calibration", "recording", "envelope", "keys")
    for section in named.values():
        for key in section.keys() & set(files):
            section[key] = "/dev/zero" if section[key] == "" else ("/dev/zero", "/dev/zero")
    text = Settings.model_validate(named).model_dump_json()
    assert text.count("/dev/zero") == 6
    message = {**settings_message(), "settings": text}
    found = write_recording(tmp_path / "a.mcap", [(schema.SETTINGS, message)])
    assert recorded_settings(found)[0] == Settings()


@pytest.mark.parametrize("spoilt", ["seq", "t", "reading", "left", "timestamp"])
def test_malformed_inputs_are_reported(tmp_path, spoilt):
    messages = list(Recording(GOLDEN).messages(end=0.1))
    for topic, message in messages:
        if topic == schema.INPUT:
            message[spoilt] = "none"
        elif topic == schema.COMMAND:
            message.pop("ok")
    with pytest.raises(RecordingError, match="do not form complete ticks"):
        recompute(write_recording(tmp_path / "a.mcap", messages))
