"""Arrays of numbers in NumPy's format from outside: the header is checked against the file and the memory before the data are read.

A header of a hundred bytes can state 10¹² numbers, for which NumPy would ask for memory. NumPy Enhancement Proposal 1.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake.memory_budget import check

#: Bytes per number of the array, of what is made of it in single precision, and of a copy.
NUMBER_BYTES = 12
#: What NumPy raises for headers that it cannot parse, besides ValueError; some come from Python's own tokenizer and parser.
HEADER_ERRORS = (EOFError, SyntaxError, TokenError, TypeError, KeyError, OverflowError, RecursionError, MemoryError)


def read_npy(path: Path) -> NDArray[Any]:
    """The array of integers or real numbers in a .npy file.

    Raises ValueError for what is none, or states another size than the file has, BadInputError for more than the memory, and OSError.
    """
    with path.open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of headers written by Python 2
        try:
            version = np.lib.format.read_magic(file)
            read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read_header(file)
            if dtype.kind not in "fiub" or any(n < 0 for n in shape):
                raise ValueError(f"it holds an array of shape {shape} of {dtype}")
            stated, there = math.prod(shape) * dtype.itemsize, path.stat().st_size - file.tell()
            if stated != there:
                raise ValueError(f"it states {stated} bytes and holds {there}")
            check(stated + NUMBER_BYTES * math.prod(shape), f"'{path}'")
            file.seek(0)
            return np.asarray(np.load(file, allow_pickle=False))
        except HEADER_ERRORS as error:
            raise ValueError(" ".join(str(error).split())[:200] or "damaged") from error
