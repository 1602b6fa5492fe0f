"""What can be wrong with a camera calibration before any work: patterns, rough corners, exports, outputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph.calibration.camera.factors import OFFSET_SIGMA_M
from optshape_graph.calibration.exports import kalibr_distortion
from optshape_graph.calibration.images.chessboard import shown_counts
from optshape_graph.calibration.images.reading import read_grey
from optshape_graph.errors import InputError
from optshape_graph.io.sessions import Session
from optshape_graph.target import Chessboard, Target

BEYOND_M = 3 * OFFSET_SIGMA_M[1]
"""How far a pattern may reach beyond its board, metres: three standard deviations of where it lies."""

LOOKED_AT = 3
"""Images in which other numbers of corners are tried."""


def check_session(session: Session) -> None:
    """Raise if the session's targets can't be found in its images as the files say.

    Raises:
        InputError: no view has an image; a pattern reaches beyond its board, and what its numbers may be instead; or
            a target without pattern lacks the rough corners that its outline starts from.
    """
    views = [view for view in session.views if view.image is not None]
    if not views:
        raise InputError(
            f"{session.path}: no view has an image; a camera calibration needs views with a scan and an image"
        )
    for name in dict.fromkeys(name for view in views for name in view.targets):
        target = session.targets[name]
        images = [view.image for view in views if name in view.targets and view.image is not None]
        if target.chessboard is not None:
            _check_chessboard(session, target, target.chessboard, images)
        elif target.tags is not None:
            _check_tags(session, target)
        for view in views:
            bare = target.chessboard is None and target.tags is None and name in view.targets
            if bare and view.corners is None and view.image is not None and view.image.suffix.lower() != ".csv":
                raise InputError(
                    f"{session.path}: {view.image.name}: target '{target.name}' has no pattern, so its outline needs "
                    f"a start: a CSV file (vertex,u,v) with rough pixels of its vertices, as the view's 'corners'"
                )


def check_camchain(session: Session) -> None:
    """Raise if one of the session's cameras has no form in a Kalibr camchain.

    Raises:
        InputError: it has more distortion terms than any of Kalibr's models.
    """
    for camera in session.cameras.values():
        kalibr_distortion(camera)


def _check_chessboard(session: Session, target: Target, board: Chessboard, images: list[Path]) -> None:
    if _fits(target, board):
        return
    a, b = board.inner_corners
    shown = _shown(images, board)
    hints = []
    if shown is not None and shown[1] != (a, b):
        name, (c, d) = shown
        hints.append(f"{name} shows {c} x {d}: 'inner_corners' counts the corners inside the pattern, not its squares")
    elif _fits(target, replace(board, inner_corners=(b, a))):
        hints.append(f"{b} x {a} would fit: are the corners in the other order?")
    size = [1e3 * (n + 1) * board.square for n in (a, b)]
    sides = 1e3 * np.ptp(target.polygon, axis=0)[::-1]
    raise InputError(
        f"{session.path}: the chessboard of target '{target.name}' reaches beyond its board: {a} x {b} inner corners "
        f"[z, y] of {1e3 * board.square:g} mm squares take {size[0]:.0f} x {size[1]:.0f} mm, the board has "
        f"{sides[0]:.0f} x {sides[1]:.0f} mm: " + ("; ".join(hints) if hints else "is 'square' right?")
    )


def _shown(images: list[Path], board: Chessboard) -> tuple[str, tuple[int, int]] | None:
    """Return the name of an image that shows a chessboard, and the numbers of its corners."""
    for image in [path for path in images if path.suffix.lower() != ".csv"][:LOOKED_AT]:
        try:
            shown = shown_counts(read_grey(image), board)
        except InputError:  # unreadable: its view will say so
            continue
        if shown is not None:
            return image.name, shown
    return None


def _fits(target: Target, board: Chessboard) -> bool:
    """Return whether a chessboard's outermost squares lie on the board."""
    half = (np.array(board.inner_corners[::-1]) + 1) * board.square / 2
    corners = np.array(board.offset) + half * [[1, 1], [1, -1], [-1, -1], [-1, 1]]
    return bool((target.outside_distance(corners) <= BEYOND_M).all())


def _check_tags(session: Session, target: Target) -> None:
    assert target.tags is not None
    for number in target.tags.centres:
        beyond = float(target.outside_distance(target.tags.corners(number)).max())
        if beyond > BEYOND_M:
            raise InputError(
                f"{session.path}: tag {number} of target '{target.name}' reaches {1e3 * beyond:.0f} mm beyond its "
                f"board; expected all of it on the board: are 'size' and the centres right?"
            )
