"""The measurements behind ``softfinger bench``, one module each, with ``measure() -> rows``.

Rows are `report.Row`, or of a type of the module's own with ``as_dict()``; such a module also has
``table(rows) -> str`` and may have ``plot(rows, path)``.
"""
