"""Tangents of GLB files beside the reference implementation of MikkTSpace (npm package `mikktspace`, which `make node` installs).

python -m benchmarks.tangents GLB…

For every corner of every triangle of the file: the length of the difference between the file's tangent and the reference's for the same
positions, normals and texture coordinates, and whether their handedness agrees. Triangles without area, in space or in the texture, have no
tangent of their own and are left out. Exits 1 where more than one corner in a thousand differs by more than 1e-4, or any handedness does.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.timeline import ROOT
from gsbake.gltf.document import Document

MODULES = Path(os.environ.get("GSBAKE_NODE_MODULES", ROOT / ".venv" / "node" / "node_modules"))
#: Largest difference of unit vectors, and the share of corners that may exceed it.
TOLERANCE, SHARE = 1e-4, 1e-3
#: Least area of a triangle, as a share of the mean one.
MIN_AREA = 1e-6

SCRIPT = """
const m = require(process.argv[1] + '/mikktspace'), f = require('fs'), folder = process.argv[2];
const read = name => { const b = f.readFileSync(folder + '/' + name); return new Float32Array(b.buffer, b.byteOffset, b.length / 4); };
const found = m.generateTangents(read('position'), read('normal'), read('uv'));
f.writeFileSync(folder + '/tangent', Buffer.from(found.buffer, found.byteOffset, found.byteLength));
"""


@dataclass(frozen=True)
class Difference:
    """Of one file: its corners, the share of them that differs by more than the tolerance, quantile .999 and maximum of the difference,
    and how many have the other handedness."""

    corners: int
    share: float
    most: float
    largest: float
    handedness: int

    @property
    def passes(self) -> bool:
        """Whether the file's tangents are those of the reference."""
        return self.share <= SHARE and not self.handedness


def reference(position: NDArray[Any], normal: NDArray[Any], uv: NDArray[Any]) -> NDArray[np.float32]:
    """MikkTSpace's tangents (n, 3, 4) at the corners of n triangles: `position`, `normal` (n, 3, 3), `uv` (n, 3, 2) upwards.

    Raises RuntimeError when Node or the package is not there.
    """
    node = shutil.which("node", path=str(Path(sys.executable).parent)) or shutil.which("node")
    if node is None or not (MODULES / "mikktspace").is_dir():
        raise RuntimeError("the npm package mikktspace is not installed: run `make node`")
    with tempfile.TemporaryDirectory() as folder:
        for name, values in (("position", position), ("normal", normal), ("uv", uv)):
            (Path(folder) / name).write_bytes(np.ascontiguousarray(values, "<f4").tobytes())
        subprocess.run([node, "-e", SCRIPT, str(MODULES), folder], check=True)
        return np.fromfile(Path(folder) / "tangent", "<f4").reshape(-1, 3, 4)


def difference(path: Path) -> Difference:
    """The difference of all meshes of a GLB file together. Raises RuntimeError for a mesh without tangents."""
    document, found = Document.open(path), []
    for mesh in document.json["meshes"]:
        for primitive in mesh["primitives"]:
            names = primitive["attributes"]
            if "TANGENT" not in names:
                raise RuntimeError(f"{path}: the mesh {mesh.get('name', '')} has no tangents")
            faces = document.accessor(primitive["indices"]).reshape(-1, 3).astype(np.int64)
            keys = ("POSITION", "NORMAL", "TEXCOORD_0", "TANGENT")
            position, normal, uv, tangent = (np.asarray(document.accessor(names[key]), np.float64)[faces] for key in keys)
            keep = (_area(position) > MIN_AREA) & (_area(np.dstack([uv, np.zeros(uv.shape[:2])])) > MIN_AREA)
            uv[..., 1] = 1 - uv[..., 1]  # glTF stores v downwards
            theirs = reference(position, normal, uv)
            found.append(np.dstack([np.linalg.norm(tangent[..., :3] - theirs[..., :3], axis=2), tangent[..., 3] != theirs[..., 3]])[keep])
    length, other = np.concatenate(found).reshape(-1, 2).T
    above, most = float((length > TOLERANCE).mean()), float(np.quantile(length, 0.999))
    return Difference(len(length), above, most, float(length.max()), int(other.sum()))


def _area(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Areas (n,) of triangles (n, 3, 3), as shares of their mean."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.asarray(area / max(float(area.mean()), 1e-300))


def main() -> None:
    """Print a line per file."""
    parser = argparse.ArgumentParser(description="Tangents of GLB files beside the reference implementation.")
    parser.add_argument("files", type=Path, nargs="+", metavar="GLB")
    failed = False
    for path in parser.parse_args().files:
        found = difference(path)
        failed |= not found.passes
        print(
            f"{path}: {found.corners} corners, {found.share:.3%} above {TOLERANCE:g}, quantile .999 {found.most:.1e}, "
            f"largest {found.largest:.1e}, handedness of {found.handedness} differs"
        )
    sys.exit(failed)


if __name__ == "__main__":
    main()
