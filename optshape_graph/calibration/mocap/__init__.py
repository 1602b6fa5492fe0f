"""Calibration of a LiDAR to motion capture."""
