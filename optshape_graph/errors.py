"""Exceptions of the package: every error that a caller may handle derives from one class."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import NoneType


class OptshapeError(Exception):
    """Base class of every exception that the package raises on purpose."""


class InputError(OptshapeError, ValueError):
    """Input that cannot be used: the message names the source, the value found and what was expected."""


class AnotherSensorError(InputError):
    """A cloud whose rings are not those of the sensor that it is said to be of.

    Attributes:
        name: the cloud's source.
        found: what shows it, in words.
    """

    def __init__(self, message: str, name: str = "", found: str = "") -> None:
        super().__init__(message)
        self.name, self.found = name, found


class EstimationError(OptshapeError):
    """No estimate can be made from an input that is well formed (too few returns, one visible edge, ...)."""


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


def expect(what: str, value: object, *kinds: type) -> None:
    """Check the type of an argument.

    Args:
        what: its name.
        value: what was given.
        kinds: what may be given.

    Raises:
        InputError: none of them.
    """
    if not isinstance(value, kinds):
        names = " or ".join("None" if kind is NoneType else kind.__name__ for kind in kinds)
        raise InputError(f"{what}: expected {names}, found {type(value).__name__} {value!r:.40}")


@contextmanager
def importing_matplotlib(extra: str) -> Iterator[None]:
    """Turn errors of a block that imports matplotlib into errors of this package.

    Args:
        extra: the extra of this package that brings it.

    Raises:
        MissingExtraError: matplotlib is absent.
        InputError: its settings are wrong.
    """
    try:
        yield
    except ImportError as cause:
        raise missing_extra("matplotlib", extra, cause) from cause
    except ValueError as error:  # from its settings, including the environment
        raise InputError(f"matplotlib does not start: {error} (is the variable MPLBACKEND wrong?)") from error


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
