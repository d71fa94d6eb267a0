"""What the tips of the simulated hand feel, sampled at the instants of the sensors' frames."""

from __future__ import annotations

from softfinger.daemon.simulation.physics.plant_state import (
    CORNERS,
    NO_OBJECT,
    Plant,
    SampleRow,
    TipContact,
)
from softfinger.kinematics.compiled.kernel import inner_kernel
from softfinger.kinematics.compiled.layout import Records


@inner_kernel
def feels_tip(plant: Plant, finger: int) -> bool:
    """Whether a tip feels the other one, which presses more than the object."""
    if not plant.tips_near:
        return False
    stage = plant.stages[0]
    stronger = stage.on_tip[finger].force > stage.on_object[finger].force
    return bool(plant.parameters.shape == NO_OBJECT or stronger)


@inner_kernel
def felt_contact(plant: Plant, finger: int) -> TipContact:
    """The contact that a tip feels."""
    if feels_tip(plant, finger):
        return plant.stages[0].on_tip[finger]
    return plant.stages[0].on_object[finger]


@inner_kernel
def take_sample(plant: Plant, ring: Records[SampleRow]) -> None:
    """Write the sample that is due into ``ring``, between what was felt before and is felt now."""
    p, before = plant.parameters, plant.felt
    due = plant.samples * p.sample_period
    back = min((plant.steps * p.step - due) / p.step, 1.0)
    row = ring[plant.samples % len(ring)]
    row.number = plant.samples
    row.t = due
    for finger in range(2):
        now = felt_contact(plant, finger)
        # Between what is touched before and after there is nothing to interpolate.
        same = feels_tip(plant, finger) == (before.on_other_tip[finger] != 0)
        share = back if same else 0.0
        row.d[finger] = now.d - share * (now.d - before.d[finger])
        row.theta[finger] = now.theta - share * (now.theta - before.theta[finger])
        row.gain[finger] = now.gain - share * (now.gain - before.gain[finger])
        row.bend[finger] = now.bend
        row.tangential[finger] = now.tangential - share * (
            now.tangential - before.tangential[finger]
        )
    plant.samples += 1


@inner_kernel
def settle(plant: Plant, ring: Records[SampleRow]) -> None:
    """Take the samples that are due at the state's instant, then record what the tips feel."""
    p, felt, stage = plant.parameters, plant.felt, plant.stages[0]
    while plant.samples * p.sample_period <= plant.steps * p.step:
        take_sample(plant, ring)
    for finger in range(2):
        plant.state.shear[finger] = stage.on_object[finger].shear
        if plant.tips_near:
            plant.state.extra_shear[CORNERS + finger] = stage.on_tip[finger].shear
        now = felt_contact(plant, finger)
        felt.d[finger] = now.d
        felt.theta[finger] = now.theta
        felt.gain[finger] = now.gain
        felt.force[finger] = now.force
        felt.normal[finger] = now.normal
        felt.tangential[finger] = now.tangential
        felt.rim[finger] = now.rim
        felt.bend[finger] = now.bend
        felt.on_other_tip[finger] = 1 if feels_tip(plant, finger) else 0
