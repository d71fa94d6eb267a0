"""How a stuck tip's shear relaxes: by creep, and by slip that begins at the footprint's edge.

Both are settings and off by default: a tip then sticks or slips as a whole, and forgets nothing.

Micro-slip is what the tip's own springs do when each has Coulomb friction of its own. A spring of
length ℓ(r) = √(a² − r²) is pressed in by w = ℓ − h with the pressure Ew/ℓ, and bears a shear
traction Eu/ℓ when the face has moved by u: it slips where u > μw. All layers w = 0 … d are equally
stiff, since r dr = −ℓ dℓ, so that from rest

    T = 2πE ∫₀^d min(u, μw) dw = μN (1 − (1 − u/μd)²),   N = πEd²

and the whole tip slips at u = μd: an Iwan model with evenly spread limits. Its layers are scaled
with the footprint as that grows; their mean is the tip's d_t, and their variance adds to d_t² in
the tip's energy.
"""

from __future__ import annotations

from softfinger.daemon.simulation.physics.plant_state import ALONG_SHEAR, LAYERS, Plant
from softfinger.kinematics.compiled.kernel import inner_kernel


@inner_kernel
def relax_shears(plant: Plant) -> None:
    """Relax the shears that a sub-step has led to; the contacts are those of where it began."""
    p, state = plant.parameters, plant.state
    for finger in range(2):
        tip, layers = plant.stages[0].on_object[finger], plant.layers[finger]
        stiffness = tip.stiffness[ALONG_SHEAR]
        if stiffness <= 0.0:
            for k in range(LAYERS):
                layers[k] = 0.0
            plant.spread[finger] = 0.0
            continue
        neutral = tip.shear - tip.tangential / stiffness
        shear = state.shear[finger]
        shear += p.creep * (neutral - shear)
        if p.micro_slip:
            limit = 2.0 * p.friction * max(tip.normal, 0.0) / stiffness
            mean = 0.0
            for k in range(LAYERS):
                mean += layers[k] / LAYERS
            brought = shear - mean
            shear = 0.0
            for k in range(LAYERS):
                most = limit * (k + 0.5) / LAYERS
                layers[k] = neutral + min(max(layers[k] + brought - neutral, -most), most)
                shear += layers[k] / LAYERS
            square = 0.0
            for k in range(LAYERS):
                square += (layers[k] - shear) ** 2
            plant.spread[finger] = square / LAYERS
        state.shear[finger] = shear
