"""List all event kinds with their levels, causes and remedies.

The documentation's event page is generated from this table. Kinds with a dot in their name belong
to checks that are defined in `safety.limits`.
"""

from __future__ import annotations

from typing import NamedTuple


class EventKind(NamedTuple):
    """One kind of ``hand/event`` message or daemon log line."""

    levels: str  # info, warning or error; a fault is an error that turns torque off
    cause: str
    remedy: str = ""  # empty if no action is needed


_CALIBRATE_JOINTS = "Calibrate the joints: `softfinger calibrate joints my.toml`."
_BUSY = "Find the programs that load the processors; see also the settings in `[realtime]`."
_CHECK_SENSOR = "Check the mounting of the sensor; tare and calibrate it again."

KINDS: dict[str, EventKind] = {
    # The daemon
    "start": EventKind("info", "The daemon is starting, or is ready and accepts commands."),
    "end": EventKind(
        "info, error",
        "The daemon has exited. If the level is `error`, the servos did not confirm that torque is "
        "off.",
        "If the level is `error`, switch off the servos' power supply.",
    ),
    "mode": EventKind("info", "The mode has changed; the message states the old and the new mode."),
    "compile": EventKind(
        "info, warning",
        "Kernels are being compiled. A warning states why some kernels were not compiled ahead "
        "of time.",
        "Run `softfinger compile` once. If there is a warning, fix the cause stated in it.",
    ),
    "settings": EventKind(
        "warning",
        "A setting is valid but probably wrong, for example if the sensor is smaller than the "
        "footprint.",
        "Correct the settings named in the warning. To see the warning again, run "
        "`softfinger config check`.",
    ),
    "calibration": EventKind(
        "info", "A calibration file was loaded. The message summarises the calibration."
    ),
    "material": EventKind(
        "info",
        "The material law was fitted to the measured points. The message states how far the law "
        "deviates from the points.",
        "If the deviation is large, remove outliers or measure more points.",
    ),
    "realtime": EventKind(
        "info, warning",
        "Real-time features were enabled. A warning names each feature that the system denied.",
        "To allow a denied feature, run the command in the warning. Otherwise, disable the "
        "feature in `[realtime]`.",
    ),
    "late": EventKind(
        "warning", "The machine is busy: ticks were late, or a simulated hand was paused.", _BUSY
    ),
    "loop.overruns": EventKind(
        "error",
        "Too many consecutive ticks took longer than their period.",
        f"Lower `loop.rate`. {_BUSY}",
    ),
    "clients": EventKind(
        "warning",
        "The gateway process, which serves the clients, exited, was suspended, disconnected "
        "clients without a key file, or can't start. The event also reports that the local stop "
        "socket is not in the usual folder.",
        "Correct the file or folder that the message names. Otherwise, the process restarts "
        "automatically. If the event recurs, look for a client that sends too many messages.",
    ),
    "record": EventKind(
        "error", "The recorder started by `run --record` has exited.", "Check the free disk space."
    ),
    # Commands and grips
    "grasp": EventKind(
        "warning",
        "No object was grasped, or the hand is unlikely to hold an object with this size, "
        "friction and load.",
        "Place the object between the tips; check `object.width_min`; run `softfinger envelope` to "
        "list the objects that the hand can hold.",
    ),
    "rotate": EventKind(
        "warning",
        "A `rotate` command that was waiting for the grip was discarded.",
        "Grasp again, and send `rotate` while the hand holds the object.",
    ),
    "short": EventKind(
        "warning",
        "A joint stopped before it reached its goal.",
        "Remove the obstacle; check `control.joint_friction` and `safety.current_move`.",
    ),
    "lost": EventKind(
        "warning",
        "The object is no longer in contact with both tips. The joints hold their positions.",
        "Release and grasp again. If the object slipped, use more force.",
    ),
    "slip": EventKind(
        "warning",
        "The object slips or rotates in the grip, or the daemon increased the grip force or "
        "stopped a rotation to prevent slip.",
        "Grasp with more force; check `control.tip_friction` and `control.object_load`.",
    ),
    "grip.slip": EventKind(
        "warning",
        "The shear force at the tips is close to the friction limit.",
        "Grasp with more force, or reduce the load.",
    ),
    "silence": EventKind(
        "warning",
        "The lease of the controlling client expired, and the action in `commands.on_silence` "
        "was carried out.",
        "Make the client send commands or setpoints at intervals shorter than `commands.lease`.",
    ),
    "task": EventKind(
        "warning",
        "The profile's task ended or restarted; the message states the reason.",
        "Clear any fault, then send `demo`, which arms the hand and restarts the task.",
    ),
    # Servos
    "servos": EventKind(
        "info, warning",
        "The servos were reconnected. A warning lists the problems that were found.",
        "Run `softfinger doctor --fix`, which corrects most problems.",
    ),
    "servos.bus": EventKind(
        "error",
        "The port was lost, a servo was stopped by its watchdog, or a servo is rejecting goals.",
        "Check the cable and the adapter, then run `softfinger send clear`.",
    ),
    "servos.silent": EventKind(
        "warning, error",
        "No valid reading arrived within `servos.fault_after`. If the level is warning, most "
        "readings in the last second failed. The warning is also issued while the hand is "
        "disarmed.",
        "Run `softfinger doctor`, which measures the reply times and checks the supply voltage. "
        "Check the cables.",
    ),
    "servos.frozen": EventKind(
        "error",
        "A servo keeps sending outdated readings.",
        "Switch the servo supply off and on again; check the cable.",
    ),
    "servos.alert": EventKind(
        "error",
        "A servo reports a hardware error, for example overload, overheating or a voltage error.",
        "Remove the cause; `softfinger doctor --fix` reboots the servo.",
    ),
    "servos.heat": EventKind(
        "warning, error",
        "A servo will soon reach its temperature limit. The daemon reduces the grip force if "
        "the load allows it.",
        "Grasp with less force, or let the servo cool. `safety.heat_action` selects what "
        "happens if the force can't be reduced.",
    ),
    "servos.temperature": EventKind(
        "error",
        "A servo is above `safety.temperature_max`.",
        "Let the servo cool; grasp with less force.",
    ),
    "servos.voltage": EventKind(
        "error",
        "The supply voltage of a servo is out of range.",
        "Measure the voltage at the servo during a grip; use thicker cables.",
    ),
    "goal.lost": EventKind(
        "error",
        "A servo is not receiving its goals.",
        "Check the cable; lower `servos.baud`.",
    ),
    "goal.number": EventKind(
        "error",
        "The controller computed a goal that is not a finite number. The goal was not sent.",
        "Report this error, and attach a recording.",
    ),
    "torque.off": EventKind(
        "error, info",
        "The servos have not confirmed that torque is off. An info event follows when the servos "
        "confirm that torque is off.",
        "Switch off the supply, then find out why the servos do not reply.",
    ),
    # Joints
    "joint.angle": EventKind(
        "error",
        "A joint is outside the range from `hand.q_min` to `hand.q_max`.",
        f"Turn the joint back by hand. {_CALIBRATE_JOINTS}",
    ),
    "joint.velocity": EventKind(
        "error",
        "A joint is moving too fast.",
        "Check whether something pushed the finger; if not, reduce the control gains.",
    ),
    "joint.jump": EventKind(
        "error",
        "A joint angle is inconsistent with the measured joint velocity.",
        "Check the encoder and the cable of the servo.",
    ),
    "joint.dead": EventKind(
        "error",
        "A joint neither moves towards its goal nor draws current.",
        "Check the encoder, the current sensor and the motor of the servo.",
    ),
    "joint.current": EventKind(
        "error",
        "A joint draws more current than `safety.current_fault`.",
        "Look for a blocked joint or a short circuit.",
    ),
    "joint.stall": EventKind(
        "error",
        "A joint stalled at maximum current before it reached its goal.",
        f"Remove the obstacle. {_CALIBRATE_JOINTS}",
    ),
    "joint.swapped": EventKind(
        "error",
        "A joint moves the tip of the other finger, or the object rotates in the direction "
        "opposite to the command.",
        f"Swap the left and right values of `servos.ids`, `servos.zero` and `servos.direction`. "
        f"{_CALIBRATE_JOINTS}",
    ),
    "joint.opens": EventKind(
        "warning",
        "According to the joint angles, the tips overlap during the approach, but at least one "
        "tip has no contact.",
        f"Correct `servos.direction` or `servos.zero`. {_CALIBRATE_JOINTS}",
    ),
    "joint.blocked": EventKind(
        "warning",
        "A joint has stopped at maximum current during the approach, but its tip has no contact.",
        "Remove the obstacle. If joint friction stops the finger, run `softfinger calibrate "
        "friction` and increase `control.approach_current`. If the finger opens instead of "
        f"closing, correct `servos.direction`. {_CALIBRATE_JOINTS}",
    ),
    "joint.strained": EventKind(
        "warning",
        "A grip requires the maximum current.",
        "Grasp with less force, or raise `safety.current_max`.",
    ),
    # Tips and sensors
    "tip.force": EventKind(
        "warning, error",
        "A tip force is close to or above `safety.force_max`.",
        "Grasp with less force. If the measured force is wrong, check the calibration.",
    ),
    "tip.displacement": EventKind(
        "warning, error",
        "A tip displacement is close to or above `safety.d_max`.",
        "Grasp with less force.",
    ),
    "tip.tilt": EventKind(
        "warning, error",
        "The tilt of a tip is close to or beyond the limit of the contact model.",
        "Rotate the object back, or grasp with less force.",
    ),
    "tactile": EventKind(
        "info, warning",
        "A sensor was reopened. The level is warning if a sensor could not be reopened, if the "
        "sensor size does not match the tip, or if a replayed file has a problem.",
        "Check the cable and `tactile.port`. For a size mismatch, check `tactile.rows`, `cols`, "
        "`pitch` and `tip.radius`.",
    ),
    "tactile.silent": EventKind(
        "error",
        "No valid frame arrived within `safety.frame_age_fault`.",
        "The message states the reason and, if the cell noise exceeds `tactile.noise`, the "
        "measured noise. Check the cable, and run `softfinger doctor` to check the board.",
    ),
    "tactile.frozen": EventKind(
        "error",
        "A board keeps sending the same frame during contact.",
        "Switch the board off and on again. If the board's noise is below one count, set "
        "`safety.frozen_after = 0`.",
    ),
    "tactile.saturated": EventKind(
        "warning",
        "Many cells of a sensor are saturated.",
        "Grasp with less force, or reduce the gain of the board.",
    ),
    "tactile.misfit": EventKind(
        "warning",
        "The frames of a tip do not match its contact model.",
        "Identify the contact model with `softfinger calibrate law`; check `tactile.dead` and "
        "`tactile.noise`.",
    ),
    "tare": EventKind(
        "info, warning",
        "A tare has ended. The message states the median and the largest change in the zero "
        "offsets. If the level is `warning`, most cells are saturated without contact, and "
        "the sensor was not tared.",
        "If the level is `warning`, check the board's gain and `tactile.full_count`. If the "
        "change is large at every start, run `softfinger calibrate tare` again.",
    ),
    # consistency checks between components of the hand
    "hand.angle": EventKind(
        "warning, error",
        "The two fingers measure different object angles.",
        "Set `object.taper` if the object is tapered; otherwise run `softfinger calibrate centre`.",
    ),
    "hand.width": EventKind(
        "error",
        "The measured width of the held object has changed, which indicates that a sensor or a "
        "joint's zero has shifted.",
        f"Check the mounting of the sensors. {_CALIBRATE_JOINTS}",
    ),
    "hand.force": EventKind(
        "warning", "The two tips measure different forces in the same grip.", _CHECK_SENSOR
    ),
    "consistency.left_sensor": EventKind(
        "warning",
        "The left sensor is inconsistent with the joints and the other tip.",
        _CHECK_SENSOR,
    ),
    "consistency.right_sensor": EventKind(
        "warning",
        "The right sensor is inconsistent with the joints and the other tip.",
        _CHECK_SENSOR,
    ),
    "consistency.left_current": EventKind(
        "warning",
        "The left joint's measured current differs from its goal current.",
        "Check the supply and the current sensor of the servo.",
    ),
    "consistency.right_current": EventKind(
        "warning",
        "The right joint's measured current differs from its goal current.",
        "Check the supply and the current sensor of the servo.",
    ),
    "consistency.force": EventKind(
        "error",
        "The commanded force increased, but the measured force did not follow.",
        f"Remove any obstacle that blocks the joints. {_CHECK_SENSOR}",
    ),
}
