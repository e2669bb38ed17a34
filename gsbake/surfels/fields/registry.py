"""Fields by the names that profiles use (`field.kind`), their construction, and their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from gsbake.config.schema import Coupling, DistanceField, Loss, Train
from gsbake.errors import BadInputError
from gsbake.surfels.field import Field
from gsbake.surfels.fields.continuous import ContinuousField
from gsbake.surfels.fields.grid import GridField
from gsbake.surfels.fields.hash import HashField
from gsbake.surfels.fields.known import Known, KnownDistance, SphereDistance
from gsbake.surfels.fields.mlp import MlpField
from gsbake.surfels.fields.octree import OctreeField
from gsbake.surfels.fields.samples import SamplesField
from gsbake.surfels.fields.tensor import TensorField
from gsbake.surfels.model import Surfels

#: Continuous fields by name; `samples` is the field of the surfels themselves.
FIELDS: dict[str, type[ContinuousField]] = {field.name: field for field in (GridField, OctreeField, TensorField, HashField, MlpField)}
#: File of a continuous field beside the surfels.
FILE = "field.safetensors"
FORMAT = "gsbake field 1, "
#: Radius (unit frame) of the sphere that a field starts from, where it does.
SPHERE_RADIUS = 1.0
#: Opacity of surfels of their own at the start.
INITIAL_OPACITY = 0.9


def make_field(surfels: Surfels, profile: Any, seed: int) -> Field:
    """The field of new surfels by the sections [field], [coupling], [train] and [loss] of `profile`.

    Beside a continuous field the surfels get an opacity of their own where `field.opacity` wants that.
    """
    settings = profile.field
    if settings.kind == SamplesField.name:
        return SamplesField(surfels, profile.loss, profile.train)
    known: Known = SphereDistance(SPHERE_RADIUS)
    if settings.start == "surfels":
        with torch.no_grad():
            centres, normals = surfels.position - surfels.sdf[:, None] * surfels.normal(), surfels.normal()
        known = KnownDistance(centres.cpu().numpy().astype(float), normals.cpu().numpy().astype(float))
    field = FIELDS[settings.kind](settings, profile.coupling, profile.loss, known.box)
    field.start(known, seed)
    field.make_radiance(seed)
    if settings.opacity == "own":
        surfels.attributes["opacity"] = torch.logit(torch.full((len(surfels),), INITIAL_OPACITY)).to(surfels.position)
    field.follow(surfels)
    return field


def save_field(folder: Path, field: Field) -> None:
    """Write a continuous field; that of the samples is in the surfels' file."""
    if isinstance(field, ContinuousField):
        tensors = {k: v.detach().contiguous().cpu().clone() for k, v in field.state().items()}
        # one key for both: with several their order in the file is by chance, and its digest with it
        save_file(tensors, str(folder / FILE), {"format": FORMAT + field.settings.model_dump_json()})


def load_field(folder: Path, surfels: Surfels, profile: Any = None, fine_tuning: bool = False) -> Field:
    """The field of the train or refine stage's `folder`, whose surfels these are, with the settings that it was made with.

    `profile` gives the sections [coupling], [loss] and [train] where training goes on, `fine_tuning` whether its schedules have ended.
    Raises BadInputError for a file that this version does not know.
    """
    coupling, loss, train = (Coupling(), Loss(), Train()) if profile is None else (profile.coupling, profile.loss, profile.train)
    path = folder / FILE
    if not path.exists():
        return SamplesField(surfels, loss, train, fine_tuning)
    try:
        with safe_open(str(path), "pt") as file:
            tensors = {k: file.get_tensor(k) for k in file.keys()}  # noqa: SIM118 (safetensors has no iterator)
            kind = (file.metadata() or {}).get("format", "")
        settings = DistanceField.model_validate_json(kind.removeprefix(FORMAT))
        field = FIELDS[settings.kind](settings, coupling, loss, (tensors["lower"].numpy(), tensors["upper"].numpy()))
        field.restore(tensors)
    except (SafetensorError, ValueError, KeyError) as error:
        raise BadInputError(f"{path} is damaged or of another version; run the stage again.") from error
    field.follow(surfels)
    return field
