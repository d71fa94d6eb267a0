"""Compile a scene's kernels by running each part of the pipeline once before the first tick.

`loop.build` runs all parts before the loop is created, and therefore before torque can be switched
on. Before the first use, `processes.compile` compiles the parts in parallel. Each part builds the
objects that it needs, runs them on an artificial contact and discards them. Components that are not
in the scene are skipped.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np

from softfinger.daemon.backends import needs_hand
from softfinger.daemon.perception.calibration_file import Converter, calibration_for
from softfinger.daemon.perception.finger_model import FingerModel, make_estimator, make_models
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Contact, EventSink, Frame, ObjectPose, Reading
from softfinger.kinematics.compiled.kernel_folder import is_marked, kernel_folder, mark
from softfinger.kinematics.estimation.estimator import ContactEstimate
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.kinematics.hand.grasp_state import total_tilt
from softfinger.kinematics.hand.servo_heat import HeatState, follow, time_to_limit


class WantedScene:
    """Scene whose kernels are compiled; ``on_event`` receives events about the finger models."""

    def __init__(self, settings: Settings, on_event: EventSink | None = None) -> None:
        self.settings = settings
        self._on_event = on_event

    @cached_property
    def models(self) -> tuple[FingerModel, FingerModel]:
        """Models of both fingers."""
        return make_models(self.settings, self._on_event)

    @property
    def sensing(self) -> list[int]:
        """Indices of the fingers with a sensor."""
        return [] if self.settings.tactile.backend == "none" else self.settings.scene.indices


class Part(NamedTuple):
    """One part of the pipeline and its kernels."""

    name: str
    kernels: int  # approximate number of kernels, for the progress bar
    run: Callable[[WantedScene], None]
    after: str = ""  # name of a part that must be compiled first


def parts(settings: Settings) -> list[Part]:
    """Return the parts required by ``settings``, ordered for compilation by two processes.

    One process compiles the estimator and the simulated sensor, because they share kernels. The
    second process compiles the contact table before the simulated hand and the filter, because both
    use the table. The shorter parts are distributed so that both processes take about the same
    time.
    """
    simulated = needs_hand(settings.servos.backend, settings.tactile.backend)
    servos, sensors = settings.servos.backend != "none", settings.tactile.backend != "none"
    wanted = {
        _TABLE: True,
        _ESTIMATOR: sensors,
        _HAND: simulated,
        _SENSOR: settings.tactile.backend == "simulated",
        _FILTER: servos and sensors,
        _GRIP: servos and sensors,
        _JOINTS: True,
    }
    return [part for part, needed in wanted.items() if needed]


def named(name: str) -> Part:
    """Return the part with this name. Raises KeyError if the name is unknown."""
    return {each.name: each for each in ALL}[name]


def is_built(part: Part, settings: Settings) -> bool:
    """Return True if the cache contains ``part`` for this tip type and the current code."""
    folder = kernel_folder()
    return folder is not None and is_marked(folder, _kind(part, settings))


def mark_built(part: Part, settings: Settings) -> None:
    """Mark ``part`` as compiled and cached; do nothing if there is no cache folder."""
    folder = kernel_folder()
    if folder is not None:
        mark(folder, _kind(part, settings))


def _kind(part: Part, settings: Settings) -> str:
    return f"{part.name.replace(' ', '-')}-{settings.tip.physics}"


def warm_up(scene: WantedScene) -> None:
    """Run every part of ``scene``. Raises the same errors as `profile.factory`."""
    for part in parts(scene.settings):
        part.run(scene)
        mark_built(part, scene.settings)


def _table(scene: WantedScene) -> None:
    radius = scene.settings.tip.radius
    for model in scene.models:
        model.table(0.2 * radius, 0.1)


def _estimator(scene: WantedScene) -> None:
    settings = scene.settings
    rows, cols = settings.tactile.rows, settings.tactile.cols
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : cols * 1j]
    counts = np.clip(3e3 - 3e4 * (x**2 + y**2), 0, settings.tactile.full_count).astype(np.uint16)
    law = make_material(settings.material)
    for finger in scene.sensing:
        calibration = calibration_for(settings, finger)
        if calibration is not None:
            Converter(calibration, settings.tactile.pascal_per_count)
        estimator = make_estimator(settings, law, finger, None, calibration)
        estimator.update(counts, settings.tactile.pascal_per_count)
        total_tilt(0.1, 0.1)


def _hand(scene: WantedScene) -> None:
    from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand

    SimulatedHand(scene.settings, 0.0, scene.models[0].table)


def _sensor(scene: WantedScene) -> None:
    from softfinger.daemon.simulation.simulated_tactile import make_sensor_model

    if not scene.sensing:
        return
    settings = scene.settings
    model, depth = make_sensor_model(settings, scene.sensing[0]), 0.1 * settings.tip.radius
    counts = np.empty((settings.tactile.rows, settings.tactile.cols), np.uint16)
    model.frame(depth, 0.1, 0.0, counts)
    if settings.simulation.object_shape == "disc":
        model.frame(depth, 0.1, 0.0, counts, curvature=1.0 / settings.simulation.object_radius)


def _filter(scene: WantedScene) -> None:
    from softfinger.daemon.perception.hand_estimator import HandEstimator

    settings, fingers = scene.settings, scene.sensing
    left, right = scene.models
    estimator = HandEstimator(settings, (left.table, right.table))
    contacts, pose = [Contact(), Contact()], ObjectPose()
    frame = Frame(1, 0.0, 0.0, True, np.zeros((1, 1), np.uint16))
    touch = ContactEstimate(contact=True, invalid=Invalid.NONE, d=1e-3)
    for k in (1, 2):
        estimator.predict(Reading(t=0.01 * k))
        for finger in fingers:
            estimator.update(finger, frame, touch, contacts[finger])
        estimator.write_contacts(0.01 * k, contacts, pose)


def _grip(scene: WantedScene) -> None:
    from softfinger.daemon.control.grip import Grip
    from softfinger.daemon.perception.grasp import GraspState

    fingers, pose, reading = scene.sensing, ObjectPose(), Reading()
    if not fingers:
        return
    grip = Grip(scene.settings, fingers, GraspState())
    grip.start(1.0, 2.0)
    grip.steer(0.0, 0.1)
    grip.begin_holding()
    grip.torques(reading, pose, True)
    grip.hold_goal(reading)


def _joints(scene: WantedScene) -> None:
    from softfinger.daemon.control.setpoint import Setpoint, SetpointState
    from softfinger.daemon.loop.timing import Statistics
    from softfinger.daemon.safety.heat import set_law

    heat = HeatState()
    set_law(heat.law, scene.settings)
    for _ in range(2):
        follow(heat.array, 1.0, 0.5, 25.0)
    time_to_limit(heat.array, 1.0, 70.0)
    Setpoint(1.0 / scene.settings.loop.rate, scene.settings.control.smooth_time, SetpointState())
    Statistics()


def _many(scene: WantedScene) -> None:
    scene.models[0].table(np.zeros(2), np.zeros(2))


_TABLE = Part("contact table", 27, _table)
_ESTIMATOR = Part("estimator", 79, _estimator)
_HAND = Part("simulated hand", 58, _hand, after=_TABLE.name)
_SENSOR = Part("simulated sensor", 14, _sensor)
_FILTER = Part("contact filter", 25, _filter, after=_TABLE.name)
_GRIP = Part("grip", 26, _grip)
_JOINTS = Part("joints and timing", 10, _joints)
_MANY = Part("lookup of many points", 3, _many, after=_TABLE.name)
ALL = (_TABLE, _ESTIMATOR, _HAND, _SENSOR, _FILTER, _GRIP, _JOINTS, _MANY)
EMULATED = (_TABLE, _HAND, _SENSOR)  # parts used by `softfinger emulate`
LANDSCAPE = (_TABLE, _MANY)  # parts used by the energy plot
FRAMES = (_TABLE, _ESTIMATOR, _MANY)  # parts used by frame analysis
