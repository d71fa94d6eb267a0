"""What `softfinger doctor` looks at: one module an area, each a few functions that return results.

Nothing here changes anything, stiffens or moves the hand; what may be repaired is in
:mod:`diagnosis.repair`, which is called when it is asked for.
"""
