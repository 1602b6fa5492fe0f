"""Many tasks: workers and clusters, journals of finished tasks, interruption. It knows no LiDAR.

Each module is imported by its name, so that a command with one task does not import what many tasks need.
"""
