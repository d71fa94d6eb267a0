"""A frame that no contact of the model makes is told, and only warned of."""

from __future__ import annotations

import numpy as np

from softfinger import Fingertip, Material, SensorGrid
from softfinger.daemon.perception.finger_model import make_models
from softfinger.daemon.perception.perception import Perception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.safety import Safety
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import Contact, Frame, Parts, State
from softfinger.daemon.wire.packer import message_maker
from softfinger.daemon.wire.schema import STATE
from softfinger.kinematics.estimation.invalid import Invalid

state_message = message_maker(STATE)


def test_unequal_cells_are_a_misfit_that_is_warned_of_and_published() -> None:
    settings = Settings()
    sensor = GivenFrames()
    perception = Perception(settings, {0: sensor}, make_models(settings))
    grid = SensorGrid(rows=44, cols=44, pitch=0.058 / 44)
    pressure = grid.pressure(Fingertip(0.020), Material.table_i(), 0.005, 0.1, 0.0)
    noise = np.random.default_rng(3)
    state = State(mode="holding", torque=True)
    contact = state.contacts[0]

    def feel(seq: int, spread: float) -> None:
        cells = pressure * noise.normal(1.0, spread, pressure.shape)
        cells += noise.normal(0.0, settings.tactile.noise, cells.shape)
        counts = np.clip(cells / 4.0, 0, 65535).astype(np.uint16)
        sensor.frame = Frame(seq, 0.01 * seq, 0.01 * seq, True, counts)
        state.t = 0.01 * seq
        perception.update(state)

    feel(1, 0.0)
    assert contact.valid
    assert not contact.misfit
    feel(2, 0.3)
    assert contact.valid
    assert contact.misfit
    assert abs(contact.d - 0.005) < 1e-3
    parts = Parts(fingers=(True, False), servos=False, sensors=True)
    assert state_message(state, parts)["left"]["misfit"] is True
    safety = Safety(settings, False, True)
    told: list[tuple[str, str]] = []
    for tick in range(1000):
        state.t = 0.02 + 0.002 * tick
        state.seq += 1
        contact.t_valid = state.t
        state.contacts[1] = Contact(invalid=Invalid.NONE, t_valid=state.t)
        safety.judge(state)
        told += safety.warnings
        safety.warnings.clear()
    assert [name for name, _ in told if name == "tactile.misfit"] == ["tactile.misfit"]
    assert "left tip feels fits no contact" in dict(told)["tactile.misfit"]
