"""The pictures of the documentation, made from a finished run of the built-in capture.

gsbake synth out/pictures/capture --views 40 --size 400
gsbake run out/pictures/capture --profile relight --out out/pictures/run
python docs/pictures.py out/pictures/run

Writes docs/guide/img/*.webp and docs/concepts/img/*.webp.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsbake.capture.posed_photos import PosedPhotos
from gsbake.gltf.frame import read_transforms_json
from gsbake.imaging.srgb import encode
from gsbake.report import compose
from gsbake.report.asset import open_asset
from gsbake.report.lights import procedural
from gsbake.report.quality import compare
from gsbake.report.render import Renderer
from gsbake.report.sheets import downsample, uv_atlas_image

Image = NDArray[np.float32]

ROOT = Path(__file__).parent
GUIDE, CONCEPTS = ROOT / "guide" / "img", ROOT / "concepts" / "img"
#: Grey (sRGB value) behind cut-out pictures, and the width of the gap between two.
GREY, GAP = 0.93, 6


def row(*pictures: Image) -> Image:
    """Pictures of one height side by side."""
    gap = np.full((pictures[0].shape[0], GAP, 3), 1, np.float32)
    parts = [part for picture in pictures for part in (gap, picture)]
    return np.concatenate(parts[1:], 1).astype(np.float32)


def column(*pictures: Image) -> Image:
    """Pictures of one width below one another."""
    gap = np.full((GAP, pictures[0].shape[1], 3), 1, np.float32)
    parts = [part for picture in pictures for part in (gap, picture)]
    return np.concatenate(parts[1:], 0).astype(np.float32)


def square(picture: Image, edge: int) -> Image:
    """The picture at `edge` x `edge` pixels."""
    return np.asarray(cv2.resize(picture, (edge, edge), interpolation=cv2.INTER_AREA), np.float32)


def labelled(picture: Image, text: str) -> Image:
    """The picture with a line of text below it."""
    strip = np.full((26, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(strip, text, (4, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (64, 64, 64), 1, cv2.LINE_AA)
    return np.concatenate([picture, strip / np.float32(255)], 0).astype(np.float32)


def save(path: Path, picture: Image, quality: int = 84) -> None:
    """Write a WebP file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.clip(picture * 255 + 0.5, 0, 255).astype(np.uint8)[..., ::-1]
    if not cv2.imwrite(str(path), pixels, [cv2.IMWRITE_WEBP_QUALITY, quality]):
        raise SystemExit(f"{path} cannot be written")


def heat(values: Image, inside: NDArray[np.bool_]) -> Image:
    """A depth map in colours, near is bright; grey where there is none."""
    low, high = np.percentile(values[inside], [1, 99])
    coded = (np.clip((high - values) / (high - low), 0, 1) * 255).astype(np.uint8)
    colour = cv2.applyColorMap(coded, cv2.COLORMAP_VIRIDIS)[..., ::-1].astype(np.float32) / np.float32(255)
    return np.where(inside[..., None], colour, np.float32(GREY)).astype(np.float32)


def main(out: Path) -> None:
    """Make all pictures from the run in `out`."""
    stage = {path.parent.name: path for path in sorted((out / "stages").glob("*/*"), key=lambda path: path.stat().st_mtime)}
    asset = open_asset(stage["export"] / "asset.glb")
    cameras = read_transforms_json(stage["export"] / "cameras.json")
    posed = PosedPhotos.open(stage["poses"], stage["refine"])
    renderer = Renderer(asset)
    learnt = compose.learnt_shader(stage["bake"] / "light.safetensors", compose.light_rotation(cameras[0], posed.cameras.cameras[0]))

    def photo(index: int, edge: int) -> Image:
        view = posed.view(index, edge)
        share = np.ones(view.rgb.shape[:2]) if view.mask is None else view.mask / 255
        picture = view.rgb / 255 * share[..., None] + GREY * (1 - share[..., None])
        return square(picture.astype(np.float32), edge)

    direction = compose.viewpoints(asset, cameras, 1)[0]
    wide = compose.framing_camera(asset, direction, 300)
    shaders = {"its own light": learnt, "studio": procedural("Studio"), "sunset": procedural("Sunset")}
    lit = {name: np.asarray(renderer.draw(wide, shader, 3).over(GREY), np.float32) for name, shader in shaders.items()}

    small = [photo(i * len(posed) // 4, 147) for i in range(4)]
    four = column(row(*small[:2]), row(*small[2:]))
    panels = {"photos": four, **lit}
    save(GUIDE / "overview.webp", row(*(labelled(picture, name) for name, picture in panels.items())))

    many = [photo(i * len(posed) // 12, 128) for i in range(12)]
    save(GUIDE / "photos.webp", column(row(*many[:6]), row(*many[6:])))

    held = len(posed) // 2
    view = posed.view(held, 320)
    drawn = renderer.draw(cameras[held].scaled(view.camera.width, view.camera.height), learnt, 3)
    metrics = compare(view, drawn)
    error = np.abs(metrics.photo - metrics.render).mean(-1, keepdims=True) * 4
    parts = {"photo": metrics.photo, "asset": metrics.render, "difference x 4": np.repeat(error, 3, axis=2)}
    save(GUIDE / "comparison.webp", row(*(labelled(np.asarray(p, np.float32), name) for name, p in parts.items())))

    orm = asset.orm if asset.orm is not None else np.ones((1, 1, 3), np.float32)
    maps: dict[str, Image] = {"base colour": np.asarray(encode(asset.base_color), np.float32)}
    if asset.normal_map is not None:
        maps["normal"] = 0.5 + 0.5 * asset.normal_map
    maps |= {name: np.repeat(orm[..., k : k + 1], 3, axis=2) for k, name in ((1, "roughness"), (2, "metallic"))}
    maps["UV atlas"] = uv_atlas_image(asset)
    save(GUIDE / "maps.webp", row(*(labelled(square(downsample(image, 512), 220), name) for name, image in maps.items())))

    name = Path(posed.view(0, 320).camera.name).stem
    found = np.load(next((stage["stereo"] / "depth").glob(f"{name}*.npz")))["depth"].astype(np.float32)
    edge = max(found.shape)
    save(
        CONCEPTS / "stereo.webp",
        row(labelled(square(photo(0, edge), 320), "photo"), labelled(square(heat(found, found > 0), 320), "confirmed depth")),
    )

    buffers = renderer.draw(wide, learnt, 3)
    alpha = buffers.alpha[..., None]

    def cut(picture: Image) -> Image:
        return np.asarray(picture * alpha + GREY * (1 - alpha), np.float32)

    shown = {
        "normals": cut(0.5 + 0.5 * buffers.normal),
        "base colour": cut(np.asarray(encode(buffers.base_color), np.float32)),
        "roughness": cut(np.repeat(buffers.orm[..., 1:2], 3, axis=2)),
        "metallic": cut(np.repeat(buffers.orm[..., 2:3], 3, axis=2)),
    }
    save(CONCEPTS / "materials.webp", row(*(labelled(picture, key) for key, picture in shown.items())))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
