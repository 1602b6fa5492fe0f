"""How long a board's sides are by the images, its pattern being the scale: is the target's file right?

A LiDAR's beam is a centimetre or two wide at a board's rim, an image's pixel a few millimetres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.consistency import of_view, pose_alone
from optshape_graph.calibration.camera.graph import Rig, Sighting
from optshape_graph.calibration.images.outline import edge_shifts
from optshape_graph.calibration.images.reading import TargetInImage, read_grey
from optshape_graph.errors import InputError
from optshape_graph.target import Target

FEWEST_IMAGES = 3
"""Images that must show an edge."""

REACH = (0.7, 0.03)
"""How far to look on either side of an edge: a share of what is free between it and the pattern, and metres at most."""


@dataclass(frozen=True, eq=False, repr=False)
class SidesInImages(Value):
    """The sides of a target by the images.

    Attributes:
        target: the target as its file says.
        sides: (n,) lengths of its edges, metres.
        sigma: (n,) their standard deviations, by the scatter over the images.
    """

    target: Target
    sides: Floats
    sigma: Floats


def sides_in_images(targets: dict[int, Target], sightings: Sequence[Sighting], rig: Rig) -> list[SidesInImages]:
    """Measure the sides of every target with a pattern.

    Args:
        targets: by the numbers of the views to look at.
        sightings: of all views.
        rig: where the sensors are, and the lenses.
    """
    shifts: dict[str, dict[int, Floats]] = {}
    by_name: dict[str, Target] = {}
    for number, target in targets.items():
        _, image = of_view(number, sightings)
        if image is None or not isinstance(image.seen, TargetInImage) or not image.seen.points.printed:
            continue
        if (reach := _reach(target, image.seen)) <= 0 or Path(image.seen.image).suffix.lower() == ".csv":
            continue
        try:
            picture = read_grey(Path(image.seen.image))
        except InputError:  # simulated, or gone since
            continue
        T, camera = pose_alone(image, rig), rig.cameras[image.sensor]
        shifts.setdefault(target.name, {})[id(image.seen)] = edge_shifts(picture, target, camera, T, reach)
        by_name[target.name] = target
    return [found for name, each in shifts.items() if (found := _sides(by_name[name], np.array([*each.values()])))]


def _reach(target: Target, seen: TargetInImage) -> float:
    """Return how far, metres, an edge may be looked for before the pattern's own edges are met."""
    board, tags = target.chessboard, target.tags
    points = seen.points.points[:, 1:]
    square = board.square if board is not None else tags.size if tags is not None else 0.0
    inside = -float(target.outside_distance(points).max()) - (square if board is not None else 0.0)
    share, most = REACH
    return min(share * inside, most)


def _sides(target: Target, shifts: Floats) -> SidesInImages | None:
    """Return the sides of a polygon whose edges lie further out by shifts (V, n), metres; None: an edge is not seen."""
    seen = np.isfinite(shifts).sum(axis=0)
    if (seen < FEWEST_IMAGES).any():
        return None
    middle = np.nanmedian(shifts, axis=0)
    sigma = 1.48 * np.nanmedian(np.abs(shifts - middle), axis=0) * np.sqrt(np.pi / 2 / seen)

    def lengths(moved: Floats) -> Floats:
        n, c = target.normals, target.offsets + moved
        before, c_before = np.roll(n, 1, axis=0), np.roll(c, 1)
        vertices = np.linalg.solve(np.stack([before, n], axis=1), np.stack([c_before, c], axis=1)[..., None])[..., 0]
        return np.asarray(np.linalg.norm(np.roll(vertices, -1, axis=0) - vertices, axis=1))

    sides = lengths(middle)
    each = np.array([lengths(middle + step) - sides for step in np.diag(sigma)])
    return SidesInImages(target, sides, np.sqrt((each**2).sum(axis=0)))
