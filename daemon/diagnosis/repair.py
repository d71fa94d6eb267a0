"""What `softfinger doctor --fix` changes, and nothing else: adapters and servos.

The hand lets go where a servo's EEPROM has to be written; nothing is ever stiffened or moved.
"""

from __future__ import annotations

from pathlib import Path

from softfinger.daemon.diagnosis.ports import check_latency_timer, latency_file
from softfinger.daemon.diagnosis.result import Result
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.provisioning import provision


def repair_latency_timer(path: str, sysfs: Path | None = None) -> Result | None:
    """Set the adapter's latency timer to 1 ms; None when there is nothing to do."""
    places = () if sysfs is None else (sysfs,)
    place = latency_file(path, *places)
    found = check_latency_timer(path, 1.0, *places)
    if place is None or found is None or found.status == "pass":
        return None
    subject = f"{path} latency timer"
    try:
        place.write_text("1")
    except OSError as error:
        problem = f"could not be set: {(error.strerror or 'refused').lower()}"
        return Result("warn", subject, problem, f"echo 1 | sudo tee {place}")
    return Result("fixed", subject, "set to 1 ms")


def repair_servos(settings: Settings) -> list[Result]:
    """Set the scene's servos up as the daemon needs them; one line for each thing done."""
    try:
        result = provision(settings)
    except ServoError as error:
        return [Result("warn", "servos", f"not repaired: {error}")]
    problems = [
        Result("warn", each.subject, f"not repaired: {each.problem}", each.fix.replace("`", ""))
        for each in result.problems
    ]
    return problems + [Result("fixed", name, change) for name, change in result.done]
