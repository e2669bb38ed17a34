"""The child process that reads an untrusted COLMAP model: see `limited_process`.

pycolmap trusts the counts in binary models: a file of 8 bytes can ask for 2⁶³ points. Here it may, under a limit on memory and time. It
ends names in `images.txt` at the first space, though they are the rest of the line; they are read here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsbake.capture.colmap import pycolmap
from gsbake.capture.poses.colmap_model import NEEDED, cloud
from gsbake.limited_process import limit_memory, serve
from gsbake.text import missing_list


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Names and camera models of the registered images of the model in "folder", whose arrays are written to the file "target" (NPZ).

    Errors: {"error": sentence}.
    """
    memory, name = int(request["memory"]), f"The COLMAP model {request['folder']} cannot be read"
    limit_memory(memory)
    try:
        return _read(Path(request["folder"]), Path(request["target"]))
    except MemoryError:
        return {"error": f"{name} (it needs more than {memory / 1e9:.0f} GB)."}
    except (ValueError, RuntimeError, OSError, IndexError, KeyError, TypeError, OverflowError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        return {"error": f"{name} ({text[-300:]})."}


def _read(folder: Path, target: Path) -> dict[str, Any]:
    model = pycolmap.Reconstruction(str(folder))
    images = [image for image in model.images.values() if image.has_pose]
    binary = all((folder / file).is_file() for file in NEEDED)
    text = {} if binary else text_names(folder / "images.txt")
    names = [text.get(image.image_id, image.name) for image in images]
    if unplaced := [name for name, image in zip(names, images, strict=True) if not _is_placed(image)]:
        return {
            "error": f"The COLMAP model {folder} has rigs in which cameras have no known place ({missing_list(unplaced)}); calibrate the "
            "rigs in COLMAP, or reconstruct without them."
        }
    lenses = [image.camera for image in images]
    width = max((len(lens.params) for lens in lenses), default=0)
    params = np.zeros((len(images), width))
    for row, lens in zip(params, lenses, strict=True):
        row[: len(lens.params)] = lens.params
    poses = [image.cam_from_world() for image in images]
    points, colours = cloud(model)
    np.savez(
        target,
        rotations=np.array([pose.rotation.matrix() for pose in poses], float).reshape(-1, 3, 3),
        translations=np.array([pose.translation for pose in poses], float).reshape(-1, 3),
        params=params,
        sizes=np.array([(min(lens.width, 2**40), min(lens.height, 2**40)) for lens in lenses], np.int64).reshape(-1, 2),
        points=points,
        colours=colours,
    )
    return {"names": names, "models": [lens.model_name for lens in lenses]}


def text_names(path: Path) -> dict[int, str]:
    """Name of each image in an `images.txt` by its number: the rest of the line. Two lines an image; the second, points, may be empty."""
    names = {}
    with path.open(encoding="utf-8", errors="surrogateescape") as file:
        for line in file:
            fields = line.strip().split(maxsplit=9)
            if fields and not fields[0].startswith("#"):
                names[int(fields[0])] = fields[9]
                next(file, None)
    return names


def _is_placed(image: Any) -> bool:
    """Whether the place of an image's camera in its rig is known: without it the image has no pose of its own."""
    rig, sensor = image.frame.rig, image.camera.sensor_id
    return bool(rig.is_ref_sensor(sensor) or rig.has_sensor_from_rig(sensor))


def main() -> None:
    """Answer requests until the parent closes the pipe."""
    serve(answer)
