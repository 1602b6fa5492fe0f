"""Tasks in batches; results of numbered tasks: in order, lost with their worker, or made on one thread."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Generic, TypeVar

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Lost:
    """Stands for the result of a task whose worker was killed twice.

    Attributes:
        reason: in words.
    """

    reason: str


def batches(items: Iterable[T], size: int) -> Iterator[tuple[T, ...]]:
    """Yield items in their order, so many at a time; the last ones may be fewer.

    Args:
        items: of any number.
        size: of a batch.
    """
    rest = iter(items)
    while batch := tuple(islice(rest, size)):
        yield batch


def in_order(results: Iterable[tuple[int, R]], first: int = 0) -> Iterator[R]:
    """Yield results that come with their numbers, in any order, in the order of the numbers.

    Args:
        results: numbers `first`, `first` + 1, ... with what belongs to them.
        first: the lowest number.
    """
    waiting: dict[int, R] = {}
    for number, result in results:
        waiting[number] = result
        while first in waiting:
            yield waiting.pop(first)
            first += 1


class OneThread(Generic[T, R]):
    """A function that runs on one thread of linear algebra, since sums depend on how threads split them.

    Args:
        function: of a task.
    """

    def __init__(self, function: Callable[[T], R]) -> None:
        self.function = function

    def __call__(self, task: T) -> R:
        try:
            from threadpoolctl import threadpool_limits
        except ImportError:  # without the extra `evaluate`
            return self.function(task)
        with threadpool_limits(1):
            return self.function(task)
