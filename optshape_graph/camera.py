"""The camera: intrinsics and distortion, in OpenCV's conventions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError

DISTORTION_LENGTHS = {"pinhole": (0, 4, 5, 8), "equidistant": (4,)}
"""Numbers of distortion coefficients by model."""


@dataclass(frozen=True, eq=False, repr=False)
class CameraIntrinsics(Value):
    """A calibrated camera. Camera frame: z forward, x right, y down; pixel (0, 0) is the centre of the top left one.

    Attributes:
        name: what results call it.
        model: "pinhole" or "equidistant".
        width: columns of the image.
        height: rows of the image.
        K: (3, 3) [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], pixels.
        D: (N,) coefficients in OpenCV's order, without unit. Pinhole: none, or k1, k2, p1, p2 (radial-tangential),
            then k3 ("plumb bob"), then k4, k5, k6 (rational). Equidistant: k1 ... k4 of OpenCV's fisheye model,
            Kannala and Brandt (PAMI 2006), theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8);
            Kalibr's "equidistant" and ROS's "equidistant" are the same.

    Raises:
        InputError: an unknown model, sizes or focal lengths that are not positive, skew, a principal point outside the
            image, or another number of coefficients than the model has.
    """

    name: str
    model: str
    width: int
    height: int
    K: Floats
    D: Floats = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        K, D = frozen(self.K), frozen(self.D)
        if self.model not in DISTORTION_LENGTHS:
            raise self._error(f"model '{self.model}', expected one of: {', '.join(DISTORTION_LENGTHS)}")
        if not (self.width > 0 and self.height > 0):
            raise self._error(f"an image of {self.width} x {self.height} pixels, expected positive numbers")
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise self._error("expected K as 3 x 3 finite numbers")
        if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != (0, 0, 1)).any():
            raise self._error(f"expected K as [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], found {K.tolist()}")
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            raise self._error(f"focal lengths {K[0, 0]:g}, {K[1, 1]:g} px, expected positive numbers")
        if not (0 < K[0, 2] < self.width and 0 < K[1, 2] < self.height):
            raise self._error(
                f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is outside the image of {self.width} x {self.height}"
            )
        lengths = DISTORTION_LENGTHS[self.model]
        if D.ndim != 1 or len(D) not in lengths or not np.isfinite(D).all():
            wanted = " or ".join(str(n) for n in lengths)
            raise self._error(f"{D.size} distortion coefficients, expected {wanted} finite numbers for '{self.model}'")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "D", D)

    def _error(self, problem: str) -> InputError:
        return InputError(f"camera '{self.name}': {problem}")
