"""Table of all kinds of events with their levels, causes and remedies.

The documentation page of events is generated from this table. Kinds with a dot are rows of
`safety.limits`, which defines the checks.
"""

from __future__ import annotations

from typing import NamedTuple


class EventKind(NamedTuple):
    """One kind of ``hand/event`` or of a line in the daemon's log."""

    levels: str  # info, warning, error; a fault is an error that turns torque off
    cause: str
    remedy: str = ""  # empty if no action is needed


_CALIBRATE_JOINTS = "Calibrate the joints: `softfinger calibrate joints my.toml`."
_BUSY = "Find out what else uses the processors; see `[realtime]`."
_CHECK_SENSOR = "Check the sensor's mounting; tare it and calibrate it again."

KINDS: dict[str, EventKind] = {
    # The daemon
    "start": EventKind("info", "The daemon is starting, or runs and accepts commands."),
    "end": EventKind(
        "info, error",
        "The daemon has ended. The error says that the servos did not confirm torque off.",
        "After the error, switch off the servos' supply.",
    ),
    "mode": EventKind("info", "The mode has changed; the text shows the old and the new one."),
    "compile": EventKind(
        "info, warning",
        "Kernels are being compiled; the warning says why some were not compiled ahead.",
        "Run `softfinger compile` once; the text of a warning names the cause.",
    ),
    "calibration": EventKind("info", "A calibration file was loaded; the text summarises it."),
    "material": EventKind(
        "info",
        "The smooth law of the material deviates by this much from the measured points.",
        "Remove outliers among the points, or measure more of them.",
    ),
    "realtime": EventKind(
        "info, warning",
        "Real-time measures were granted. The warning names one that the system refused.",
        "The text names the command that grants it; or disable the measure in `[realtime]`.",
    ),
    "late": EventKind(
        "warning", "Ticks came late, or a simulated hand waited: the machine is busy.", _BUSY
    ),
    "loop.overruns": EventKind(
        "error",
        "Too many ticks in a row took longer than their period.",
        f"Lower `loop.rate`. {_BUSY}",
    ),
    "clients": EventKind(
        "warning",
        "The process that serves clients ended, was stopped or rejected somebody.",
        "It is started again by itself. If the event returns, look for a client that floods it.",
    ),
    "record": EventKind(
        "error", "The recorder of `run --record` ended.", "Check the disk's free space."
    ),
    # Commands and grips
    "grasp": EventKind(
        "warning",
        "Nothing was grasped, or the object is outside the range that the hand can hold.",
        "Place the object between the tips; check `object.width_min` and `softfinger envelope`.",
    ),
    "rotate": EventKind(
        "warning",
        "A rotation that waited for the grip was dropped.",
        "Grasp again, then send the rotation while the hand holds.",
    ),
    "short": EventKind(
        "warning",
        "A joint stopped before its goal.",
        "Remove what blocks it; check `control.joint_friction` and `safety.current_move`.",
    ),
    "lost": EventKind(
        "warning",
        "Both tips no longer touch the object; the joints hold their position.",
        "Release and grasp again, with more force if the object slipped.",
    ),
    "slip": EventKind(
        "warning",
        "The object slips or turns, or the grip force was increased or a turn ended to prevent it.",
        "Grasp with more force; check `control.tip_friction` and `control.object_load`.",
    ),
    "grip.slip": EventKind(
        "warning",
        "The tangential force is near the friction limit.",
        "Grasp with more force, or reduce the load.",
    ),
    "silence": EventKind(
        "warning",
        "The client in control fell silent; `commands.on_silence` was carried out.",
        "Let the client send commands or setpoints more often than `commands.lease`.",
    ),
    "task": EventKind(
        "warning",
        "The task of the profile ended or began again; the text gives the reason.",
        "Clear a fault, arm the hand and start the daemon or the demo again.",
    ),
    # Servos
    "servos": EventKind(
        "info, warning",
        "The servos were connected again. The warning states what was found when connecting.",
        "`softfinger doctor --fix` corrects most findings.",
    ),
    "servos.bus": EventKind(
        "error",
        "The port disappeared, or a servo stopped by its watchdog or does not obey.",
        "Check cable and adapter, then `softfinger send clear`.",
    ),
    "servos.silent": EventKind(
        "warning, error",
        "No valid reading arrived within `servos.fault_after`. The warning, also while disarmed, "
        "says that most readings of the last second failed.",
        "`softfinger doctor` times the servos' replies, and checks supply and cables.",
    ),
    "servos.frozen": EventKind(
        "error", "A servo repeats old readings.", "Switch its supply off and on; check the cable."
    ),
    "servos.alert": EventKind(
        "error",
        "A servo reports a hardware error, such as overload, heat or voltage.",
        "Remove the cause; `softfinger doctor --fix` reboots the servo.",
    ),
    "servos.heat": EventKind(
        "warning, error",
        "A servo will soon reach its temperature limit; the grip is eased if the load allows.",
        "Grasp with less force, or pause. `safety.heat_action` decides what happens otherwise.",
    ),
    "servos.temperature": EventKind(
        "error", "A servo is above `safety.temperature_max`.", "Let it cool; grasp with less force."
    ),
    "servos.voltage": EventKind(
        "error",
        "A servo's supply voltage is out of range.",
        "Measure the supply at the servo while it grips; use thicker cables.",
    ),
    "goal.lost": EventKind(
        "error",
        "A servo does not receive the goals that are sent to it.",
        "Check the cable; lower `servos.baud`.",
    ),
    "goal.number": EventKind(
        "error",
        "The controller computed a goal that is not a finite number; it was not sent.",
        "Report it with a recording.",
    ),
    "torque.off": EventKind(
        "error, info",
        "The servos have not confirmed torque off. The info says that they have now.",
        "Switch off their supply, then find out why they do not answer.",
    ),
    # Joints
    "joint.angle": EventKind(
        "error",
        "A joint is outside `hand.q_min` and `hand.q_max`.",
        f"Turn it back by hand. {_CALIBRATE_JOINTS}",
    ),
    "joint.velocity": EventKind(
        "error", "A joint is too fast.", "Something pushed it, or the control gains are too high."
    ),
    "joint.jump": EventKind(
        "error",
        "A joint's angle changed more than its velocity allows.",
        "Check encoder and cable of the servo.",
    ),
    "joint.dead": EventKind(
        "error",
        "A joint does not move towards its goal and takes no current.",
        "Check encoder, current sensor and motor of the servo.",
    ),
    "joint.current": EventKind(
        "error",
        "A joint takes more current than `safety.current_fault`.",
        "Look for a blocked joint or a short circuit.",
    ),
    "joint.stall": EventKind(
        "error",
        "A joint stands off its goal at the highest current.",
        f"Remove what blocks it. {_CALIBRATE_JOINTS}",
    ),
    "joint.swapped": EventKind(
        "error",
        "One finger's joint moves the other finger's tip, or an object turns against its command.",
        f"Swap `servos.ids`, with `zero` and `direction`. {_CALIBRATE_JOINTS}",
    ),
    "joint.blocked": EventKind(
        "warning",
        "A joint stands in the approach with all its current, and its tip feels nothing.",
        f"Remove what blocks it, or correct `servos.direction`. {_CALIBRATE_JOINTS}",
    ),
    "joint.strained": EventKind(
        "warning",
        "A grip needs all the current that is allowed.",
        "Grasp with less force, or raise `safety.current_max`.",
    ),
    # Tips and sensors
    "tip.force": EventKind(
        "warning, error",
        "A tip's force is near or above `safety.force_max`.",
        "Grasp with less force; check the calibration if the force is wrong.",
    ),
    "tip.displacement": EventKind(
        "warning, error",
        "A tip's displacement is near or above `safety.d_max`.",
        "Grasp with less force.",
    ),
    "tip.tilt": EventKind(
        "warning, error",
        "The object is tilted nearly as far as the contact model is valid, or further.",
        "Turn it back, or grasp with less force.",
    ),
    "tactile": EventKind(
        "info, warning",
        "A sensor was opened again. The warning says why it could not be, or that the size of the "
        "sensor does not fit the tip, or what looks wrong with a replayed file.",
        "Check its cable and `tactile.port`; or `tactile.rows`, `cols`, `pitch` and `tip.radius`.",
    ),
    "tactile.silent": EventKind(
        "error",
        "No valid frame arrived within `safety.frame_age_fault`.",
        "The text gives the reason, and the cells' noise if it is more than `tactile.noise`. Check "
        "the board and its cable with `softfinger doctor`.",
    ),
    "tactile.frozen": EventKind(
        "error",
        "A board repeats the same frame during contact.",
        "Switch it off and on. Set `safety.frozen_after = 0` if its noise is below one count.",
    ),
    "tactile.saturated": EventKind(
        "warning",
        "Many cells of a sensor are saturated.",
        "Grasp with less force, or lower the board's gain.",
    ),
    "tactile.misfit": EventKind(
        "warning",
        "The frames of a tip do not fit any contact of its model.",
        "`softfinger calibrate law` finds the model that fits; check `tactile.dead` and the noise.",
    ),
    "tare": EventKind(
        "warning",
        "The sensor's zero was not changed, since most cells are saturated without contact.",
        "Check the board's gain and `tactile.full_count`.",
    ),
    # The hand's parts compared with each other
    "hand.angle": EventKind(
        "warning, error",
        "The two fingers measure different angles of the object.",
        "Set `object.taper` if the object tapers; otherwise `softfinger calibrate centre`.",
    ),
    "hand.width": EventKind(
        "error",
        "The measured width of the held object changed: a sensor or a joint has shifted.",
        f"Fasten it. {_CALIBRATE_JOINTS}",
    ),
    "hand.force": EventKind(
        "warning", "The two tips measure different forces of one grip.", _CHECK_SENSOR
    ),
    "witness.left_sensor": EventKind(
        "warning", "The left sensor contradicts the joints and the other tip.", _CHECK_SENSOR
    ),
    "witness.right_sensor": EventKind(
        "warning", "The right sensor contradicts the joints and the other tip.", _CHECK_SENSOR
    ),
    "witness.left_current": EventKind(
        "warning",
        "The left joint's measured current differs from its goal.",
        "Check the servo's supply and its current sensor.",
    ),
    "witness.right_current": EventKind(
        "warning",
        "The right joint's measured current differs from its goal.",
        "Check the servo's supply and its current sensor.",
    ),
    "witness.force": EventKind(
        "error",
        "The commanded force rose, but the measured force did not follow.",
        f"Look for what blocks the joints. {_CHECK_SENSOR}",
    ),
}
