"""What a pressure sensor under a tip reads: the forward model, its counts, its calibration.

Numbers alone: no files, no ports.
"""
