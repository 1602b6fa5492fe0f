"""Whether the images of a camera contradict the lens that its intrinsics describe."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.factors import INTRINSICS_SIGMA, LENS, CompiledCamera
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.planar_pose import whitened_errors
from optshape_graph.calibration.images.projection import project
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.se3 import apply

FEWEST_IMAGES = 8
"""Images from which a lens can be judged: with fewer, a bent board looks like a wrong lens."""

FALSE_ALARM = 1e-6
"""Probability that a right lens is called wrong, were the corners' errors Gaussian and independent."""

WORTHWHILE = 0.9
"""Share to which the corners' errors must fall at least: what helps less is not worth another lens."""

LENS_OFF = 0.005
"""Shift of the principal point, in widths of the image, or half the change of a focal length, in its value, beyond
which a lens is called another than the given one."""


@dataclass(frozen=True)
class LensChange:
    """How a refined lens differs from the given one.

    Attributes:
        moved_px: shift of the principal point, pixels.
        stretched: largest change of a focal length, in shares of it.
        far: whether it is another lens.
    """

    moved_px: float
    stretched: float
    far: bool

    @classmethod
    def of(cls, given: CameraIntrinsics, refined: CameraIntrinsics) -> LensChange:
        """Compare two lenses of one camera."""
        moved = float(np.linalg.norm(refined.K[:2, 2] - given.K[:2, 2]))
        stretched = float(np.abs(np.diag(refined.K)[:2] / np.diag(given.K)[:2] - 1).max())
        return cls(moved, stretched, moved > LENS_OFF * given.width or stretched > 2 * LENS_OFF)

    @property
    def text(self) -> str:
        """The change in words."""
        return (
            f"its principal point moves by {self.moved_px:.1f} px and its focal length by {100 * self.stretched:.2f} %"
        )


@dataclass(frozen=True)
class LensCheck:
    """What the images of one camera say of its lens.

    Attributes:
        camera: its name.
        images: how many were looked at.
        rms_px: root mean square of the corners' errors along one axis, each image's pose fitted, pixels.
        refined_rms_px: what it would fall to with the lens that fits all images best.
        contradicted: whether that is more than chance.
    """

    camera: str
    images: int
    rms_px: float
    refined_rms_px: float
    contradicted: bool


def check_lenses(images: Iterable[TargetInImage]) -> tuple[LensCheck, ...]:
    """Test each camera's lens against its images: would another lens fit better, all poses free?

    A score test: one linear step from the given intrinsics and the poses of the images alone, so nothing is solved.
    Cameras with few images, or with more distortion terms than can be refined, are left out.

    Args:
        images: of all cameras.
    """
    found: dict[str, dict[int, TargetInImage]] = {}
    for image in images:
        found.setdefault(image.camera.name, {})[id(image)] = image
    checks = []
    for name, group in found.items():
        try:
            camera = CompiledCamera.of(next(iter(group.values())).camera)
            camera.check_refinable()
        except InputError:
            continue
        if len(group) >= FEWEST_IMAGES:
            checks.append(_check(name, list(group.values()), camera))
    return tuple(checks)


def _check(name: str, images: Sequence[TargetInImage], camera: CompiledCamera) -> LensCheck:
    information, gradient = np.diag(1 / INTRINSICS_SIGMA[LENS] ** 2), np.zeros(len(LENS))
    squared, freedom, px = 0.0, 0.0, []
    for image in images:
        points, T = image.points, image.poses[0].T_camera_target
        errors, by_pose = whitened_errors(points, image.camera, T)
        by_lens = lens_derivative(points, camera, T)
        # What the pose cannot take up.
        Q = np.linalg.qr(by_pose)[0]
        errors, by_lens = errors - Q @ (Q.T @ errors), by_lens - Q @ (Q.T @ by_lens)
        information += by_lens.T @ by_lens
        gradient += by_lens.T @ errors
        squared += float(errors @ errors)
        strength = np.linalg.svd(points.sqrt_information, compute_uv=False)
        px.append(1 / strength.max())
        freedom += float((strength > 0.01 * strength.max()).sum() - 6)
    gain = float(gradient @ np.linalg.solve(information, gradient))
    left = freedom - len(LENS)
    F = (gain / len(LENS)) / max((squared - gain) / left, 1e-300)
    rms, refined = (float(np.median(px) * np.sqrt(s / n)) for s, n in ((squared, freedom), (squared - gain, left)))
    chance = float(f_distribution.sf(F, len(LENS), left))
    return LensCheck(name, len(images), rms, refined, chance < FALSE_ALARM and refined < WORTHWHILE * rms)


def lens_derivative(points: ImagePoints, camera: CompiledCamera, T: Floats) -> Floats:
    """Return the derivative (2 m, 8) of the whitened errors by the entries LENS of the intrinsics.

    Args:
        points: m points of a target in an image.
        camera: the lens.
        T: (4, 4) T_camera_target.
    """
    in_camera = apply(T, points.points)
    columns = []
    for k in LENS:
        step = 1e-3 * INTRINSICS_SIGMA[k] * np.eye(len(INTRINSICS_SIGMA))[k]
        ahead, behind = (project(camera.refined(camera.vector + s * step), in_camera) for s in (1, -1))
        by_one = (ahead - behind) / (2e-3 * INTRINSICS_SIGMA[k])
        columns.append(np.einsum("nij,nj->ni", points.sqrt_information, by_one).ravel())
    return np.column_stack(columns)
