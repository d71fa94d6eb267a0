"""Run ``softfinger envelope``: determine by simulation which objects a hand can hold.

The objects vary in shape, size, friction and mass.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from softfinger.daemon.control.envelope import (
    GRAVITY,
    HELD,
    LOST,
    OUTCOME_TEXTS,
    REFUSED,
    TURNED,
    identity,
    increased_force_limit,
)
from softfinger.daemon.own_files import write_text
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import add_profile, number, profile
from softfinger.tools.extras import require
from softfinger.tools.processes.compile import build_kernels, print_event
from softfinger.tools.sweep import Sweep, add_sweep

SHAPES = ("rectangle", "disc")
SIZES = (2, 3, 4, 5, 6, 8, 10, 15, 20, 30, 40, 60, 90)  # width or diameter [mm]
FRICTIONS = (0.2, 0.4, 0.6, 0.8)
MASSES = (0.05, 0.2, 0.5, 1.0, 2.0)  # kg
_SETTLING_TIME = 3.0  # settling time of the grip [s]
_LOAD_TIME = 1.0  # duration of the weight ramp [s]
_OBSERVATION_TIME = 1.0  # observation time under the full weight [s]
_LOAD_STEP_COUNT = 20  # number of steps in the weight ramp
_TURN_MIN = math.radians(5.0)
_SLIDE_MAX = 0.010  # displacement above which the object counts as lost [m]
_COLOURS = {HELD: "#009E73", TURNED: "#E69F00", LOST: "#D55E00", REFUSED: "#777777"}


class Cell(NamedTuple):
    """Result of one grasp."""

    outcome: str  # key in OUTCOME_TEXTS
    turned: float  # maximum object rotation [rad]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the ``envelope`` arguments."""
    add_profile(parser)
    force = number("a force above 0 N", 0.0)
    parser.add_argument(
        "--force", type=force, default=10.0, metavar="N", help="grip force (default: 10)"
    )
    parser.add_argument("--shape", choices=SHAPES, action="append", help="only these shapes")
    for name, metavar, what, low, high in (
        ("--size", "MM", "a size of 0.2 to 10000 mm", 0.2, 1e4),
        ("--friction", "F", "a friction coefficient of 1e-5 to 1e5", 1e-5, 1e5),
        ("--mass", "KG", "a mass of 1e-5 to 1e5 kg", 1e-5, 1e5),
    ):
        kind = number(what, low, high, includes_low=True)
        parser.add_argument(name, type=kind, nargs="+", metavar=metavar, help="only these values")
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="FILE",
        help="write the map to a file that `grasp` can use; after an interruption by Ctrl-C, the "
        "same command resumes the run",
    )
    parser.add_argument(
        "--plot",
        type=_picture,
        metavar="FILE",
        help="plot the map to a PNG, SVG or PDF file (extra 'plot')",
    )
    add_sweep(parser)


def _picture(text: str) -> Path:
    path = Path(text)
    if path.suffix not in (".png", ".svg", ".pdf") or not path.parent.is_dir():
        raise argparse.ArgumentTypeError(
            f"expected a name ending in .png, .svg or .pdf in an existing folder, found {text!r}"
        )
    return path


def run(arguments: argparse.Namespace) -> int:
    """Simulate all grasps, print the map and write the requested files.

    Raises SettingsError, SweepError, MissingExtra or OSError.
    """
    settings = profile(arguments)
    if arguments.plot:
        require("plot")
    shapes = tuple(dict.fromkeys(arguments.shape or SHAPES))
    axes = (
        tuple(sorted(set(arguments.friction or FRICTIONS))),
        tuple(sorted(set(arguments.mass or MASSES))),  # The axes of the map must be sorted.
        tuple(sorted(set(arguments.size or SIZES))),
    )
    print(
        f"{arguments.force:g} N; " + "; ".join(f"{k}: {text}" for k, text in OUTCOME_TEXTS.items())
    )
    found: dict[str, list[list[Cell]]] = {shape: [] for shape in shapes}
    frictions, masses, sizes = axes
    build_kernels(settings, print_event)
    keep: Path | None = arguments.keep
    journal = None if keep is None else keep.with_name(keep.name + ".part")
    work = partial(grasped, settings.model_dump(exclude_unset=True), arguments.force)
    grasps = Sweep("envelope", work, list(itertools.product(shapes, *axes)), journal)
    results = grasps.run(arguments.processes, arguments.scheduler)
    for shape, friction, mass in itertools.product(shapes, frictions, masses):
        if not found[shape]:
            print(f"\n{shape}, width [mm]:".ljust(28) + "".join(f"{each:>5g}" for each in sizes))
        row = [Cell(*next(results)) for _ in sizes]
        found[shape].append(row)
        cells = "".join(f"{cell.outcome:>5}" for cell in row)
        print(f"friction {friction:g}, {mass:g} kg".ljust(27) + cells, flush=True)
    if keep is not None and journal is not None:
        _keep(keep, settings, arguments.force, axes, found)
        journal.unlink()
    if arguments.plot:
        _draw(arguments.plot, arguments.force, axes, found)
    return 0


def grasped(sections: dict[str, Any], force: float, case: tuple[str, float, float, float]) -> Cell:
    """Grasp an object on the table, then apply a force equal to its weight, away from the palm.

    ``sections`` are the settings of the hand. ``case`` contains the object's shape, friction,
    mass [kg], and width or diameter [mm]. The daemon's settings contain all of these values except
    the shape; the daemon assumes a block.
    """
    from softfinger.tools.simulated_daemon import SimulatedDaemon

    settings = Settings.model_validate(sections)
    shape, friction, mass, millimetres = case
    size, weight = 1e-3 * millimetres, mass * GRAVITY
    changes: dict[str, dict[str, Any]] = {
        "simulation": {
            "object_shape": shape,
            "object_width": size,
            "object_radius": 0.5 * size,
            "object_mass": mass,
            "tip_friction": friction,
        },
        "object": {"width": size, "width_min": min(settings.object.width_min, 0.25 * size)},
        "control": {"tip_friction": friction, "object_load": weight},
    }
    changed = {name: sections.get(name, {}) | values for name, values in changes.items()}
    with SimulatedDaemon(sections | changed) as hand:
        hand.grasp(force)
        angle = float(hand.plant.object_pose[2])
        hand.run(_SETTLING_TIME)
        if hand.mode != "holding":
            return Cell(REFUSED, math.nan)
        before = hand.plant.object_pose.copy()
        # Table friction opposes the load, so add the friction to the load.
        pull = weight * (1.0 + settings.simulation.table_friction)
        for k in range(_LOAD_STEP_COUNT):
            load, phi = pull * (k + 1) / _LOAD_STEP_COUNT, float(hand.plant.object_pose[2])
            hand.plant.apply_load(-load * math.sin(phi), load * math.cos(phi))
            hand.run(_LOAD_TIME / _LOAD_STEP_COUNT)
        hand.run(_OBSERVATION_TIME)
        shifted = math.dist(hand.plant.object_pose[:2], before[:2])
        if hand.mode != "holding" or shifted > _SLIDE_MAX:
            return Cell(LOST, math.nan)
        turned = abs(float(hand.plant.object_pose[2]) - angle)
        return Cell(TURNED if turned > _TURN_MIN else HELD, turned)


def _keep(
    path: Path,
    settings: Settings,
    force: float,
    axes: tuple[tuple[float, ...], ...],
    found: dict[str, list[list[Cell]]],
) -> None:
    frictions, masses, sizes = axes
    lines = [
        "# Objects that the hand holds. `softfinger envelope --keep` writes this file.",
        "# Each row is for one friction and mass, and each letter is for one size:",
        *(f"# {letter}: {text}" for letter, text in OUTCOME_TEXTS.items()),
        f"force = {force!r}",
        f"raised = {increased_force_limit(settings, force)!r}",
        f"friction = {json.dumps([float(each) for each in frictions])}",
        f"mass = {json.dumps([float(each) for each in masses])}",
        f"size = {json.dumps([round(1e-3 * each, 6) for each in sizes])}",
        f"shapes = {json.dumps(list(found))}",
    ]
    for shape, rows in found.items():
        texts = ",\n".join(f'    "{"".join(cell.outcome for cell in row)}"' for row in rows)
        lines.append(f"{shape} = [\n{texts},\n]")
    for name, section in identity(settings).items():
        lines += [f"[identity.{name}]"]
        lines += [f"{key} = {json.dumps(value)}" for key, value in section.items()]
    with write_text(path) as file:
        file.write("\n".join(lines) + "\n")


def _draw(
    path: Path,
    force: float,
    axes: tuple[tuple[float, ...], ...],
    found: dict[str, list[list[Cell]]],
) -> None:
    import numpy as np

    from softfinger.tools import style

    frictions, masses, sizes = axes
    with style.settings():
        figure = style.new_figure(1.0 + 0.28 * len(sizes) * len(found), 1.2 + 1.2 * len(frictions))
        figure.suptitle(f"Objects held with {force:g} N", fontsize=10)
        grid = figure.subplots(len(frictions), len(found), squeeze=False, sharex=True, sharey=True)
        for (k, i), axes_ in np.ndenumerate(grid):
            shape = list(found)[i]
            axes_.set_title(f"{shape}, friction {frictions[k]:g}", loc="left")
            axes_.grid(visible=False)
            for j in range(len(masses)):
                for x, cell in enumerate(found[shape][k * len(masses) + j]):
                    axes_.barh(j, 0.94, 0.92, x - 0.47, color=_COLOURS[cell.outcome])
                    if cell.turned > _TURN_MIN:
                        text = f"{math.degrees(cell.turned):.0f}°"
                        axes_.text(x, j, text, ha="center", va="center", fontsize=6)
            axes_.set(yticks=range(len(masses)), yticklabels=[f"{each:g} kg" for each in masses])
            axes_.set(xticks=range(len(sizes)), xticklabels=[f"{each:g}" for each in sizes])
            if k == len(frictions) - 1:
                axes_.set_xlabel("width or diameter [mm]")
        for outcome, colour in _COLOURS.items():
            grid[0, 0].barh([0], [0], color=colour, label=OUTCOME_TEXTS[outcome])
        figure.legend(loc="outside lower center", ncols=2)
        style.save(figure, path)
