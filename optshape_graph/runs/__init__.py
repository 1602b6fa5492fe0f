"""Many tasks: workers and clusters, journals of what is finished, interruption. Knows no LiDAR.

Each module is imported by its name, so that a command that has one task does not wait for what many need.
"""
