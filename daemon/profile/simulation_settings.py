"""Define the simulated hand's settings: object, tips, sensors, joints and servos."""

from __future__ import annotations

from typing import Annotated, Literal

from softfinger.daemon.backends import BUILT_IN
from softfinger.daemon.profile.fields import (
    Acceleration,
    Angle,
    Delay,
    Factor,
    Fraction,
    Length,
    NonNegative,
    Place,
    Positive,
    Section,
    names_backend,
    setting,
)


class SimulationSettings(Section):
    """The simulated hand used by the simulated backends and by `softfinger emulate`.

    The default values are plausible, but not measured.
    """

    seed: int = setting(1, "", "Random seed for noise and faults.", ge=0)
    object_mass: Factor = setting(0.10, "kg", "Mass of the object.")
    object_shape: Annotated[str, names_backend("shapes")] = setting(
        "rectangle", "", "Shape of the object in the hand's plane.", examples=[*BUILT_IN["shapes"]]
    )
    object_width: Length = setting(
        0.040, "m", "Width of the object; for a wedge, the width at half its height."
    )
    object_height: Length = setting(
        0.060, "m", "Length of the object in the direction away from the palm."
    )
    object_radius: Length = setting(0.020, "m", "Radius of a disc.")
    object_taper: float = setting(
        0.17, "rad", "Angle between the faces of a wedge.", ge=-1.5, le=1.5
    )
    object_position: tuple[Place, Place] = setting(
        (0.0, 0.080), "m", "Initial position (x, y) of the object in the hand's plane."
    )
    object_angle: Angle = setting(0.0, "rad", "Initial angle of the object.")
    gravity: tuple[Acceleration, Acceleration] = setting(
        (0.0, 0.0),
        "m/s²",
        "Gravity (x, y) in the hand's plane; the built-in hand lies on a table, so both are 0.",
    )
    table_friction: NonNegative = setting(0.3, "", "Friction coefficient between object and table.")
    tip_friction: NonNegative = setting(0.6, "", "Friction coefficient between tip and object.")
    modulus_scale: Factor = setting(
        1.0, "", "Modulus of the simulated tips divided by the modulus of the profile's material."
    )
    tactile_noise: NonNegative = setting(1520.0, "Pa", "Noise standard deviation of each cell.")
    tactile_gain: tuple[Factor, Factor] = setting(
        (1.0, 1.0), "", "Gain of each sensor: reading divided by pressure."
    )
    tactile_gain_spread: Fraction = setting(
        0.0, "", "Relative standard deviation of the cell gains."
    )
    tactile_dead: Fraction = setting(
        0.0, "", "Fraction of cells that read 0, in addition to `tactile.dead`."
    )
    tactile_blur: float = setting(
        0.0, "m", "Standard deviation of the blur due to the layer above the cells.", ge=0, le=0.1
    )
    tactile_hysteresis: Fraction = setting(
        0.0, "", "Relative hysteresis: excess reading while the load on a cell decreases."
    )
    tactile_creep: Fraction = setting(
        0.0, "", "Relative creep of the reading under constant pressure."
    )
    tactile_creep_time: Positive = setting(10.0, "s", "Time constant of the creep.")
    tactile_response: Delay = setting(0.0, "s", "Time constant of the cells' first-order lag.")
    tactile_exponent: Factor = setting(
        1.0, "", "Exponent of the cells' characteristic curve, reading versus pressure."
    )
    tactile_fold: NonNegative = setting(
        0.0,
        "Pa",
        "Pressure above which the reading of a cell decreases again; 0 disables this effect.",
    )
    tactile_crosstalk: Fraction = setting(
        0.0, "", "Crosstalk: each cell receives this fraction of the mean of its row and column."
    )
    tactile_row_noise: NonNegative = setting(
        0.0, "Pa", "Standard deviation of the noise that is common to all cells of a row."
    )
    tactile_drift: NonNegative = setting(
        0.0, "Pa", "Standard deviation of the zero drift of each cell."
    )
    tactile_gain_drift: Fraction = setting(
        0.0, "", "Relative standard deviation of the sensor's gain drift."
    )
    tactile_drift_time: Positive = setting(
        60.0, "s", "Time constant of the zero drift and of the gain drift."
    )
    tactile_delay: Delay = setting(
        0.020, "s", "Time from the middle of a scan to the arrival of the frame."
    )
    tactile_jitter: Delay = setting(0.0, "s", "Maximum additional delay of a frame.")
    tactile_dropped: float = setting(0.0, "", "Fraction of frames that are lost.", ge=0, le=0.99)
    palm: Place = setting(0.0, "m", "Position of the palm along y; the pivots are at y = 0.")
    palm_friction: NonNegative = setting(0.3, "", "Friction coefficient between object and palm.")
    tip_loss: Delay = setting(0.002, "s", "Damping of the tip divided by its stiffness.")
    tip_law: Literal["springs", "bristles"] = setting(
        "springs",
        "",
        "Tangential force law of the tips; with `springs`, the shear force depends on θ.",
    )
    tip_shear_stiffness: float = setting(
        1.0, "", "Ratio of tangential to normal stiffness of the tip's springs.", ge=0.1, le=10
    )
    tip_creep_time: NonNegative = setting(
        0.0,
        "s",
        "Time constant of the shear relaxation of a sticking tip; 0 disables relaxation.",
    )
    tip_micro_slip: bool = setting(
        False, "", "Let the footprint slip at its edge first, and then at its centre."
    )
    tip_relaxation: tuple[Fraction, Fraction, Fraction] = setting(
        (0.0, 0.0, 0.0), "",
            "Amplitudes of three Prony terms, as fractions of the tip's final stiffness; "
            "0 makes the tip elastic."
    )  # fmt: skip
    tip_relaxation_times: tuple[Positive, Positive, Positive] = setting(
        (0.004, 0.07, 1.4), "s", "Time constants of the Prony terms; the defaults are those of a "
        "human fingerpad (Pawluk & Howe, 1999)."
    )  # fmt: skip
    joint_inertia: Factor = setting(
        0.010, "kg·m²", "Inertia of the finger and the rotor, referred to the joint."
    )
    joint_damping: NonNegative = setting(0.02, "N·m·s/rad", "Viscous friction of the joint.")
    joint_friction: NonNegative = setting(0.05, "N·m", "Coulomb friction of the joint.")
    joint_stribeck: NonNegative = setting(
        0.0, "N·m", "Additional friction of a joint at standstill."
    )
    joint_load_friction: tuple[Fraction, Fraction] = setting(
        (0.0, 0.0), "",
            "Gear friction as a fraction of the transmitted torque, and the increase in this "
            "fraction at standstill."
    )  # fmt: skip
    joint_stribeck_speed: Positive = setting(
        0.12, "rad/s", "Joint speed at which the additional friction has fallen to 1/e."
    )
    joint_presliding: Positive = setting(
        0.0005, "rad", "Elastic deflection of the gears before the gears start to move."
    )
    servo_heat: tuple[Factor, Factor, Factor] = setting(
        (1.0, 1.0, 1.0), "", "Factors for the servos' heating, cooling and heat capacity."
    )
    ambient: float = setting(25.0, "°C", "Ambient temperature of the servos.", ge=-40, le=80)
    compression_speed: NonNegative = setting(
        0.004, "m/s", "Speed at which the object is pressed onto the tips if there are no servos."
    )
