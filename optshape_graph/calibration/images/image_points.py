"""What an image says of a target: points of the target and where they appear."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.se3 import apply


@dataclass(frozen=True, eq=False, repr=False)
class ImagePoints(Value):
    """Points of a target with their pixels in one image.

    Attributes:
        points: (m, 3) metres, target frame.
        pixels: (m, 2) where they appear, (u, v), pixels.
        sqrt_information: (m, 2, 2) square-root information of each pixel, 1 / px: a corner has the inverse of its
            standard deviation on the diagonal, a point of an edge weighs across the edge only.
        symmetries: (4, 4) motions S of the target that the image cannot tell from none: S applied to `points` is
            as good a labelling of the same pixels. The first is the identity.
        printed: whether the points belong to a pattern printed or glued on the target, not to its outline.

    Raises:
        InputError: shapes that do not fit, or values that are not finite.
    """

    points: Floats
    pixels: Floats
    sqrt_information: Floats
    symmetries: tuple[Floats, ...] = (np.eye(4),)
    printed: bool = False

    def __post_init__(self) -> None:
        m = len(self.points)
        for field, shape in (("points", (m, 3)), ("pixels", (m, 2)), ("sqrt_information", (m, 2, 2))):
            values = frozen(getattr(self, field))
            if values.shape != shape or not np.isfinite(values).all():
                raise InputError(f"{field}: expected finite numbers of shape {shape}, found shape {values.shape}")
            object.__setattr__(self, field, values)
        object.__setattr__(self, "symmetries", tuple(frozen(S) for S in self.symmetries))

    @classmethod
    def of_pattern(
        cls, points: Floats, pixels: Floats, sigma_px: float, symmetries: tuple[Floats, ...] = (np.eye(4),)
    ) -> ImagePoints:
        """Make image points of a printed pattern.

        Args:
            points: (m, 3) metres, target frame.
            pixels: (m, 2) where they appear, (u, v), pixels.
            sigma_px: standard deviation, pixels, the same both ways.
            symmetries: (4, 4) motions of the target that the image cannot tell from none.
        """
        W = np.broadcast_to(np.eye(2) / sigma_px, (len(points), 2, 2))
        return cls(points, pixels, W, symmetries, printed=True)

    def __len__(self) -> int:
        return len(self.points)

    def relabelled(self, S: Floats) -> ImagePoints:
        """Return the same pixels as points S p of the target, S (4, 4) one of `symmetries`."""
        return replace(self, points=apply(S, self.points))

    def scaled_noise(self, factor: float) -> ImagePoints:
        """Return the points with the standard deviations of their pixels multiplied by a factor."""
        return replace(self, sqrt_information=self.sqrt_information / factor)


def turn_about(centre: tuple[float, float], angle: float) -> Floats:
    """Return the motion (4, 4) that turns the target's plane by an angle, rad, about (y, z), right-handed about +x."""
    c, s = np.cos(angle), np.sin(angle)
    S = np.eye(4)
    S[1:3, 1:3] = [[c, -s], [s, c]]
    S[1:3, 3] = np.asarray(centre) - S[1:3, 1:3] @ np.asarray(centre)
    return S
