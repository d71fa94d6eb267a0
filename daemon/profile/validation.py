"""Check a profile for settings that contradict each other.

Each check yields one line per problem. A line contains the key, the value found and the expected
value.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from typing import Any

from softfinger.daemon.backends import backend, servo_model
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, GRIP_FRACTION

_VALUE_LENGTH_MAX = 60  # maximum length of a value in a message [characters]
_DITHER_TICKS_MIN = 8  # minimum number of ticks per dither period
# Maximum sensor width in tip diameters. A larger sensor probably belongs to a different tip.
_SENSOR_WIDTH_MAX = 2.0
_TCP = re.compile(r"tcp://(127(?:\.\d{1,3}){3}|localhost|\[::1\]):(\d{1,5})")
_ANY_TCP = re.compile(r"tcp://([\w.-]+|\*|\[[0-9a-fA-F:.]+(?:%\w+)?\]):(\d{1,5})")


def problems(settings: Settings) -> list[str]:
    """Return all contradictions between settings, one per line."""
    return [problem for check in _CHECKS for problem in check(settings)]


def plausibility_warnings(settings: Settings) -> list[str]:
    """Return warnings about settings that are allowed but probably wrong, one per line.

    The warnings are reported by the commands ``run``, ``doctor`` and ``config check``.
    """
    checks = sensor_warnings, _deep_grip, _strong_grip, _weak_approach
    return [text for check in checks for text in check(settings)]


def sensor_warnings(settings: Settings) -> Iterator[str]:
    """Yield warnings about sensors whose size does not suit the tips.

    A solid tip loads the sensor with its whole base. A spring tip loads only the footprint.
    """
    radius, tactile = settings.tip.radius, settings.tactile
    if tactile.backend == "none":
        return
    sides = _sides(settings)
    size = " × ".join(f"{1e3 * side:.4g}" for side in sides)
    if min(sides) > _SENSOR_WIDTH_MAX * 2.0 * radius:
        yield (
            f"tactile.rows, cols, pitch: found a sensor area of {size} mm for a tip with a "
            f"diameter of {radius * 2e3:.4g} mm: check these settings and tip.radius"
        )
    reaches = [("base", radius)]
    if settings.tip.physics != "solid":
        d_max = settings.safety.d_max
        depths = [(f"{key} = {force:g} N", d) for key, force, d in _set_depths(settings)]
        reaches = []
        for key, depth in (*depths, (f"safety.d_max = {d_max * 1e3:.3g} mm", d_max)):
            d = min(depth, radius)
            reaches.append((f"footprint at {key}", math.sqrt(d * (2.0 * radius - d))))
    half = min(0.5 * side - abs(at) for side, at in zip(sides, tactile.centre, strict=True))
    for part, reach in reaches:
        if half < reach:
            yield (
                f"tactile.rows, cols, pitch: found a sensor area of {size} mm, but the tip's "
                f"{part} is {reach * 2e3:.3g} mm wide with tip.radius = {radius * 1e3:.3g} mm: the "
                "pressure outside the sensor is not measured; use a larger sensor or a lower force"
            )
            return


def _deep_grip(settings: Settings) -> Iterator[str]:
    for key, force, d in _set_depths(settings):
        if d > settings.safety.d_max:
            yield (
                f"{key}: found {force:g} N, which compresses the tip by {d * 1e3:.3g} mm; "
                f"safety.d_max allows at most {settings.safety.d_max * 1e3:.3g} mm"
            )


def _strong_grip(settings: Settings) -> Iterator[str]:
    """Compare the configured forces with the fingertip force that the servo torque can produce."""
    servos, lever = settings.servos, settings.hand.finger_length
    if servos.backend == "none" or backend("servos", servos.backend).source:
        return
    force = GRIP_FRACTION * settings.safety.force_max
    stall = servos.gear_ratio * servo_model(servos.model).stall[0] / lever
    if force > stall:
        yield (
            f"safety.force_max: found {settings.safety.force_max:g} N, which allows a grip force "
            f"of {force:.3g} N, but the stall torque of {servos.model} limits the force of this "
            f"finger to {stall:.2g} N; reduce safety.force_max and safety.current_max"
        )
    bound = settings.control.torque_constant * settings.safety.current_max / lever
    for key, force in _set_forces(settings):
        if force > bound:
            yield (
                f"{key}: found {force:g} N, expected at most {bound:.3g} N, the force at "
                f"safety.current_max = {settings.safety.current_max:g} A on this finger"
            )


def _weak_approach(settings: Settings) -> Iterator[str]:
    """Compare the joint torque during the approach with the joint friction."""
    control = settings.control
    torque = control.approach_current * control.torque_constant
    if settings.servos.backend != "none" and torque <= control.joint_friction:
        yield (
            f"control.approach_current: found {control.approach_current:g} A ({torque:.3g} N·m), "
            f"expected a torque above control.joint_friction = {control.joint_friction:g} N·m; "
            "increase it, otherwise the fingers cannot close"
        )


def _set_forces(settings: Settings) -> list[tuple[str, float]]:
    """Return the keys and values [N] of the default grip forces."""
    forces = [("control.force_default", settings.control.force_default)]
    if settings.task.name != "none":
        forces.append(("task.force", settings.task.force))
    return forces


def _set_depths(settings: Settings) -> Iterator[tuple[str, float, float]]:
    """Yield the key, force [N] and displacement [m] of a spring tip for each configured force.

    The tip is assumed to be upright. The force is computed as in `Material.force_error`, by summing
    over strain steps.
    """
    if settings.tip.physics != "springs":
        return
    import numpy as np

    from softfinger.daemon.profile.factory import make_material

    try:
        law = make_material(settings.material)
    except SettingsError:  # `_material` reports the error.
        return
    strain = np.linspace(0.0, 0.99, 1000)
    weighted = law.stress(strain) / (1.0 - strain) ** 3
    height = settings.tip.radius * (1.0 - strain)
    forces = 2.0 * math.pi * height**2 * np.cumsum(weighted) * strain[1]
    for key, force in _set_forces(settings):
        yield key, force, settings.tip.radius * float(np.interp(force, forces, strain))


def _sides(settings: Settings) -> tuple[float, float]:
    """Return the width and the height of the sensor [m]."""
    tactile = settings.tactile
    return tactile.cols * tactile.pitches[0], tactile.rows * tactile.pitches[1]


def shown(value: Any) -> str:
    """Format a value in TOML syntax, shorten the text and replace control characters."""
    if isinstance(value, tuple):
        text = "[" + ", ".join(shown(item) for item in value[:20]) + "]"
    elif isinstance(value, dict):
        text = "a table"
    elif isinstance(value, bool):
        text = str(value).lower()
    elif isinstance(value, str):
        text = '"' + "".join(each if each.isprintable() else "?" for each in value) + '"'
    else:
        text = str(value)
    if len(text) > _VALUE_LENGTH_MAX:
        return text[: _VALUE_LENGTH_MAX - 2] + "…" + text[-1]
    return text


def _scene(settings: Settings) -> Iterator[str]:
    fingers = settings.scene.fingers
    if len(set(fingers)) != len(fingers):
        yield f"scene.fingers: found {shown(fingers)}, expected each finger once"
    servos, tactile = settings.servos.backend, settings.tactile.backend
    both = f"servos.backend, tactile.backend: found {servos} and {tactile}"
    if servos == tactile == "none":
        yield f"{both}, expected at least one"
    metal = {backend("servos", servos).metal, backend("tactile", tactile).metal}
    if "none" not in (servos, tactile) and len(metal) > 1:
        yield f'{both}, expected both real or both simulated, or "none" for one of them'


def _joints(settings: Settings) -> Iterator[str]:
    hand = settings.hand
    for index, finger in enumerate(FINGERS):
        low, open_, high = hand.q_min[index], hand.open_angle[index], hand.q_max[index]
        if not low < high:
            yield f"hand.q_max: found {high:g} for {finger}, expected more than q_min = {low:g}"
        elif not low <= open_ <= high:
            yield f"hand.open_angle: found {open_:g} for {finger}, expected {low:g} to {high:g}"


def _servos(settings: Settings) -> Iterator[str]:
    servos, period = settings.servos, 1.0 / settings.loop.rate
    if servos.ids[0] == servos.ids[1] and len(settings.scene.fingers) == 2:
        yield f"servos.ids: found {shown(servos.ids)}, expected two different IDs"
    for key in ("watchdog", "fault_after"):
        value = getattr(servos, key)
        if 0.0 < value <= 2.0 * period:
            yield (
                f"servos.{key}: found {value:g} s, expected more than {2.0 * period:g} s, the "
                "duration of two ticks"
            )


def _ports(settings: Settings) -> Iterator[str]:
    """Check that each device has its own port. The ports of plugins may be equal."""
    taken: dict[str, str] = {}
    for key, port in settings.ports(plugins=False):
        place = os.path.realpath(port)
        if place in taken:
            same = "" if place == port else f", a link to {shown(place)}"
            yield (
                f"{key}: found {shown(port)}{same}, expected a port other than {taken[place]}; if "
                "the boards have no serial numbers, use their names in /dev/serial/by-path"
            )
        taken.setdefault(place, key)
    for key, port in settings.ports():
        if "{dir}" in port:
            yield f"{key}: found {shown(port)}, but {{dir}} is not set; pass the folder with --dir"


def _material(settings: Settings) -> Iterator[str]:
    material = settings.material
    if material.law != "points":
        return
    if len(material.strain) != len(material.stress):
        yield (
            f"material.stress: found {len(material.stress)} numbers, "
            f"expected {len(material.strain)} as in material.strain"
        )
        return
    from softfinger.daemon.profile.factory import law_problem, make_material

    try:
        law = make_material(material)
    except SettingsError as error:
        yield str(error)
        return
    if problem := law_problem(law, material.force_error_max):
        yield f"material.strain, material.stress: {problem}"


def _tip(settings: Settings) -> Iterator[str]:
    tip, tactile, d_max = settings.tip, settings.tactile, settings.safety.d_max
    yield from _too_large("safety.d_max", d_max, "m", tip.radius, "the tip's radius")
    if tip.physics == "solid":
        law = settings.material.law
        if law != "constant":
            yield f'material.law: found "{law}", expected "constant" for a solid tip'
        why = "0.4 times the radius of a solid tip"
        yield from _too_large("safety.d_max", d_max, "m", 0.4 * tip.radius, why)
        if tactile.backend != "none":
            yield from _solid_tip_sensor(settings)
    elif tip.physics == "measured":
        if tactile.backend in ("simulated", "none"):
            yield (
                f'tip.physics: found "measured" with tactile.backend = "{tactile.backend}", '
                'expected "springs" or "solid": measured curves require the frames of a physical '
                "board"
            )
        else:
            file = 'a file created by `softfinger calibrate law`, because tip.physics is "measured"'
            yield from _missing(settings, "calibration", file)


def _too_large(key: str, found: float, unit: str, limit: float, why: str) -> Iterator[str]:
    if found > limit:
        yield f"{key}: found {found:g} {unit}, expected at most {limit:g} {unit}, {why}"


def _missing(settings: Settings, key: str, expected: str) -> Iterator[str]:
    """Check that a tactile setting contains a string for each finger in the scene."""
    for name in settings.scene.fingers:
        if not getattr(settings.tactile, key)[FINGERS.index(name)]:
            yield f'tactile.{key}: found "" for {name}, expected {expected}'


def _solid_tip_sensor(settings: Settings) -> Iterator[str]:
    """Check the blur and the number of cells under the base of a solid tip."""
    tactile, radius = settings.tactile, settings.tip.radius
    why = "a quarter of a solid tip's radius, because θ can't be measured with more blur"
    blurred = list(_too_large("tactile.blur", tactile.blur, "m", 0.25 * radius, why))
    yield from blurred
    if blurred or list(_blur(settings)):
        return
    from softfinger.daemon.profile.factory import make_grid, make_tip
    from softfinger.kinematics.estimation.error_budget import Uncertainty
    from softfinger.kinematics.estimation.estimator import cells_within_rim
    from softfinger.kinematics.estimation.gauss_newton import CELLS_MIN

    known = Uncertainty(centre=tactile.centre_error, pitch=tactile.pitch_error)
    cells = cells_within_rim(make_grid(settings), make_tip(settings), known).sum()
    if cells < CELLS_MIN:
        yield (
            f"tactile.pitch, tactile.centre: found {cells} cells inside a solid tip's rim, "
            f"expected at least {CELLS_MIN}"
        )


def _blur(settings: Settings) -> Iterator[str]:
    limit, why = 0.5 * min(_sides(settings)), "half of the sensor's shorter side"
    yield from _too_large("tactile.blur", settings.tactile.blur, "m", limit, why)


def _tactile(settings: Settings) -> Iterator[str]:
    tactile = settings.tactile
    for name, cells in zip(FINGERS, tactile.dead, strict=True):
        for cell in cells:
            if cell[0] >= tactile.rows or cell[1] >= tactile.cols:
                yield (
                    f"tactile.dead: found {shown(cell)} for {name}, expected a cell in "
                    f"the grid of {tactile.rows} × {tactile.cols} cells"
                )
        if len(set(cells)) >= tactile.rows * tactile.cols:
            yield f"tactile.dead: found all cells for {name}, expected at least one working cell"
    yield from _blur(settings)
    if tactile.backend == "replay":
        yield from _missing(settings, "recording", "the path of a recording")


def _loop(settings: Settings) -> Iterator[str]:
    clock = settings.loop.clock
    if clock in ("hand", "virtual") and not settings.simulated:
        yield f'loop.clock: found {shown(clock)}, expected "auto" or "real" with hardware backends'
    safety = settings.safety
    if safety.frame_age_hold >= safety.frame_age_fault:
        yield (
            f"safety.frame_age_hold: found {safety.frame_age_hold:g}, expected less than "
            f"safety.frame_age_fault = {safety.frame_age_fault:g}"
        )


def _control(settings: Settings) -> Iterator[str]:
    control = settings.control
    if control.law == "upright":
        limit, why = (
            settings.safety.current_max * control.torque_constant,
            "the torque at safety.current_max",
        )
        yield from _too_large("control.dither_torque", control.dither_torque, "N·m", limit, why)
        limit, why = (
            settings.loop.rate / _DITHER_TICKS_MIN,
            f"which is {_DITHER_TICKS_MIN} ticks per period",
        )
        yield from _too_large(
            "control.dither_frequency", control.dither_frequency, "Hz", limit, why
        )
    low, high = control.contact_force, GRIP_FRACTION * settings.safety.force_max
    if low >= high:
        yield (
            f"control.contact_force: found {low:g} N, expected less than {GRIP_FRACTION:g} × "
            f"safety.force_max = {high:g} N"
        )
        return
    for key, force in _set_forces(settings):
        if not low < force <= high:
            yield f"{key}: found {force:g} N, expected more than {low:g} N and at most {high:g} N"


def _simulation(settings: Settings) -> Iterator[str]:
    simulation = settings.simulation
    limit = 2.0 * math.atan(simulation.object_width / simulation.object_height)
    if simulation.object_shape == "wedge" and abs(simulation.object_taper) >= limit:
        yield (
            f"simulation.object_taper: found {simulation.object_taper:g} rad, expected less than "
            f"{limit:.3g} rad: at that angle, the faces of an object of this size would meet"
        )


def address_problem(address: str, lacking: str) -> str:
    """Return the reason for rejecting ``address``, or "" if the address is allowed.

    Without keys, only this machine's addresses are allowed. ``lacking`` is the name of the setting
    that must specify keys, or "" if keys are configured.
    """
    here = _TCP if lacking else _ANY_TCP
    tcp = here.fullmatch(address)
    path = address.removeprefix("ipc://")
    local = path != address and path.isprintable() and path[:1] not in ("", "@", "*")
    if local or (tcp and 0 < int(tcp[2]) < 65536):
        return ""
    hint = ""
    if lacking and _ANY_TCP.fullmatch(address):
        hint = f"; other addresses require {lacking}, which `softfinger keys` creates"
    return (
        f"found {shown(address)}, expected tcp://127.0.0.1:PORT with a port of 1 to 65535, "
        f"or ipc://PATH{hint}"
    )


def _addresses(settings: Settings) -> Iterator[str]:
    addresses = settings.addresses()
    for key, address in addresses.items():
        problem = address_problem(address, "" if settings.access.keys else "access.keys")
        if problem:
            yield f"{key}: {problem}"
        first = next(other for other in addresses if addresses[other] == address)
        if first != key:
            yield f"{key}: found {shown(address)}, expected an address other than {first}"


_CHECKS = (
    _scene,
    _joints,
    _servos,
    _ports,
    _material,
    _tip,
    _tactile,
    _loop,
    _control,
    _simulation,
    _addresses,
)
