"""From tactile frames to contacts: calibration, estimate, and the filter between frames."""
