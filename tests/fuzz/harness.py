"""Fuzzing of one parser: inputs from hypothesis, a check of each outcome, and a printed count.

The number of inputs per parser is GSBAKE_FUZZ_INPUTS: small in the quick tests, which always try the same inputs; at least 10 000 in
`make stress`, which tries others each time. An outcome is a value, or one of the documented errors with one sentence.
"""

from __future__ import annotations

import copy
import os
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

#: Inputs per parser in the quick tests, and what the environment asks for.
QUICK_INPUTS = 100
INPUTS = int(os.environ.get("GSBAKE_FUZZ_INPUTS", QUICK_INPUTS))
#: Longest message of a documented error: names and values of a file are shortened in it.
MAX_MESSAGE = 9000
#: Most seconds of processor time for one input: what takes longer keeps a reader busy. Far above what a busy machine needs for the first
#: input, which loads kernels and fills caches. A child that reads has limits of its own.
MAX_SECONDS = 20.0

T = TypeVar("T")

#: Integers at which parsers go wrong: signs, sizes of types, counts that no file holds.
EDGES = tuple(
    sorted(
        {value + off for value in (0, 2**7, 2**8, 2**15, 2**16, 2**24, 2**31, 2**32, 2**63, 2**64) for off in (-1, 0, 1)}
        | {-(2**31), -(2**63), 10**400}
    )
)
edges = st.sampled_from(EDGES)
#: Numbers at which arithmetic goes wrong.
odd_floats = st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-320, 1e-45, 1e30, 1e300, -1e308, float("inf"), float("-inf"), float("nan")])
#: Text that hurts terminals, file systems and markup.
odd_text = st.one_of(
    st.text(max_size=20),
    st.sampled_from(
        [
            "",
            ".",
            "..",
            "/",
            "../../x",
            "a/b",
            "\x00",
            "\x1b[31m",
            "a\nb",
            "\u202e",
            "<b>",
            "'\"",
            "n" * 5000,
            "\udcff",
            "1e999",
            "NaN",
            "9" * 400,
        ]
    ),
)
#: Any JSON value, small.
json_values: st.SearchStrategy[Any] = st.recursive(
    st.one_of(st.none(), st.booleans(), edges, odd_floats, odd_text),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(odd_text, inner, max_size=4)),
    max_leaves=8,
)


def _packed(value: float, code: str) -> bytes:
    try:
        return struct.pack(code, value)
    except OverflowError:  # too large for single precision
        return b"\xff" * 4


def numbers_of_bytes() -> st.SearchStrategy[bytes]:
    """Edges and odd floats as they stand in binary files."""
    integers = st.builds(
        lambda value, size, order: (value % (1 << (8 * size))).to_bytes(size, order), edges, st.sampled_from([1, 2, 4, 8]),
        st.sampled_from(["little", "big"]),
    )  # fmt: skip
    floats = st.builds(_packed, odd_floats, st.sampled_from(["<f", ">f", "<d", ">d"]))
    return st.one_of(integers, floats, st.binary(min_size=1, max_size=16))


@st.composite
def damaged(draw: st.DrawFn, seeds: Sequence[bytes], most: int = 6) -> bytes:
    """One of the seeds with up to `most` edits: bytes overwritten, inserted, deleted, repeated or cut off."""
    data = bytearray(draw(st.sampled_from(list(seeds))))
    for _ in range(draw(st.integers(0, most))):
        at = draw(st.integers(0, max(0, len(data))))
        match draw(st.sampled_from(["write", "write", "flip", "insert", "delete", "repeat", "cut"])):
            case "write":
                new = draw(numbers_of_bytes())
                data[at : at + len(new)] = new
            case "flip" if at < len(data):
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "insert":
                data[at:at] = draw(numbers_of_bytes())
            case "delete":
                del data[at : at + draw(st.integers(1, 64))]
            case "repeat":
                data[at:at] = data[at : at + draw(st.integers(1, 64))] * draw(st.integers(1, 20))
            case "cut":
                del data[at:]
    return bytes(data)


def replaced_values(body: Any, most: int = 3) -> st.SearchStrategy[Any]:
    """The JSON document `body` with up to `most` of its values (at any depth) replaced, removed or renamed."""
    return st.builds(_replace, st.just(body), st.lists(st.tuples(st.integers(0, 10**6), json_values, st.integers(0, 9)), max_size=most))


def _replace(body: Any, edits: list[tuple[int, Any, int]]) -> Any:
    root = [copy.deepcopy(body)]
    for where, value, kind in edits:
        places: list[tuple[Any, Any]] = []
        stack: list[Any] = [root]
        while stack:
            inner = stack.pop()
            for key in list(inner) if isinstance(inner, dict) else range(len(inner)):
                places.append((inner, key))
                if isinstance(inner[key], dict | list):
                    stack.append(inner[key])
        container, key = places[where % len(places)]
        if kind == 0 and container is not root:
            del container[key]
        elif kind == 1 and isinstance(container, dict):
            container[str(value)[:50]] = container.pop(key)
        else:
            container[key] = copy.deepcopy(value)
    return root[0]


def outcome(call: Callable[[], T], *documented: type[Exception]) -> T | None:
    """The value of the call, or None for a documented error, whose message must be one line that says something."""
    try:
        return call()
    except documented as error:
        text = str(error)
        assert text.strip() and "\n" not in text and len(text) < MAX_MESSAGE, repr(text[:500])
        return None


def fuzz(capsys: pytest.CaptureFixture[str], title: str, inputs: st.SearchStrategy[T], check: Callable[[T], object]) -> None:
    """Run `check` on INPUTS inputs and print how many there were, and how many it accepted (returned something for)."""
    counts = Counter[str]()

    @settings(
        max_examples=INPUTS, deadline=None, database=None, derandomize=INPUTS <= QUICK_INPUTS, print_blob=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(inputs)
    def run(value: T) -> None:
        begin = time.process_time()
        accepted = check(value) is not None
        spent = time.process_time() - begin
        assert spent < MAX_SECONDS, f"one input took {spent:.1f} s"
        counts["inputs"] += 1
        counts["read"] += accepted

    run()
    with capsys.disabled():
        sys.stdout.write(
            f"\nfuzz: {title}: {counts['inputs']} inputs, 0 undocumented outcomes ({counts['read']} read, the others refused)\n"
        )
    assert counts["inputs"] >= INPUTS
