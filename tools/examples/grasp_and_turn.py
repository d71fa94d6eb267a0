"""Grasp an object, rotate it in both directions and plot the recorded states.

The script is divided into notebook cells. Start a daemon with ``softfinger run``. Then run the
whole file with

    python -m softfinger.tools.examples.grasp_and_turn --picture grasp_and_turn.png

Alternatively, run the cells one by one in an editor that supports ``# %%``. The script needs
matplotlib (extra ``plot``).
"""

# %% Settings: hand address, force and angles
from __future__ import annotations

import argparse
import math

import numpy as np
from matplotlib.figure import Figure

from softfinger import Hand, HandState
from softfinger.daemon.client.stream import to_columns
from softfinger.kinematics.contact.closed_form import Fingertip
from softfinger.kinematics.contact.material import Material
from softfinger.kinematics.contact.table import ContactTable

parser = argparse.ArgumentParser()
parser.add_argument("--stream")
parser.add_argument("--commands")
parser.add_argument("--picture", default="grasp_and_turn.png")
where = parser.parse_known_args()[0]  # Ignore the arguments that a notebook kernel adds.

FORCE = 8.0  # N on each tip
ANGLES = (12.0, -12.0, 0.0)  # successive object angles [degrees]
DEGREES = math.degrees(1.0)


# %% Grasp, rotate and release the object, recording every state
def settled(state: HandState) -> bool:
    return state.mode == "holding"


recorded: list[HandState] = []
with Hand(where.stream, where.commands) as hand:
    with hand.stream(hand.timeout) as states:
        recorded.append(next(states))  # Wait for the first state before moving.
        try:
            hand.arm()
            hand.grasp(force=FORCE)
            hand.wait_for(settled)
            for angle in ANGLES:
                hand.rotate(math.radians(angle))
                hand.wait_for(settled)
            hand.release()
            end = hand.wait_for(lambda state: state.mode == "armed")
        finally:
            hand.stop()  # Switch torque off, even after an error.
        for state in states:  # Record the remaining states up to `end`.
            recorded.append(state)
            if state.seq >= end.seq:
                break
    print(f"{len(recorded)} states, {states.lost} lost")

# %% Convert the states to columns, a form that `pandas.DataFrame(columns)` accepts
columns = to_columns(recorded)
t = (columns["mono_ns"] - columns["mono_ns"][0]) * 1e-9
touching = {name: columns[f"{name}.contact"] for name in ("left", "right")}
held = columns["mode"] == "holding"
print(f"force while holding: {columns['left.force'][held].mean():.2f} N, commanded {FORCE:g} N")

# %% Compute the fingertip's energy landscape, and the angle of minimum energy at each depth
tip, material = Fingertip(radius=0.020), Material.table_i()
table = ContactTable.build(tip, material)
deepest = 1.25 * max(columns[f"{name}.d"][touching[name]].max() for name in touching)
d = np.linspace(0.0, deepest, 200)[1:]
theta = np.radians(np.linspace(-35.0, 35.0, 281))
energy = table(d[:, None], theta[None, :]).energy
minimum = theta[np.argmin(energy, axis=1)]

# %% Plot
LOOKS = {"left": ("#0072B2", "-"), "right": ("#D55E00", "--")}
figure = Figure(figsize=(9.0, 4.2), layout="constrained")
panels = figure.subplot_mosaic([["force", "map"], ["angle", "map"]], width_ratios=[1.0, 1.15])
# The levels are denser at low U, because U grows as d³.
levels = 1e3 * energy.max() * np.linspace(0.0, 1.0, 11) ** 2
shown = panels["map"].contourf(
    theta * DEGREES, d * 1e3, energy * 1e3, levels, cmap="Greys", vmax=1.8 * levels[-1]
)
figure.colorbar(shown, ax=panels["map"], label="energy U [mJ]", format="%.1f")
panels["map"].plot(minimum * DEGREES, d * 1e3, "k:", label="local minimum")
for name, (colour, line) in LOOKS.items():
    touched = touching[name]
    force = np.where(touched, columns[f"{name}.force"], np.nan)
    panels["force"].plot(t, force, line, color=colour, label=name)
    path = columns[f"{name}.theta"][touched], columns[f"{name}.d"][touched]
    panels["map"].plot(path[0] * DEGREES, path[1] * 1e3, line, color=colour, label=name)
panels["force"].axhline(FORCE, color="k", linestyle=":", linewidth=1.0, label="commanded")
known = np.where(columns["object.valid"], columns["object.angle"], np.nan)
panels["angle"].plot(t, known * DEGREES, color="#009E73")
for angle in ANGLES:
    panels["angle"].axhline(angle, color="k", linestyle=":", linewidth=1.0)
panels["force"].set(ylabel="force F [N]", ylim=(0.0, 1.45 * FORCE), xlim=(0.0, t[-1]))
panels["angle"].set(ylabel="object's angle [°]", xlabel="time [s]", xlim=(0.0, t[-1]))
panels["map"].set(xlabel="θ [°]", ylabel="displacement d [mm]", ylim=(0.0, deepest * 1e3))
panels["force"].legend(ncols=3, loc="upper center", fontsize="small", frameon=False)
panels["map"].legend(ncols=3, loc="upper center", fontsize="small", framealpha=1.0)
figure.savefig(where.picture, dpi=120)
print(where.picture)
