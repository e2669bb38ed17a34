"""`gsbake replace mesh LOWPOLY`: a low-poly mesh of another program, whose UVs are kept, in place of the mesh stage's own.

The dense mesh stays, or is replaced too by a file named dense.ply: materials, normals and occlusion are baked from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.errors import BadInputError, UsageError
from gsbake.geometry.cameras import Similarity
from gsbake.geometry.ply import has_texture_coordinates, write_mesh
from gsbake.gltf.frame import frame_between, read_transforms_json
from gsbake.gltf.lowpoly import SUFFIXES, read_lowpoly
from gsbake.pipeline.store import Artifact

MESH, DENSE = "mesh.ply", "dense.ply"


def is_lowpoly(path: Path) -> bool:
    """Whether a file is a low-poly mesh with UVs of its own; a PLY without UVs is an edited mesh, of all triangles."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES or path.name == DENSE or not path.is_file():
        return False
    return suffix != ".ply" or has_texture_coordinates(path)


def write_lowpoly(
    paths: Sequence[Path], base: Artifact | None, current: Mapping[str, Artifact | None], scratch: Path
) -> tuple[dict[str, Path], dict[str, Path], tuple[str, ...]]:
    """({file of the mesh stage: path}, those of the user that they were made of, notes) of a low-poly mesh, alone or with a dense.ply.

    `base` and `current` are the present outputs of the mesh stage and of others. Raises BadInputError, UsageError.
    """
    given = [path for path in paths if path.name != DENSE]
    if len(given) != 1 or len(paths) > 2:
        raise UsageError(f"Give one low-poly mesh, and beside it at most the dense mesh as {DENSE}.")
    dense = next((path for path in paths if path.name == DENSE), None)
    if dense is not None and not dense.exists():
        raise BadInputError(f"'{dense}' does not exist.")
    if dense is None and (base is None or DENSE not in base.files):
        raise UsageError(f"Stage 'mesh' has not run yet, so there is no dense mesh to bake from: run it first, or give one as {DENSE}.")
    source = dense if dense is not None else base.folder / DENSE  # type: ignore[union-attr]
    mesh = read_lowpoly(given[0], source, _asset_frame(current))
    target = scratch / MESH
    write_mesh(target, *mesh.split())
    files = {MESH: target} | ({} if dense is None else {DENSE: dense})
    return files, {MESH: given[0]}, (f"{given[0].name}: {mesh.notes[0]}", *mesh.notes[1:])


def _asset_frame(current: Mapping[str, Artifact | None]) -> Similarity | None:
    """The map from the unit frame to that of the present asset; None where there is none that fits."""
    poses, refine, export = (current.get(name) for name in ("poses", "refine", "export"))
    if poses is None or refine is None or export is None:
        return None
    try:
        cameras = PosedPhotos.open(poses.folder, refine.folder).cameras.cameras
        return frame_between(cameras, read_transforms_json(export.folder / "cameras.json"))
    except (BadInputError, OSError, ValueError, LookupError, TypeError):  # files that the user put there may be anything
        return None
