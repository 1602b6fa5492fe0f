"""Exceptions of the package: every error a caller is expected to handle derives from one class."""

from __future__ import annotations


class OptshapeError(Exception):
    """Base class of every exception that the package raises on purpose."""


class InputError(OptshapeError, ValueError):
    """Input that cannot be used: the message names the source, the value found and what was expected."""


class EstimationError(OptshapeError):
    """A well-formed input from which no estimate can be made (too few returns, one visible edge, ...)."""


class UnobservableError(EstimationError):
    """The measurements leave directions of the unknowns undetermined.

    Attributes:
        directions: one line per undetermined direction, in words.
    """

    def __init__(self, message: str, directions: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.directions = directions


class MissingExtraError(OptshapeError, ImportError):
    """An optional library is needed and absent; the message is the command that installs it."""


def missing_extra(library: str, extra: str, cause: ImportError) -> MissingExtraError:
    """Return the error for an absent (or unloadable) optional library.

    Args:
        library: the distribution that could not be imported.
        extra: the extra of this package that brings it.
        cause: what the import raised; its text is kept, since a missing system library shows only there.
    """
    return MissingExtraError(
        f"{library} could not be imported ({cause}); install it with: pip install 'optshape-graph[{extra}]'"
    )
