"""A search from many starts of one seed, over processes; finished starts are kept, so that a killed search resumes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.polygons import centred
from optshape_graph.design.problem import Problem, Start, random_parameters, solve
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.documents import read_document, write_json
from optshape_graph.runs.interruption import going_on
from optshape_graph.runs.journal import locked
from optshape_graph.runs.workers import Lost, Pool
from optshape_graph.target import Target

KIND = "design-start"


@dataclass(frozen=True)
class Search:
    """The ends of all starts, in the order of their numbers.

    Attributes:
        problem: the problem that was solved.
        seed: of the starts.
        starts: the end of each start.
    """

    problem: Problem
    seed: int
    starts: tuple[Start, ...]

    @property
    def best(self) -> Start:
        """The admissible end with the largest score.

        Raises:
            EstimationError: no start ended within the limits.
        """
        admissible = [start for start in self.starts if start.slack >= 0]
        if not admissible:
            raise EstimationError(
                f"none of {len(self.starts)} starts found a shape within the limits; "
                "allow more starts, or less strict limits"
            )
        return max(admissible, key=lambda start: start.score)

    def target(self, name: str = "optimal") -> Target:
        """Return the best shape, with the area of the limits."""
        return Target.from_polygon(self.upright_polygon(self.best) * np.sqrt(self.problem.limits.area), name)

    def upright_polygon(self, start: Start) -> Floats:
        """Return the shape (n, 2) at which a start ended, of unit area, turned upright (`upright`)."""
        return upright(self.problem.family.polygons(start.parameters)[0])


def search(
    problem: Problem,
    starts: int,
    seed: int,
    pool: Pool | None = None,
    folder: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Search:
    """Solve from many starts. The result depends only on the problem, the seed and the number of starts.

    Args:
        problem: the problem.
        starts: number of starts.
        seed: start i is drawn from (seed, i).
        pool: the workers; None: this process.
        folder: where finished starts are kept; those found there are not solved again.
        progress: called with the numbers of finished and of all starts, before the first and after each.

    Raises:
        InputError: `folder` holds starts of another problem or seed, another run uses it, or no start is asked for.
        EstimationError: the worker of a start was killed twice; the others are kept.
    """
    if starts < 1:
        raise InputError(f"expected at least 1 start; found {starts}")
    done: dict[int, Start] = {}
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        done = {i: _read(path, problem, seed) for i in range(starts) if (path := _path(folder, i)).exists()}
    if progress is not None:
        progress(len(done), starts)
    todo = ((i, i) for i in range(starts) if i not in done)
    held = nullcontext() if folder is None else locked(folder)
    advice = "no start is kept" if folder is None else f"finished starts are kept in {folder}; the same command goes on"
    with held, going_on(lambda: advice):
        for index, start in (pool or Pool()).run(partial(_solve_start, problem, seed), todo):
            if isinstance(start, Lost):
                raise EstimationError(f"start {index}: {start.reason}")
            done[index] = start
            if folder is not None:
                write_json(_path(folder, index), _document(start, problem, seed))
            if progress is not None:
                progress(len(done), starts)
    return Search(problem, seed, tuple(done[i] for i in range(starts)))


def upright(polygon: Floats) -> Floats:
    """Return a polygon (n, 2) in its unit, about its area's centroid, its longest extent level, wider below than above.

    The score is the worst over all orientations, so it is the same in any; in this one the target stands well.
    """
    polygon = centred(polygon)
    i, j = divmod(int(np.linalg.norm(polygon[:, None] - polygon, axis=-1).argmax()), len(polygon))
    along = (polygon[j] - polygon[i]) / np.linalg.norm(polygon[j] - polygon[i])
    turned = polygon @ np.array([[along[0], -along[1]], [along[1], along[0]]])
    lower, upper = -turned[:, 1].min(), turned[:, 1].max()
    return np.asarray(turned if upper >= lower else -turned)


def _solve_start(problem: Problem, seed: int, index: int) -> Start:
    """Solve from one start; this is the task of a worker."""
    return solve(problem, random_parameters(problem, np.random.default_rng([seed, index])), index)


def _path(folder: Path, index: int) -> Path:
    return folder / f"start-{index:05d}.json"


def _document(start: Start, problem: Problem, seed: int) -> dict[str, Any]:
    return {
        "schema": f"optshape/{KIND}/1",
        "seed": seed,
        "problem": _plain(asdict(problem)),
        "start": _plain(asdict(start)),
    }


def _read(path: Path, problem: Problem, seed: int) -> Start:
    document = read_document(path, KIND).entries()
    if (document["seed"].integer(), document["problem"].value) != (seed, _plain(asdict(problem))):
        raise InputError(f"{path}: belongs to a search for another problem or with another seed; use another folder")
    start = document["start"].entries()
    return Start(
        index=start["index"].integer(),
        initial=tuple(map(float, start["initial"].numbers(5))),
        parameters=tuple(map(float, start["parameters"].numbers(5))),
        score=start["score"].number(),
        slack=start["slack"].number(),
        iterations=start["iterations"].integer(),
    )


def _plain(value: Any) -> Any:
    """Return the value as JSON would give it back."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value
