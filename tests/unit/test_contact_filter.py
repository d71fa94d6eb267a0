"""The prediction between frames at its beginning: a tip that touches before anything was read."""

from __future__ import annotations

import math

import pytest

from softfinger.daemon.perception.contact_filter import Prediction
from softfinger.daemon.profile.factory import make_material, make_table
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Contact, ObjectPose, Reading

SETTINGS = Settings()


@pytest.fixture
def prediction() -> Prediction:
    table = make_table(SETTINGS, make_material(SETTINGS.material), None)
    return Prediction(SETTINGS, (table, table))


def frame(t: float) -> Contact:
    return Contact(
        seq=1,
        t=t,
        valid=True,
        contact=True,
        d=0.003,
        theta=0.1,
        d_std=5e-5,
        theta_std=5e-3,
        force=4.0,
    )


@pytest.mark.parametrize("read_first", [True, False])
def test_a_tip_that_touches_at_the_start_is_felt_at_once_and_from_then_on(
    prediction: Prediction, read_first: bool
) -> None:
    contacts, pose = [Contact(), Contact()], ObjectPose()
    if read_first:
        prediction.advance(Reading(t=5.0, q=[0.15, 0.15], valid=True))
    # Both frames were sampled before the first reading was taken.
    for k in range(2):
        prediction.correct(0, frame(4.98 + 0.01 * k), contacts[0])
        prediction.fill(contacts, pose)
        assert contacts[0].valid
        assert contacts[0].d == pytest.approx(0.003)
        assert contacts[0].theta == pytest.approx(0.1)
    for k in range(1, 30):
        t = 5.0 + 0.002 * k
        prediction.advance(Reading(t=t, q=[0.15, 0.15], valid=True))
        if k % 5 == 0:
            prediction.correct(0, frame(t - 0.01), contacts[0])
        prediction.fill(contacts, pose)
    contact = contacts[0]
    assert contact.d == pytest.approx(0.003, rel=0.02)
    assert contact.theta == pytest.approx(0.1, rel=0.02)
    assert contact.force > 1.0
    assert math.isfinite(contact.energy + contact.d_std + contact.theta_std)
