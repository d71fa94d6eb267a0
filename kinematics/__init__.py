"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

Pure mathematics: no input or output, no clock, no thread, no settings. SI units.
"""

from kinematics.contact import Fingertip
from kinematics.estimator import ContactEstimator
from kinematics.material import Material
from kinematics.pressure import SensorGrid
from kinematics.table import ContactTable

__all__ = ["ContactEstimator", "ContactTable", "Fingertip", "Material", "SensorGrid"]
