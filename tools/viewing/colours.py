"""The colours of both viewers.

The left finger is blue, the right one orange, goals are grey: distinguishable for colour-blind
people, on light and on dark ground.
"""

COLOURS = {"left": (51, 136, 221), "right": (230, 126, 0)}
GOAL = (140, 140, 140)
OBJECT = (0, 158, 115)
LATE = (204, 96, 150)
SPRING = (150, 150, 150)
LEVELS = {"info": (120, 120, 120), "warning": (214, 140, 0), "error": (214, 54, 40)}


def between(
    first: tuple[int, int, int], second: tuple[int, int, int], share: float
) -> tuple[int, int, int]:
    """A mixture of two colours with ``share`` of the second."""
    red, green, blue = (round(a + share * (b - a)) for a, b in zip(first, second, strict=True))
    return red, green, blue
