"""`bench`: its measurements, one module each with ``measure(brief) -> list[Report]``.

``PAGE`` names the rows that belong on the page: by a table's title, how their names begin.
"""
