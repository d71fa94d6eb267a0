"""Contact mechanics of soft hemispherical fingertips and the planar two-fingered hand.

Pure mathematics: no input or output, no clock, no thread, no settings.
"""

from kinematics.contact import Fingertip
from kinematics.material import Material
from kinematics.table import ContactTable

__all__ = ["ContactTable", "Fingertip", "Material"]
