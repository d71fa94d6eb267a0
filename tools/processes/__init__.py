"""`run`, `emulate` and `compile`: the processes of a hand, what runs beside them, and their log."""
