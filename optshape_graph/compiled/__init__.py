"""What is compiled: loops over candidates, ring ends and samples, in C, each with its reference in NumPy.

A wheel for a platform has the library, and so has a checkout after `make compiled`. Where it is
absent the NumPy code runs alone, slower, and equal to rounding; `tests/compiled` compares the two. With the environment
variable OPTSHAPE_COMPILED=off it is left out.
"""

from __future__ import annotations

import ctypes
import os
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Ints
from optshape_graph.compiled.build import LIBRARY, is_whole

_KINDS = {"p": ctypes.c_void_p, "i": ctypes.c_int64, "d": ctypes.c_double}

_FUNCTIONS = {
    "edge_geometry": "ppippp",
    "propagate": "ppipppip",
    "best_poses": "piiippdpp",
    "log_components": "iiippppppppdpp",
    "firings_log_likelihood": "pipp",
    "rays_log_likelihood": "pippp",
    "differences": "iippp",
    "nearest_minima": "ipppip",
    "segment_starts": "ipppdddddp",
}
"""Kinds of the functions' arguments: pointers, whole numbers, numbers. All return a whole number."""


@cache
def library() -> ctypes.CDLL | None:
    """Return the compiled library; None where there is none of these sources, it does not load, or it is left out."""
    if os.environ.get("OPTSHAPE_COMPILED") == "off":
        return None
    try:
        if not is_whole(LIBRARY.read_bytes()):
            return None
        functions = ctypes.CDLL(str(LIBRARY))
    except OSError:  # it isn't there, or was made for another processor or another C library
        return None
    for name, kinds in _FUNCTIONS.items():
        function = getattr(functions, name)
        function.argtypes, function.restype = [_KINDS[kind] for kind in kinds], ctypes.c_int64
    return functions


def address(array: NDArray[Any]) -> int:
    """Return where the numbers of an array (...) are, row after row: each of 8 bytes, or of 1 where they are truths."""
    assert array.flags.c_contiguous, array.strides
    assert array.dtype.char in "dl?", array.dtype
    return array.ctypes.data


def structure(*fields: float | NDArray[Any]) -> Ints:
    """Lay out whole numbers, numbers, and addresses of arrays (...) as a C structure has them: (K,) of 8 bytes each."""
    laid = np.empty(len(fields), dtype=np.int64)
    numbers = laid.view(np.float64)
    for k, field in enumerate(fields):
        if isinstance(field, float):
            numbers[k] = field
        else:
            laid[k] = address(field) if isinstance(field, np.ndarray) else field
    return laid
