"""Test the supported variants of Tekscan-style exports, and the errors for unsupported files."""

import numpy as np
import pytest

from softfinger.daemon.errors import RecordingError
from softfinger.daemon.tactile.tekscan import TekscanError, parse
from tests.harness.tactile import read_frames

EXPORT = """\
DATA_TYPE MOVIE
VERSION I-Scan 5.1
SENSOR_TYPE 5051
ROWS 2
ROW_SPACING 1.27 mm
COLS 3
COL_SPACING 0.2 cm
SENSEL_AREA 0.0254 cm2
NOISE_TRESHOLD 3
SECONDS_PER_FRAME 0.04
UNITS RAW
START_FRAME 4
END_FRAME 6
ASCII_DATA @@
Frame 4
0,5,B
7,255,1

Frame 6 0.08 s
1,2,B
3,4,5
@@
"""


def test_header_frames_times_and_missing_cells():
    export = parse(EXPORT)
    assert export.raw
    assert export.pitch == pytest.approx((2e-3, 1.27e-3))
    assert export.t.tolist() == pytest.approx([0.0, 0.08])
    expected = [[[0, 5, np.nan], [7, 255, 1]], [[1, 2, np.nan], [3, 4, 5]]]
    assert np.array_equal(export.values, expected, equal_nan=True)


HEAD, FRAMES = EXPORT.split("Frame 4")
SPREAD = "".join(f"{line},,\n" for line in HEAD.splitlines())
SAME = {
    "line ends and no end mark": EXPORT.removesuffix("@@\n").replace("\n", "\r\n"),
    "a spreadsheet's commas": SPREAD + "Frame 4, 0,, 6:21:52 PM,,,Raw" + FRAMES,
    "comments that look like a header": EXPORT.replace(
        "UNITS RAW", "COMMENTS:\nunits were wrong, cols swapped\nsecond line\nUNITS RAW"
    ),
    "a unit spelt out": EXPORT.replace("1.27 mm", "0.127 centimeters"),
    "another unit": EXPORT.replace("1.27 mm", "0.05 inches"),
}


@pytest.mark.parametrize("text", SAME.values(), ids=SAME)
def test_variants_of_other_programs_are_read(text):
    export = parse(text)
    assert export.raw
    assert export.pitch == pytest.approx((2e-3, 1.27e-3))
    assert np.array_equal(export.values, parse(EXPORT).values, equal_nan=True)


@pytest.mark.parametrize(
    ("unit", "pascal"),
    [
        *(("kPa", 1e3), ("KPA", 1e3), ("N/cm2", 1e4)),
        *(("N/mm^2", 1e6), ("PSI", 6894.757), ("mmHg", 133.32239)),
    ],
)
def test_pressures_are_converted_to_pa(unit, pascal):
    export = parse(EXPORT.replace("UNITS RAW", f"UNITS {unit}").replace("255", "2.55"))
    assert not export.raw
    assert export.values[0, 1, 1] == pytest.approx(2.55 * pascal)


def test_apostrophes_group_the_digits_of_readings():
    found = parse(EXPORT.replace("UNITS RAW", "UNITS Pa").replace("255", "1'224.5"))
    assert found.values[0, 1, 1] == 1224.5


def test_a_single_frame_needs_no_frame_line():
    single = EXPORT.split("Frame 4")[0] + "0,5,B,\n7,255,1,\n@@\n"
    assert np.array_equal(parse(single).values, parse(EXPORT).values[:1], equal_nan=True)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("ASCII_DATA @@", "", "does not contain an ASCII_DATA line"),
        ("ROWS 2\n", "", "ROWS is missing"),
        ("ROWS 2", "ROWS two", "ROWS: found 'two'"),
        ("ROWS 2", "ROWS 99999", "ROWS: found"),
        ("1.27 mm", "1.27 furlong", "ROW_SPACING"),
        ("1.27 mm", "-1.27 mm", "ROW_SPACING"),
        ("UNITS RAW", "UNITS stone", "UNITS"),
        ("0.04", "-1", "SECONDS_PER_FRAME"),
        ("Frame 6 0.08 s", "Frame 3", "line 19: found frame 3 after frame 4"),
        ("Frame 6 0.08 s", "Frame six", "line 19"),
        ("7,255,1", "7,255", "line 17: found 2 cells, expected 3"),
        ("7,255,1", "7,,1", "line 17"),
        ("7,255,1", "7,inf,1", "line 17: found INF, expected at most 1e"),
        ("7,255,1\n", "", "frame 4 has 1 of 2 rows"),
        ("3,4,5\n", "", "the file ends within frame 6, which has 1 of 2 rows"),
        ("3,4,5\n", "3,4,5\n6,7,8\n", "line 22"),
        ("3,4,5\n", f'3,4,"{200_000 * "5"}\n', "found '3,4,\"5555.*check the quotation marks"),
    ],
)
def test_files_that_are_not_exports_are_reported(old, new, told):
    with pytest.raises(TekscanError, match=told):
        parse(EXPORT.replace(old, new))


def test_an_export_is_read_as_a_recording(tmp_path):
    path = tmp_path / "run.asf"
    path.write_text(EXPORT)
    recording = read_frames(path, 4.0, 100.0)
    assert recording.counts.dtype == np.uint16
    assert recording.counts[0, 1].tolist() == [7, 255, 1]
    assert not recording.live[0, 2]
    path.write_text(EXPORT.replace("RAW", "kPa"))
    assert read_frames(path, 50.0, 100.0).counts[0, 1].tolist() == [140, 5100, 20]
    for value in ("nan", "-255"):
        path.write_text(EXPORT.replace("7,255,1", f"7,{value},1"))
        with pytest.raises(RecordingError, match=f"row 2, cell 2 .* is {value}, expected"):
            read_frames(path, 4.0, 100.0)
    path.write_text(EXPORT.replace("7,255,1", "7,70000,1"))
    with pytest.raises(RecordingError, match=r"is 70000, expected at most 65535 counts$"):
        read_frames(path, 4.0, 100.0)
    path.write_text("nothing")
    with pytest.raises(
        RecordingError, match=r"run\.asf: the file does not contain an ASCII_DATA line"
    ):
        read_frames(path, 4.0, 100.0)
