"""A LiDAR's own calibration."""
