"""Corners of ArUco and AprilTag fiducials."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.errors import EstimationError
from optshape_graph.io.image_files import opencv, tag_dictionary
from optshape_graph.target import Tags

CORNER_SIGMA_PX = 0.5
"""Standard deviation of a tag's corner: an L-shaped corner is found less well than a chessboard's crossing."""


def tag_points(tags: Tags, number: int) -> Floats:
    """Return the corners (4, 3) of one tag, target frame, metres, in OpenCV's order."""
    return np.column_stack([np.zeros(4), tags.corners(number)])


def find_tags(image: np.ndarray, tags: Tags) -> ImagePoints:
    """Find the corners of a target's tags; tags of other numbers are left out.

    Args:
        image: (h, w) grey image, 8 bit.
        tags: the tags of the target.

    Raises:
        InputError: OpenCV has no dictionary of that name.
        EstimationError: none of the target's tags is found.
    """
    cv2, dictionary = opencv(), tag_dictionary(tags.dictionary)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    found = {} if numbers is None else dict(zip(np.ravel(numbers).tolist(), corners, strict=True))
    mine = sorted(set(found) & set(tags.centres))
    if not mine:
        seen = f"tags {sorted(found)} are in the image" if found else "no tag is in the image"
        raise EstimationError(f"{seen}; the target has {sorted(tags.centres)} of {tags.dictionary}")
    return ImagePoints.of_pattern(
        np.vstack([tag_points(tags, number) for number in mine]),
        np.vstack([np.reshape(found[number], (4, 2)) for number in mine]).astype(float),
        CORNER_SIGMA_PX,
    )
