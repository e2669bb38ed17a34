"""Lengths and known distances as people write them."""

from __future__ import annotations

import pytest

from gsbake.config.lengths import PixelPosition, parse_known_distance, parse_length
from gsbake.config.load import load_profile
from gsbake.errors import BadInputError


@pytest.mark.parametrize(
    ("text", "metres"), [("8cm", 0.08), (" 80 mm", 0.08), ("0.08", 0.08), (".5m", 0.5), ("2in", 0.0508), ("3. cm", 0.03)]
)
def test_lengths(text: str, metres: float) -> None:
    assert parse_length(text) == pytest.approx(metres, rel=1e-12)


@pytest.mark.parametrize("text", ["", "cm", "8 feet", "-8cm", "8,5cm", "0", "1e9", "99999m", "8cm 9cm", "nan", "inf"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"is no (plausible )?length"):
        parse_length(text)


def test_points_in_one_photo_and_in_several() -> None:
    found = parse_known_distance(" a/IMG 1.jpg:10,20.5+b.png:-3,4  IMG 1.jpg:7,8  8 cm ")
    assert found.first == (PixelPosition("a/IMG 1.jpg", 10, 20.5), PixelPosition("b.png", -3, 4))
    assert found.second == (PixelPosition("IMG 1.jpg", 7, 8),)
    assert found.metres == pytest.approx(0.08) and found.text == "a/IMG 1.jpg:10,20.5+b.png:-3,4  IMG 1.jpg:7,8  8 cm"


@pytest.mark.parametrize("text", ["", "8cm", "a:1,2 8cm", "a:1,2 b:3 8cm", "a:1,2 b:3,4", "a:1,2 b:x,4 8cm", "1,2 3,4 8cm"])
def test_what_is_no_known_distance_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is no known distance"):
        parse_known_distance(text)


def test_settings_name_what_is_wrong() -> None:
    loaded = load_profile("preview", ['scale.known_distances=["a:1,2 b:3,4 8cm"]'])
    assert loaded.profile.scale.known_distances == ("a:1,2 b:3,4 8cm",)
    with pytest.raises(BadInputError, match="scale.known_distances.*'far' is no known distance"):
        load_profile("preview", ['scale.known_distances=["far"]'])
