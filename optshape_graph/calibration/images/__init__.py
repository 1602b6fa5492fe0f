"""The camera's side of a calibration: targets in images, their points to a fraction of a pixel, and their poses."""
