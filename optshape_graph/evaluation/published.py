"""Tables I and II of Huang, Clark and Grizzle, "Optimal Target Shape for LiDAR Pose Estimation", as printed.

Known errors: Table I is called noise-free, but is of noise level 1; the e_q of Table II is for an azimuth step of 0.4
deg, but the recordings have 0.2 deg; and the ground truth of Table II was stretched by 3 % to fit the template.
"""

from __future__ import annotations

from typing import NamedTuple


class PublishedRow(NamedTuple):
    """One line of a table.

    Attributes:
        orientation: "face" or "extreme".
        distance_m: of the target, metres.
        n_points: returns on it.
        e_q_m: quantisation error, metres.
        rmse_m: of the vertices, metres.
        rmse_pct: in percent of the distance.
        e_t_m: translation error, metres.
        e_t_pct: in percent of the distance.
        e_r_deg: rotation error, degrees.
    """

    orientation: str
    distance_m: float
    n_points: int
    e_q_m: float
    rmse_m: float
    rmse_pct: float
    e_t_m: float
    e_t_pct: float
    e_r_deg: float


TABLE_1 = tuple(
    PublishedRow(*row)
    for row in (
        ("face", 2.00, 2530, 0.01, 0.01, 0.49, 0.002, 0.11, 0.71),
        ("face", 4.00, 1015, 0.03, 0.03, 0.83, 0.005, 0.12, 2.45),
        ("face", 6.00, 548, 0.04, 0.02, 0.40, 0.01, 0.12, 1.77),
        ("face", 8.00, 338, 0.06, 0.02, 0.28, 0.01, 0.15, 1.58),
        ("face", 16.00, 96, 0.11, 0.04, 0.22, 0.03, 0.21, 0.68),
        ("face", 30.00, 28, 0.21, 0.03, 0.10, 0.03, 0.08, 1.09),
        ("face", 32.00, 26, 0.22, 0.06, 0.17, 0.05, 0.17, 1.20),
        ("extreme", 1.94, 1734, 0.01, 0.01, 0.62, 0.01, 0.37, 0.71),
        ("extreme", 3.93, 716, 0.03, 0.03, 0.71, 0.03, 0.64, 0.95),
        ("extreme", 7.93, 258, 0.06, 0.04, 0.46, 0.03, 0.44, 0.96),
        ("extreme", 15.93, 70, 0.11, 0.05, 0.31, 0.05, 0.29, 1.37),
        ("extreme", 29.93, 21, 0.21, 0.12, 0.39, 0.09, 0.30, 5.65),
        ("extreme", 31.93, 17, 0.22, 0.47, 1.46, 0.06, 0.18, 34.72),
    )
)
"""Simulation."""

TABLE_2 = tuple(
    PublishedRow(*row)
    for row in (
        ("face", 2.1487, 3009, 0.015, 0.026, 1.193, 0.024, 1.133, 0.619),
        ("face", 4.0363, 1120, 0.028, 0.029, 0.718, 0.024, 0.603, 1.906),
        ("face", 6.0877, 527, 0.042, 0.033, 0.544, 0.03, 0.5, 1.426),
        ("face", 7.9145, 589, 0.055, 0.033, 0.413, 0.03, 0.384, 1.765),
        ("face", 10.093, 197, 0.07, 0.034, 0.334, 0.03, 0.294, 1.846),
        ("face", 12.016, 136, 0.084, 0.035, 0.288, 0.03, 0.247, 2.081),
        ("face", 13.987, 192, 0.098, 0.03, 0.216, 0.028, 0.201, 1.737),
        ("face", 15.981, 155, 0.112, 0.03, 0.187, 0.028, 0.176, 1.237),
        ("face", 17.971, 119, 0.125, 0.031, 0.173, 0.028, 0.156, 1.387),
        ("extreme", 2.0448, 2708, 0.014, 0.048, 2.364, 0.027, 1.304, 4.577),
        ("extreme", 4.1225, 898, 0.029, 0.04, 0.971, 0.034, 0.835, 2.641),
        ("extreme", 5.966, 504, 0.042, 0.033, 0.549, 0.029, 0.486, 1.826),
        ("extreme", 7.9452, 276, 0.055, 0.052, 0.656, 0.031, 0.395, 4.633),
        ("extreme", 9.9484, 155, 0.069, 0.041, 0.412, 0.034, 0.345, 3.52),
        ("extreme", 12.006, 105, 0.084, 0.06, 0.498, 0.036, 0.299, 6.064),
        ("extreme", 14.106, 75, 0.098, 0.051, 0.364, 0.045, 0.318, 2.714),
        ("extreme", 16.05, 54, 0.112, 0.057, 0.355, 0.041, 0.253, 4.634),
        ("extreme", 18.087, 48, 0.126, 0.055, 0.305, 0.044, 0.241, 3.593),
    )
)
"""Recordings with motion capture."""
