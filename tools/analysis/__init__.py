"""`analyse` and `plot`: recorded frames to contacts, and recordings beside the contact model.

The estimate is the daemon's own.
"""
