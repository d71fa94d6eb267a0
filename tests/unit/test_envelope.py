"""Test the computation of the grip envelope, the stored map, and the warnings of `grasp`."""

from typing import Any

import pytest

from softfinger.daemon.control.envelope import Envelope, increased_force_limit
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.cli import main
from softfinger.tools.setup import envelope
from softfinger.tools.simulated_daemon import SimulatedDaemon


def settings(width: float = 0.040, **control: Any) -> Settings:
    """Return the settings of the built-in hand, with an object of the given width [m]."""
    return Settings.model_validate({"object": {"width": width}, "control": control})


def test_default_grips_are_inside_the_packaged_map():
    for width in (0.020, 0.040, 0.060, 0.090):
        assert Envelope(settings(width)).warning(10.0) == ""


def test_a_grip_outside_the_map_gets_a_warning_with_the_reason():
    text = Envelope(settings(0.002, object_load=9.81)).warning(10.0)
    assert "object.width = 2 mm, control.tip_friction = 0.6, a mass of 1 kg" in text
    assert "the object slips out" in text
    # The map covers a friction of 0.2 and a grip of 10 N whose force may increase to 20 N. If the
    # force may increase less, the grip can carry less load.
    for load, force, more in ((9.5, 10.0, 10.0), (7.3, 5.0, 10.0), (5.0, 10.0, 0.0)):
        control = {"tip_friction": 0.25, "object_load": load, "grip_raise_max": more}
        assert "slips out" in Envelope(settings(0.040, **control)).warning(force)
    held = settings(0.040, tip_friction=0.25, object_load=4.8)
    assert Envelope(held).warning(10.0) == ""
    # The map is valid only for its own control law and hand.
    heavy = {"object_load": 9.81}
    assert Envelope(settings(0.002, law="upright", **heavy)).warning(10.0) == ""
    thin = {"object": {"width": 0.002}, "control": heavy}
    other = Settings.model_validate({"tip": {"radius": 0.015}, **thin})
    assert Envelope(other).warning(10.0) == ""


def test_the_warning_considers_both_bounds_of_the_force_increase():
    # A grip of 10 N can carry the load if the force may increase to 20 N. If the force may increase
    # only to 15 N, the grip cannot carry the load.
    control = {"tip_friction": 0.25, "object_load": 4.8}
    assert Envelope(settings(0.040, **control)).warning(10.0) == ""
    for bound in ({"grip_raise_max": 5.0}, {"grip_raise_share": 0.5}):
        changed = settings(0.040, **control, **bound)
        assert increased_force_limit(changed, 10.0) == 15.0
        assert "slips out" in Envelope(changed).warning(10.0)


def test_a_grasp_outside_the_map_is_accepted_with_a_warning():
    for width, warned in ((0.002, True), (0.040, False)):
        thin = {"object": {"width": width, "width_min": 0.0005}}
        with SimulatedDaemon({**thin, "control": {"object_load": 9.81}}) as hand:
            hand.run(0.3)
            hand.command("arm")
            hand.run(0.2)
            reply = hand.command("grasp", force=10.0)
            assert reply["mode"] == "grasping"
            assert ("warning" in reply) == warned


@pytest.mark.extended
def test_a_map_is_computed_printed_drawn_and_read(tmp_path, capsys):
    kept, picture = tmp_path / "map.toml", tmp_path / "map.png"
    words = ["envelope", "--shape", "rectangle", "--size", "2", "40", "--mass", "1"]
    words += ["--friction", "0.2", "0.6", "--processes", "1"]
    assert main([*words, "--keep", str(kept), "--plot", str(picture)]) == 0
    rows = [line.split()[-2:] for line in capsys.readouterr().out.splitlines()[3:]]
    assert rows == [["l", "l"], ["l", "h"]]
    assert picture.stat().st_size > 1000
    own = str(kept)
    assert "the object slips out" in Envelope(settings(0.002, envelope=own)).warning(10.0)
    slippery = settings(0.04, envelope=own, tip_friction=0.2)
    assert "slips out" in Envelope(slippery).warning(10.0)
    assert Envelope(settings(0.04, envelope=own)).warning(10.0) == ""
    with pytest.raises(SettingsError, match=r"another hand: control\.law: found energy, expected"):
        Envelope(settings(envelope=own, law="upright"))
    with pytest.raises(SettingsError, match=r"control.envelope: .*none.toml: can't be read"):
        Envelope(settings(envelope=str(tmp_path / "none.toml")))


@pytest.fixture
def grasps(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Replace the simulation, and return the list of simulated cases."""
    cases: list[Any] = []
    monkeypatch.setattr(envelope, "build_kernels", lambda *_: None)
    monkeypatch.setattr(
        envelope, "grasped", lambda _, __, case: cases.append(case) or envelope.Cell("h", 0.0)
    )
    return cases


SMALL = ["envelope", "--friction", "0.2", "--mass", "1", "1.0", "--processes", "1"]


def test_repeated_values_are_simulated_once(grasps):
    assert main([*SMALL, "--shape", "disc", "--shape", "disc", "--size", "30", "30"]) == 0
    assert grasps == [("disc", 0.2, 1.0, 30.0)]


@pytest.mark.parametrize("name", ["map.xyz", "map", "none/map.png"])
def test_a_picture_that_cannot_be_written_is_rejected_first(grasps, tmp_path, inline, name):
    done = inline(*SMALL, "--size", "30", "--plot", tmp_path / name)
    assert done.returncode == 2
    assert "expected a name ending in .png, .svg or .pdf in an existing folder" in done.stderr
    assert grasps == []


def test_hands_of_a_map_run_at_the_rate_of_the_profile():
    with SimulatedDaemon({"loop": {"rate": 200.0}}) as hand:
        assert hand.loop.period == pytest.approx(5e-3)
