"""Check a profile for keys that contradict each other.

Each check is a function that yields one line per problem, with the key, the value found and the
value expected.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from typing import Any

from softfinger.daemon.backends import backend
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, GRIP_FRACTION

_VALUE_LENGTH_MAX = 60  # characters of a value in a message
_DITHER_TICKS_MIN = 8  # minimum ticks per dither period for a usable oscillation
_TCP = re.compile(r"tcp://(127(?:\.\d{1,3}){3}|localhost|\[::1\]):(\d{1,5})")
_ANY_TCP = re.compile(r"tcp://([\w.-]+|\*|\[[0-9a-fA-F:.]+(?:%\w+)?\]):(\d{1,5})")


def problems(settings: Settings) -> list[str]:
    """Return all contradictions between settings, one per line."""
    return [problem for check in _CHECKS for problem in check(settings)]


_SENSOR_WIDTH_MAX = 2.0  # tip diameters; a larger sensor probably belongs to another tip


def sensor_warnings(settings: Settings) -> list[str]:
    """Return warnings about sensors whose size does not match the tips, one per line."""
    tip, tactile = settings.tip, settings.tactile
    if tactile.backend == "none":
        return []
    sides = tactile.cols * tactile.pitch, tactile.rows * (tactile.pitch_y or tactile.pitch)
    size = f"{sides[0] * 1e3:.4g} × {sides[1] * 1e3:.4g} mm"
    doubts = []
    if min(sides) > _SENSOR_WIDTH_MAX * 2.0 * tip.radius:
        doubts.append(
            f"tactile.rows, cols, pitch: found a sensor of {size} for a tip of "
            f"{tip.radius * 2e3:.4g} mm diameter; is it another tip's, or tip.radius wrong?"
        )
    # A solid tip loads the sensor with its whole base, the spring model only with the footprint.
    d = min(settings.safety.d_max, tip.radius)
    reach = tip.radius if tip.physics == "solid" else math.sqrt(d * (2.0 * tip.radius - d))
    half = min(0.5 * side - abs(at) for side, at in zip(sides, tactile.centre, strict=True))
    if half < reach:
        what = "base" if tip.physics == "solid" else f"footprint at {d * 1e3:.3g} mm"
        doubts.append(
            f"tactile.rows, cols, pitch: found a sensor of {size}, smaller than the tip's {what}, "
            f"{reach * 2e3:.3g} mm wide: what is pressed beyond it is not felt"
        )
    return doubts


def shown(value: Any) -> str:
    """Format a value in TOML syntax, shortened to fit a line and without control characters."""
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
    return (
        text if len(text) <= _VALUE_LENGTH_MAX else text[: _VALUE_LENGTH_MAX - 2] + "…" + text[-1]
    )


def _fingers(settings: Settings) -> Iterator[str]:
    fingers = settings.scene.fingers
    if len(set(fingers)) != len(fingers):
        yield f"scene.fingers: found {shown(fingers)}, expected each finger once"


def _backends(settings: Settings) -> Iterator[str]:
    servos, tactile = settings.servos.backend, settings.tactile.backend
    both = f"servos.backend, tactile.backend: found {servos} and {tactile}"
    if servos == tactile == "none":
        yield f"{both}, expected at least one"
    metal = {backend("servos", servos).metal, backend("tactile", tactile).metal}
    if "none" not in (servos, tactile) and len(metal) > 1:
        yield f"{both}, expected both real or both simulated (none takes one out)"


def _joints(settings: Settings) -> Iterator[str]:
    hand = settings.hand
    for index, finger in enumerate(FINGERS):
        low, open_, high = hand.q_min[index], hand.open_angle[index], hand.q_max[index]
        if not low < high:
            yield f"hand.q_max: found {high:g} for {finger}, expected above q_min {low:g}"
        elif not low <= open_ <= high:
            yield f"hand.open_angle: found {open_:g} for {finger}, expected {low:g} to {high:g}"


def _servos(settings: Settings) -> Iterator[str]:
    servos = settings.servos
    if servos.ids[0] == servos.ids[1] and len(settings.scene.fingers) == 2:
        yield f"servos.ids: found {shown(servos.ids)}, expected two different ids"


def _ports(settings: Settings) -> Iterator[str]:
    """Check that each device has its own port. Plugin ports are not checked."""
    ports = []
    servos = backend("servos", settings.servos.backend)
    tactile = backend("tactile", settings.tactile.backend)
    if servos.metal and not servos.source:
        ports.append(("servos.port", settings.servos.port))
    if tactile.metal and not tactile.source:
        for finger in sorted(FINGERS.index(name) for name in settings.scene.fingers):
            ports.append((f"tactile.port ({FINGERS[finger]})", settings.tactile.port[finger]))
    taken: dict[str, str] = {}
    for key, port in ports:
        place = os.path.realpath(port)
        if place in taken:
            same = "" if place == port else f", which leads to {shown(place)}"
            yield (
                f"{key}: found {shown(port)}{same}, expected another port than {taken[place]}; "
                "boards without a serial number of their own have names in /dev/serial/by-path"
            )
        taken.setdefault(place, key)


def _timing(settings: Settings) -> Iterator[str]:
    period = 1.0 / settings.loop.rate
    for key in ("watchdog", "fault_after"):
        value = getattr(settings.servos, key)
        if 0.0 < value <= 2.0 * period:
            yield f"servos.{key}: found {value:g} s, expected above two ticks, {2.0 * period:g} s"


def _measured_tip(settings: Settings) -> Iterator[str]:
    if settings.tip.physics != "measured":
        return
    backend = settings.tactile.backend
    if backend in ("simulated", "none"):
        yield (
            f'tip.physics: found "measured" with tactile.backend = "{backend}", expected "springs" '
            'or "solid": measured curves are of frames that a board sends'
        )
    else:
        file = 'the file of `softfinger calibrate law` with tip.physics = "measured"'
        yield from _missing(settings, "calibration", file)


def _missing(settings: Settings, key: str, expected: str) -> Iterator[str]:
    """Check a string in the tactile settings that must be set for each finger in the scene."""
    for name in settings.scene.fingers:
        if not getattr(settings.tactile, key)[FINGERS.index(name)]:
            yield f'tactile.{key}: found "" for {name}, expected {expected}'


def _too_large(key: str, found: float, unit: str, limit: float, why: str) -> Iterator[str]:
    if found > limit:
        yield f"{key}: found {found:g} {unit}, expected at most {limit:g} {unit}, {why}"


def _solid_tip(settings: Settings) -> Iterator[str]:
    tip, tactile = settings.tip, settings.tactile
    if tip.physics != "solid":
        return
    if settings.material.law != "constant":
        yield f'material.law: found "{settings.material.law}", expected "constant" for a solid tip'
    why = "0.4 of a solid tip's radius"
    yield from _too_large("safety.d_max", settings.safety.d_max, "m", 0.4 * tip.radius, why)
    if tactile.backend == "none":
        return
    why = "a quarter of a solid tip's radius: more of it hides θ"
    blurred = list(_too_large("tactile.blur", tactile.blur, "m", 0.25 * tip.radius, why))
    yield from blurred
    if not [*blurred, *_blur(settings)]:
        yield from _cells_under(settings)


def _cells_under(settings: Settings) -> Iterator[str]:
    """Check that a solid tip's base, which transmits the contact pressure, covers enough cells."""
    from softfinger.daemon.profile.factory import make_grid, make_tip
    from softfinger.kinematics.estimation.error_budget import Uncertainty
    from softfinger.kinematics.estimation.estimator import CELLS_MIN, cells_within_rim

    known = Uncertainty(centre=settings.tactile.centre_error, pitch=settings.tactile.pitch_error)
    cells = cells_within_rim(make_grid(settings), make_tip(settings), known).sum()
    if cells < CELLS_MIN:
        yield (
            f"tactile.pitch, tactile.centre: found {cells} cells well within a solid tip's rim, "
            f"expected at least {CELLS_MIN}"
        )


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
    from softfinger.daemon.profile.factory import law_problem
    from softfinger.kinematics.contact.material import Material

    try:
        law = Material.from_points(material.strain, material.stress)
    except ValueError as error:
        yield f"material.strain, material.stress: {error}"
        return
    problem = law_problem(law, material.force_error_max)
    if problem:
        yield f"material.strain, material.stress: {problem}"


def _wedge(settings: Settings) -> Iterator[str]:
    simulation = settings.simulation
    if simulation.object_shape != "wedge":
        return
    height, width = simulation.object_height, simulation.object_width
    limit = 2.0 * math.atan(width / height)
    if abs(simulation.object_taper) >= limit:
        yield (
            f"simulation.object_taper: found {simulation.object_taper:g} rad, expected less than "
            f"{limit:.3g}, at which this width and height make the faces meet"
        )


def _dither(settings: Settings) -> Iterator[str]:
    control = settings.control
    if control.law != "upright":
        return
    limit = settings.safety.current_max * control.torque_constant
    why = "what safety.current_max gives"
    yield from _too_large("control.dither_torque", control.dither_torque, "N·m", limit, why)
    limit, why = settings.loop.rate / _DITHER_TICKS_MIN, f"{_DITHER_TICKS_MIN} ticks a period"
    yield from _too_large("control.dither_frequency", control.dither_frequency, "Hz", limit, why)


def _cells(settings: Settings) -> Iterator[str]:
    tactile = settings.tactile
    for index, cells in enumerate(tactile.dead):
        for cell in cells:
            if cell[0] >= tactile.rows or cell[1] >= tactile.cols:
                yield (
                    f"tactile.dead: found {shown(cell)} for {FINGERS[index]}, "
                    f"expected a cell of {tactile.rows} × {tactile.cols}"
                )


def _blur(settings: Settings) -> Iterator[str]:
    tactile = settings.tactile
    height = tactile.rows * (tactile.pitch_y or tactile.pitch)
    limit = 0.5 * min(height, tactile.cols * tactile.pitch)
    yield from _too_large("tactile.blur", tactile.blur, "m", limit, "half the sensor")


def _recordings(settings: Settings) -> Iterator[str]:
    if settings.tactile.backend == "replay":
        yield from _missing(settings, "recording", "a recording")


def _clock(settings: Settings) -> Iterator[str]:
    clock = settings.loop.clock
    if clock in ("hand", "virtual") and not settings.simulated:
        yield f'loop.clock: found {shown(clock)}, expected "auto" or "real" with hardware backends'


def _limits(settings: Settings) -> Iterator[str]:
    safety = settings.safety
    if safety.frame_age_hold >= safety.frame_age_fault:
        yield (
            f"safety.frame_age_hold: found {safety.frame_age_hold:g}, "
            f"expected below frame_age_fault, {safety.frame_age_fault:g}"
        )


def _forces(settings: Settings) -> Iterator[str]:
    low, high = settings.control.contact_force, GRIP_FRACTION * settings.safety.force_max
    if low >= high:
        yield (
            f"control.contact_force: found {low:g} N, expected below {GRIP_FRACTION:g} "
            f"safety.force_max, {high:g}"
        )
        return
    forces = [("control.force_default", settings.control.force_default)]
    if settings.task.name != "none":
        forces.append(("task.force", settings.task.force))
    for key, force in forces:
        if not low < force <= high:
            yield f"{key}: found {force:g} N, expected above {low:g} to {high:g}"


def address_problem(address: str, lacking: str) -> str:
    """Return the reason why ``address`` must not be bound, or an empty string if it is allowed.

    Without keys, only this machine's addresses are allowed. ``lacking`` is the name of the missing
    key setting, or empty if keys are configured.
    """
    here = _TCP if lacking else _ANY_TCP
    tcp = here.fullmatch(address)
    path = address.removeprefix("ipc://")
    local = path != address and path.isprintable() and path[:1] not in ("", "@", "*")
    if local or (tcp and 0 < int(tcp[2]) < 65536):
        return ""
    hint = ""
    if lacking and _ANY_TCP.fullmatch(address):
        hint = f"; other addresses need {lacking}, which `softfinger keys` makes"
    return (
        f"found {shown(address)}, expected tcp://127.0.0.1:PORT with a port of 1 to 65535, "
        f"or ipc://PATH{hint}"
    )


def _addresses(settings: Settings) -> Iterator[str]:
    addresses = {
        "stream.address": settings.stream.address,
        "commands.address": settings.commands.address,
    }
    if settings.stream.latest:
        addresses["stream.latest"] = settings.stream.latest
    for key, address in addresses.items():
        problem = address_problem(address, "" if settings.access.keys else "access.keys")
        if problem:
            yield f"{key}: {problem}"
        first = next(other for other in addresses if addresses[other] == address)
        if first != key:
            yield f"{key}: found {shown(address)}, expected another than {first}"


def _folder(settings: Settings) -> Iterator[str]:
    ports = []
    if backend("servos", settings.servos.backend).metal:
        ports.append(("servos.port", settings.servos.port))
    if backend("tactile", settings.tactile.backend).metal:
        ports += [("tactile.port", port) for port in settings.tactile.port]
    for key, port in ports:
        if "{dir}" in port:
            yield f"{key}: found {shown(port)}, expected --dir to say which folder {{dir}} is"


_CHECKS = (
    _fingers,
    _backends,
    _joints,
    _servos,
    _ports,
    _timing,
    _material,
    _solid_tip,
    _measured_tip,
    _wedge,
    _dither,
    _cells,
    _blur,
    _recordings,
    _clock,
    _limits,
    _forces,
    _addresses,
    _folder,
)
