"""Chessboard corners, to a fraction of a pixel."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.images.image_points import ImagePoints, turn_about
from optshape_graph.errors import EstimationError
from optshape_graph.io.image_files import opencv
from optshape_graph.target import Chessboard

CORNER_SIGMA_PX = 0.2
"""Standard deviation of a corner: what sub-pixel refinement leaves in a sharp image."""

REDUCED_PX, SMALL_PX = 960, 640
"""Longer sides of the reduced images in which a board is looked for first, and in which other counts are tried."""

WINDOW = (0.25, 3, 11)
"""Half the side of the refinement window: a share of the distance between corners, and its limits, px."""


def chessboard_points(board: Chessboard) -> Floats:
    """Return the inner corners (m, 3), target frame, metres: y varies slowest, both ascending."""
    n_z, n_y = board.inner_corners
    y = (np.arange(n_y) - (n_y - 1) / 2) * board.square + board.offset[0]
    z = (np.arange(n_z) - (n_z - 1) / 2) * board.square + board.offset[1]
    yy, zz = np.meshgrid(y, z, indexing="ij")
    return np.column_stack([np.zeros(yy.size), yy.ravel(), zz.ravel()])


def find_chessboard(image: np.ndarray, board: Chessboard, thorough: bool = True) -> ImagePoints:
    """Find the inner corners of a chessboard.

    The grid looks the same after half a turn (a square one after a quarter), so which corner comes first is
    arbitrary: the turns are the result's symmetries.

    Args:
        image: (h, w) grey image, 8 bit.
        board: the pattern.
        thorough: whether a board that a reduced image does not show is looked for in the full one, which takes ten
            times as long.

    Raises:
        EstimationError: the chessboard is not found.
    """
    n_z, n_y = board.inner_corners
    corners = _find_reduced(image, (n_z, n_y), REDUCED_PX)
    if corners is None and thorough and max(image.shape) > REDUCED_PX:
        corners = _find(image, (n_z, n_y))
    if corners is None:
        raise EstimationError(f"no chessboard of {n_z} x {n_y} inner corners found in the image")
    grid = _refined(image, corners.reshape(n_y, n_z, 2))
    # Seen from the target's -x side y points left and z up, so (y, z) turns the way (u, v) does.
    down, along = grid[-1, 0] - grid[0, 0], grid[0, -1] - grid[0, 0]
    if down[0] * along[1] - down[1] * along[0] < 0:
        grid = grid[::-1]
    quarters = (0, 1, 2, 3) if n_z == n_y else (0, 2)
    symmetries = tuple(turn_about(board.offset, k * np.pi / 2) for k in quarters)
    return ImagePoints.of_pattern(chessboard_points(board), grid.reshape(-1, 2), CORNER_SIGMA_PX, symmetries)


def shown_counts(image: np.ndarray, board: Chessboard) -> tuple[int, int] | None:
    """Return the numbers of inner corners of the chessboard that an image shows: those stated, or some near them.

    Tried are the stated ones, squares counted for corners, and one row or column more or less. In which order they
    stand, an image does not tell.

    Args:
        image: (h, w) grey image, 8 bit.
        board: the pattern as stated.
    """
    a, b = board.inner_corners
    for size in ((a, b), (a - 1, b - 1), (a + 1, b + 1), (a - 1, b), (a, b - 1), (a + 1, b), (a, b + 1)):
        if min(size) > 2 and _find_reduced(image, size, SMALL_PX) is not None:
            return size
    return None


def _find_reduced(image: np.ndarray, size: tuple[int, int], longest: int) -> Floats | None:
    """Look for a board in an image whose longer side is reduced to some pixels; return its corners in the full one."""
    cv2 = opencv()
    scale = min(1.0, longest / max(image.shape))
    small = image if scale == 1.0 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    corners = _find(small, size)
    return None if corners is None else (corners + 0.5) / scale - 0.5


def _find(image: np.ndarray, size: tuple[int, int]) -> Floats | None:
    """Try the fast detector, then the fast one on equalised contrast, then the slow, more tolerant one."""
    cv2 = opencv()
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    if not found:
        equalised = cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(image)
        found, corners = cv2.findChessboardCorners(equalised, size, flags=flags)
    if not found:
        found, corners = cv2.findChessboardCornersSB(
            image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        )
    return np.asarray(corners, float) if found else None


def _refined(image: np.ndarray, grid: Floats) -> Floats:
    cv2 = opencv()
    spacing = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    share, least, most = WINDOW
    half = int(np.clip(share * spacing, least, most))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    corners = grid.reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), criteria)
    return np.asarray(refined, float).reshape(grid.shape)
