"""Each placement predicted by the others: what its sightings are off by, the rig being that of the rest.

With the rows of a placement's sightings taken out, everything but its target's pose moves by a Gauss-Newton step; the
target's pose is then where its other sightings see it, and a sighting is compared with that.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.solution import Linked, RigSolution

MOST_UNKNOWNS = 1200
"""Unknowns up to which placements are left out: matrices are dense."""

WEAK = 1e-9
"""Information, relative to each unknown's own, of a prior that keeps what nothing else holds."""

OPEN = 1e-6
"""Information, relative to what its sightings tell, on a target's pose that nothing else holds without them."""

DECIDES = 1.0
"""Standard deviation, metres or rad, beyond which the others do not say where the target is."""


@dataclass(frozen=True)
class Off:
    """How far a sighting is from where the others put the target.

    Attributes:
        centre_m: distance of the target's centre, metres.
        turn_deg: angle of its rotation, degrees.
        chi_square: squared distance in the stated covariances: 6 degrees of freedom.
    """

    centre_m: float
    turn_deg: float
    chi_square: float


def predictions(solved: RigSolution) -> dict[int, tuple[Floats, Floats]]:
    """Predict every sighting, by its number, from the others of its placement and the rig of all other placements.

    A sighting has no entry where too little is left to say where the target is.

    Returns:
        How everything moves (n,), and the covariance (n, n) of that, in the unknowns' units: rad, metres, ...
    """
    graph, information = solved.graph, dense_information(solved)
    if information is None:
        return {}
    groups: dict[tuple[str, int], list[int]] = {}
    for number in solved.linked:
        sighting = graph.start.sightings[number]
        groups.setdefault((sighting.placement, sighting.moment if graph.moments else 0), []).append(number)
    found: dict[int, tuple[Floats, Floats]] = {}
    for numbers in groups.values():
        if len(numbers) > 1:
            found |= _of_placement(solved, information, numbers)
    return found


def left_out(solved: RigSolution) -> dict[int, Off]:
    """Compare every sighting, by its number, with its prediction, where it has one."""
    columns, found = solved.solution.system.columns, {}
    for number, (predicted, spread) in predictions(solved).items():
        link = solved.linked[number]
        rows = rows_of(link, columns, len(predicted))
        residual, whole = link.d + rows @ predicted, np.eye(6) + rows @ spread @ rows.T
        chi_square = float(residual @ np.linalg.solve(whole, residual))
        xi = np.asarray(-np.linalg.lstsq(link.by_pose, residual, rcond=1e-9)[0], float)
        centre = _moved(solved.graph.start.sightings[number], xi)
        found[number] = Off(centre, float(np.degrees(np.linalg.norm(xi[:3]))), chi_square)
    return found


def dense_information(solved: RigSolution) -> Floats | None:
    """Return the information (n, n) on all unknowns, with a vanishing prior; None where they are too many."""
    system = solved.solution.system
    n = system.A.shape[1]
    if n > MOST_UNKNOWNS:
        return None
    information = np.asarray(system.information.toarray(), float)
    information[np.diag_indices(n)] *= 1 + WEAK
    information[np.diag_indices(n)] += 1e-12
    return information


def inverted(information: Floats, sizes: Floats) -> Floats:
    """Return the inverse (n, n) of an information matrix, unknowns brought to one size first: it is badly conditioned.

    Args:
        information: (n, n), of the unknowns' units: one over their square.
        sizes: (n,) information on each unknown alone, about, in the same units.
    """
    D = 1.0 / np.sqrt(sizes)
    return np.asarray(D[:, None] * np.linalg.inv(D[:, None] * information * D) * D, float)


def _of_placement(
    solved: RigSolution, information: Floats, numbers: Collection[int]
) -> dict[int, tuple[Floats, Floats]]:
    columns = solved.solution.system.columns
    rows = {number: rows_of(solved.linked[number], columns, len(information)) for number in numbers}
    A, d = np.vstack(list(rows.values())), np.concatenate([solved.linked[number].d for number in numbers])
    # Where all rows are together the gradient vanishes; without these it is -A^T d.
    without = information - A.T @ A
    own = columns[solved.graph.placements[solved.graph.start.sightings[next(iter(numbers))].placement]]
    without[np.arange(own.start, own.stop), np.arange(own.start, own.stop)] += OPEN * np.diag(information)[own]
    try:
        covariance = inverted(without, np.diag(information))
    except np.linalg.LinAlgError:
        return {}
    step = covariance @ (A.T @ d)
    found = {}
    for number in numbers:
        others = [other for other in numbers if other != number]
        J = np.vstack([rows[other] for other in others])
        r = np.concatenate([solved.linked[other].d + rows[other] @ step for other in others])
        # The others of the placement tell where the target is; with them the covariance is that of a prediction.
        gain = covariance @ J.T @ np.linalg.inv(np.eye(len(J)) + J @ covariance @ J.T)
        predicted, spread = step - gain @ r, covariance - gain @ J @ covariance
        if np.sqrt(np.abs(np.diag(spread)[own])).max() <= DECIDES:
            found[number] = predicted, spread
    return found


def rows_of(link: Linked, columns: dict[int, slice], n: int) -> Floats:
    """Return a sighting's derivatives (6, n) by all unknowns."""
    rows = np.zeros((6, n))
    for key, block in zip(link.keys, link.blocks, strict=True):
        rows[:, columns[key]] += block
    return rows


def _moved(sighting: Sighting, xi: Floats) -> float:
    """How far the target's centre moves where its pose does, metres.

    xi is the right perturbation of T_target_lidar of a scan, of T_sensor_target of others.
    """
    if not sighting.relative:
        return float(np.linalg.norm(xi[3:]))
    centre = sighting.pose[:3, 3]
    return float(np.linalg.norm(np.cross(xi[:3], centre) + xi[3:]))
