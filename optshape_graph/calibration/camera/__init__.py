"""Calibration of LiDARs and cameras from views of targets."""
