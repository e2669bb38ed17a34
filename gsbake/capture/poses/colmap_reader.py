"""The child process that reads an untrusted COLMAP model: `python -m … MEMORY FOLDER OUT.npz`.

pycolmap trusts the counts in binary models: a file of 8 bytes can ask for 2⁶³ points. Here it may, under a limit on memory and time.
"""

from __future__ import annotations

import sys

import numpy as np

from gsbake.capture.poses.colmap_model import cloud
from gsbake.capture.sfm.colmap import pycolmap
from gsbake.limited_process import apply_limits, print_answer


def main() -> None:
    """Write the model's registered images, cameras and points as arrays."""
    apply_limits(int(sys.argv[1]))
    try:
        model = pycolmap.Reconstruction(sys.argv[2])
        images = [image for image in model.images.values() if image.has_pose]
        names = [image.name for image in images]
        lenses = [image.camera for image in images]
        width = max((len(lens.params) for lens in lenses), default=0)
        params = np.zeros((len(images), width))
        for row, lens in zip(params, lenses, strict=True):
            row[: len(lens.params)] = lens.params
        poses = [image.cam_from_world() for image in images]
        points, colours = cloud(model)
        np.savez(
            sys.argv[3],
            rotations=np.array([pose.rotation.matrix() for pose in poses], float).reshape(-1, 3, 3),
            translations=np.array([pose.translation for pose in poses], float).reshape(-1, 3),
            params=params,
            sizes=np.array([(min(lens.width, 2**40), min(lens.height, 2**40)) for lens in lenses], np.int64).reshape(-1, 2),
            points=points,
            colours=colours,
        )
        print_answer({"names": names, "models": [lens.model_name for lens in lenses]})
    except (ValueError, RuntimeError, OSError, IndexError, KeyError, TypeError, OverflowError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        print_answer({"error": text[-300:]})


if __name__ == "__main__":
    main()
