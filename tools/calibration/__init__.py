"""The `calibrate` command: frame acquisition, calibration steps and plots."""
