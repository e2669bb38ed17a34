"""Formatting of durations, sizes, numbers and lists."""

from __future__ import annotations

import pytest

from gsbake.errors import BadInputError
from gsbake.text import duration, figures, number, printable, shortlist, size


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.32, "0.3 s"), (9.94, "9.9 s"), (42.4, "42 s"), (59.7, "1 min 00 s"), (185, "3 min 05 s"), (3599.6, "1 h 00 min")],
)
def test_duration(seconds: float, text: str) -> None:
    assert duration(seconds) == text


@pytest.mark.parametrize(("count", "text"), [(480_000, "480 kB"), (3_200_000, "3.2 MB"), (1_250_000_000, "1.25 GB")])
def test_size(count: float, text: str) -> None:
    assert size(count) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (15_000, "15 000"), (15_000.0, "15 000"), (1.5e6, "1 500 000"), (-12_345, "-12 345"), (27.1234, "27.12"), (0.08213, "0.08213"),
        (0, "0"), (True, "yes"),
    ],
)
def test_number(value: float, text: str) -> None:
    assert number(value) == text


def test_figures_are_the_first_plain_results() -> None:
    assert figures({"psnr": 27.1234, "faces": 30000, "log": [1], "ok": True}) == "psnr 27.12, faces 30 000, ok yes"
    assert figures({"a": 1, "b": 2, "c": 3}, limit=2) == "a 1, b 2"


def test_shortlist() -> None:
    assert shortlist(["a", "b"]) == "a, b"
    assert shortlist(list("abcdef")) == "a, b, c, d and 2 more"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("naïve – 3 × ²", "naïve – 3 × ²"), ("", ""),
        ("\x1b[31mred\n", "\\x1b[31mred\\n"), ("\x9b2J", "\\x9b2J"), ("a\u202egpj.b", "a\\u202egpj.b"),
        ("\udcff", "\\udcff"), ("\u2028\U000e0001\x7f\0", "\\u2028\\U000e0001\\x7f\\x00"), ("a\xa0b", "a\\xa0b"),
    ],
)  # fmt: skip
def test_printable(text: str, shown: str) -> None:
    assert printable(text) == shown and printable(shown) == shown and shown.isprintable()


def test_messages_of_errors_are_printable() -> None:
    assert str(BadInputError("The photo \x1b]0;x\x07\n cannot be read.")) == "The photo \\x1b]0;x\\x07\\n cannot be read."
