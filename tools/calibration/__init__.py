"""The calibration command `calibrate`: how it gets frames, its steps and its pictures."""
