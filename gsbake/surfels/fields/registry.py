"""Fields by name, their construction, and their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsbake.surfels.fields.field import Field
from gsbake.surfels.fields.samples import SamplesField
from gsbake.surfels.model import Surfels


def make_field(surfels: Surfels, loss: Any) -> Field:
    """The field of new surfels; `loss` is the profile's section [loss]."""
    return SamplesField(surfels, loss)


def save_field(folder: Path, field: Field) -> None:
    """Write what the surfels' file does not hold: nothing, for samples."""


def load_field(folder: Path, surfels: Surfels, loss: Any) -> Field:
    """The field of the train or refine stage's `folder`, whose surfels these are."""
    return SamplesField(surfels, loss)
