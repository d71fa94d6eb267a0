"""Compare tips in MuJoCo with the contact table, and a grip in MuJoCo with softfinger's plant."""

import math
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softfinger.daemon import backends
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.load import checked

mujoco = pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")

from softfinger.mujoco import MujocoHand, SoftTips  # noqa: E402

pytestmark = pytest.mark.extended
PAGE = Path(__file__).parents[2] / "docs" / "mujoco.md"
SETTINGS = checked({"loop": {"clock": "virtual"}})
RADIUS, FRICTION = SETTINGS.tip.radius, SETTINGS.simulation.tip_friction
# The tip points along x, and the wall's face is tilted about z.
SCENE = """<mujoco><option timestep="0.002" gravity="0 0 0" integrator="{integrator}"/>
<default><geom contype="0" conaffinity="0"/><joint type="slide" damping="5"/></default><worldbody>
<body><joint axis="1 0 0"/>{joints}
<geom name="tip" size="{radius}" mass="0.05" zaxis="1 0 0"/></body>
<geom name="wall" type="box" size="0.05 0.1 0.1" pos="{x} {y} 0" euler="0 0 {degrees}"/>
</worldbody><sensor><user name="tip_pressure" dim="1936" needstage="vel"/></sensor></mujoco>"""
FREE = '<joint axis="0 1 0"/><joint axis="0 0 1"/>'


def scene(
    tilt: float = 0.0, joints: str = "", integrator: str = "implicitfast", radius: float = RADIUS
) -> tuple[Any, Any]:
    """Return a model and data, in which the tip just touches a face tilted by ``tilt`` [rad]."""
    away = RADIUS + 0.05
    place = {"x": away * math.cos(tilt), "y": away * math.sin(tilt), "degrees": math.degrees(tilt)}
    text = SCENE.format(joints=joints, integrator=integrator, radius=radius, **place)
    model = mujoco.MjModel.from_xml_string(text)
    return model, mujoco.MjData(model)


@pytest.mark.parametrize("force", [1.0, 12.0])
@pytest.mark.parametrize("tilt", [0.0, 0.25])
def test_a_static_contact_equals_the_table(force, tilt):
    model, data = scene(tilt)
    with SoftTips(model, data, SETTINGS, ("tip",), ("wall",)) as tips:
        data.qfrc_applied[0] = force
        mujoco.mj_step(model, data, 1000)
        pressed = data.sensordata.sum() * SETTINGS.tactile.pitch**2
        assert pressed == pytest.approx(tips.pressure(0).sum() * SETTINGS.tactile.pitch**2)
    assert abs(data.qvel[0]) < 1e-6
    expected = float(tips.table(data.qpos[0] * math.cos(tilt), tilt).force)
    assert expected == pytest.approx(force, rel=1e-3)
    assert pressed == pytest.approx(force, rel=0.01)


@pytest.mark.parametrize("used", [0.8, 1.1])
def test_friction_is_a_cone_including_the_lateral_direction(used):
    model, data = scene(joints=FREE)
    press, push = 6.0, used * FRICTION * 6.0
    with SoftTips(model, data, SETTINGS, ("tip",), ("wall",)) as tips:
        data.qfrc_applied[0] = press
        mujoco.mj_step(model, data, 500)
        data.qfrc_applied[1:] = 0.6 * push, 0.8 * push
        mujoco.mj_step(model, data, 500)
        d, slid = data.qpos[0], math.hypot(*data.qpos[1:])
        normal = tips.touches[0].contact.normal
    assert normal == pytest.approx(press, rel=1e-3)
    if used < 1.0:  # T = 2F d_t/d, as in the spring model.
        bears = 2.0 * float(tips.table(d, 0.0).force) / d
        assert slid == pytest.approx(push / bears, rel=1e-3)
        assert data.qpos[2] / data.qpos[1] == pytest.approx(4.0 / 3.0, rel=1e-3)
    else:  # The remaining push moves the face against a damping of 5 N·s/m.
        speed = (push - FRICTION * press) / 5.0
        assert math.hypot(*data.qvel[1:]) == pytest.approx(speed, rel=0.01)


def test_unsupported_options_are_refused():
    with pytest.raises(SettingsError, match="found RK4"):
        SoftTips(*scene(integrator="RK4"), SETTINGS, ("tip",), ("wall",))
    with pytest.raises(SettingsError, match=r"tip: expected a sphere of radius 0\.02 m"):
        SoftTips(*scene(radius=0.01), SETTINGS, ("tip",), ("wall",))
    refused = {"object_shape": "disc", "tip_creep_time": 1.0, "joint_stribeck": 0.01}
    for key, value in refused.items():
        with pytest.raises(SettingsError, match=key):
            MujocoHand(checked({"simulation": {key: value}}))


@pytest.mark.parametrize("timestep", [0.001, 0.002])
def test_the_documented_program_grasps_and_turns_like_our_plant(monkeypatch, timestep):
    entry = EntryPoint("mujoco", "softfinger.mujoco:MujocoServos", "softfinger.servos")
    monkeypatch.setattr(backends, "plugins", lambda kind: [entry] if kind == "servos" else [])
    backends._plugin.cache_clear()
    code = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[-1]
    names: dict[str, Any] = {}
    exec(code.partition("# Compare")[0].replace("0.001", str(timestep)), names)
    ours, mujocos = (names["turned"](backend) for backend in ("simulated", "mujoco"))
    backends._plugin.cache_clear()
    assert math.degrees(mujocos.angle[-1]) == pytest.approx(math.degrees(ours.angle[-1]), abs=0.5)
    late = slice(-250, None)
    for mean in (0, 1):
        assert mujocos.force[late, mean].mean() == pytest.approx(
            ours.force[late, mean].mean(), rel=0.05
        )
    assert np.ptp(mujocos.force[late]) - np.ptp(ours.force[late]) < 0.2  # at rest
