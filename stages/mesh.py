"""Surfels to a mesh: depth maps rendered at the photos' poses, one distance field, marching cubes, clean-up, decimation."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbake.pipeline.errors import BadInputError
from gsbake.pipeline.skip import leave_out, wanted
from gsbake.pipeline.stage import Context, Stage

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.geometry.cameras import Camera
    from gsbake.meshing.depth_cache import ViewSpool
    from gsbake.meshing.resolution import Resolution
    from gsbake.meshing.support_plane import Support
    from gsbake.meshing.tsdf import SparseTsdf

#: The object lives in the unit sphere; a little more, so that its outermost point is not cut.
BALL = 1.05
#: Truncation in cells, at least and at most; between them three times the depth noise.
TRUNCATION_CELLS = (4.0, 10.0)
#: Stereo replaces a rendered depth that it agrees with to this many cells.
MEASURED_CELLS = 3.0
#: Photos that are compared with one another are kept in memory up to so many bytes.
PHOTO_BYTES = 1 << 29
#: Surfels below this share of the transfer's peak opacity say nothing about where the object is.
MIN_OPACITY = 0.05
#: Holes with more border edges than this are openings, not holes, when nothing tells inside from outside.
MAX_HOLE_EDGES = 400


def run(ctx: Context) -> dict[str, Any]:
    """Write `dense.ply` and `mesh.ply`; return counts, the cell and the errors."""
    import tempfile

    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.meshing.depth_cache import ViewSpool

    posed = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["refine"])
    points, normals, weights = _samples(ctx.inputs["refine"])
    lower, upper, resolution = _choose(ctx, posed, points)
    with tempfile.TemporaryDirectory(dir=ctx.checkpoint, prefix="depth-") as folder:
        spool = ViewSpool(Path(folder))
        with ctx.part("depth"):
            _render(ctx, posed, spool, resolution)
        noise = _noise(spool)
        cells = min(max(3 * noise / resolution.cell, TRUNCATION_CELLS[0]), TRUNCATION_CELLS[1])
        evidence = f"median depth difference between neighbouring views {noise / resolution.cell:.2f} cells"
        ctx.decide("truncation", f"{cells:.1f} cells", evidence)
        support = _support(ctx, posed, points, normals, weights)
        field = _field(ctx, spool, lower, upper, resolution, cells * resolution.cell, posed.has_masks, support, (points, normals, weights))
        with ctx.part("marching"):
            dense = field.mesh(close=ctx.settings.mesh.holes == "close")
        del field
        if len(dense[1]) == 0:
            raise BadInputError(
                "mesh: the trained surfels show no surface inside the object's sphere; look at the training figures in the report, "
                "give masks, or train longer (train.iterations)."
            )
        return _finish(ctx, dense, posed, spool, resolution, noise, support)


def _samples(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The surfels on their zero set: points (n, 3), outward normals (n, 3), weights (n,) by area and opacity; those in the ball."""
    import numpy as np

    from gsbake.surfels.model import Surfels

    surfels = Surfels.load(folder / "surfels.safetensors")
    normal = surfels.normal().detach().cpu().numpy().astype(np.float64)
    sdf = surfels.sdf.detach().cpu().numpy().astype(np.float64).reshape(-1, 1)
    points = surfels.position.detach().cpu().numpy().astype(np.float64) - sdf * normal
    weights = surfels.scale.detach().cpu().numpy().astype(np.float64).prod(1)
    opacity = surfels.opacity().detach().cpu().numpy().astype(np.float64).reshape(-1)
    keep = np.isfinite(points).all(1) & (np.linalg.norm(points, axis=1) <= BALL) & (opacity > MIN_OPACITY * surfels.transfer.peak)
    if keep.sum() < 10:
        raise BadInputError("mesh: fewer than ten surfels lie in the object's sphere; the training failed, see its figures in the report.")
    weights = (weights * opacity)[keep]
    return points[keep], normal[keep], weights / max(float(np.median(weights)), 1e-12)


def _choose(ctx: Context, posed: PosedPhotos, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], Resolution]:
    """The object's box, padded, and the cell, with its reason logged."""
    import numpy as np

    from gsbake.meshing.resolution import choose, pixel_footprint, surfel_spacing

    lower, upper = points.min(0), points.max(0)
    cameras = [camera.within(ctx.settings.train.max_size) for camera in posed.cameras.cameras]
    settings = ctx.settings.mesh
    resolution = choose(
        float((upper - lower).max()),
        surfel_spacing(points),
        pixel_footprint(cameras, (lower + upper) / 2),
        settings.resolution,
        settings.max_resolution,
    )
    ctx.decide("field resolution", f"{resolution.cells} cells of {resolution.cell:.4g}", resolution.reason)
    pad = 16 * resolution.cell  # room for the truncation and for the survey's border layers
    return np.maximum(lower - pad, -BALL - pad), np.minimum(upper + pad, BALL + pad), resolution


def _render(ctx: Context, posed: PosedPhotos, spool: ViewSpool, resolution: Resolution) -> None:
    """Depth and normals at every photo's pose into the spool; depths that stereo measured replace rendered ones that they agree with."""
    from gsbake.meshing.depth_views import DepthView
    from gsbake.meshing.stereo_depth import with_measured
    from gsbake.mvs.depth_maps import read_depth
    from gsbake.surfels.raster.render import SurfelRenderer

    renderer = SurfelRenderer.load(ctx.inputs["refine"], ctx.device)
    stereo = ctx.inputs.get("stereo")
    shares: list[float] = []
    for index in range(len(posed)):
        ctx.check_stop()
        photo = posed.view(index, ctx.settings.train.max_size)
        buffers = renderer.gbuffer(photo.camera)
        view = DepthView.from_gbuffer(photo.camera, buffers, photo.mask, TRUNCATION_CELLS[0] * resolution.cell)
        measured = None if stereo is None else stereo / "depth" / f"{photo.camera.name}.npz"
        if measured is not None and measured.exists():
            view, share = with_measured(view, *read_depth(measured), MEASURED_CELLS * resolution.cell)
            shares.append(share)
        spool.append(view, buffers["normal"])
        ctx.progress(index + 1, len(posed), "depth maps")
    if shares:
        share = 100 * sum(shares) / len(shares)
        ctx.decide("depth", f"{share:.0f} % from stereo", f"there it agrees with the rendered depth to {MEASURED_CELLS:g} cells")


def _support(
    ctx: Context, posed: PosedPhotos, points: NDArray[np.float64], normals: NDArray[np.float64], weights: NDArray[np.float64]
) -> Support | None:
    """What the object stands on, which is left out of the mesh; not looked for where masks tell the object apart."""
    import numpy as np

    from gsbake.meshing.support_plane import find_support

    if posed.has_masks or ctx.settings.mesh.support == "keep":
        return None
    centres = np.stack([camera.centre for camera in posed.cameras.cameras])
    found, evidence = find_support(points, normals, weights, centres, ctx.seed)
    ctx.decide("support", "part of the object" if found is None else "left out", evidence)
    return found


def _noise(spool: ViewSpool) -> float:
    """Median disagreement (unit frame) of neighbouring views' depths; 0 when no two views overlap."""
    import numpy as np

    from gsbake.meshing.depth_views import depth_noise

    views = range(0, len(spool), max(1, len(spool) // 12))
    directions = np.stack([spool.view(index).camera.view_direction for index in range(len(spool))])
    gaps = []
    for index in views:
        closeness = directions @ directions[index]
        closeness[index] = -2
        gap = depth_noise(spool.view(index), spool.view(int(closeness.argmax())))
        if gap is not None:
            gaps.append(gap)
    return float(np.median(gaps)) if gaps else 0.0


def _field(
    ctx: Context,
    spool: ViewSpool,
    lower: NDArray[np.float64],
    upper: NDArray[np.float64],
    resolution: Resolution,
    truncation: float,
    masks: bool,
    support: Support | None,
    samples: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
) -> SparseTsdf:
    """The distance field, from depth maps or from the surfels' own samples."""
    import numpy as np

    from gsbake.meshing.imls import imls_field
    from gsbake.meshing.tsdf import SparseTsdf

    field = SparseTsdf(lower, upper, resolution.cell, truncation, ball=BALL, solid=masks or support is not None, support=support)
    with ctx.part("survey"):
        for done, view in enumerate(spool):
            ctx.check_stop()
            field.survey(view)
            ctx.progress(done + 1, 2 * len(spool), "fusing")
    with ctx.part("filling"):
        field.allocate(everywhere=not wanted(ctx, "far_cells", holds=True))
    with ctx.part("fusion"):
        if ctx.settings.mesh.field == "imls":
            points, normals, weights = samples
            field.set_field(imls_field(field.lattice, points, normals, truncation, weights))
        else:
            for done, view in enumerate(spool):
                ctx.check_stop()
                field.integrate(view)
                ctx.progress(len(spool) + done + 1, 2 * len(spool), "fusing")
    cells = f"{100 * field.near_share:.1f} % of the grid's {np.prod(field.lattice.samples) / 1e6:.1f} million cells lie near the surface"
    leave_out(ctx, "far_cells", True, f"{cells}; those filled take {field.nbytes / 1e6:.0f} MB", "far cells left out", "all cells filled")
    return field


def _finish(
    ctx: Context,
    dense: tuple[NDArray[np.float64], NDArray[np.int32]],
    posed: PosedPhotos,
    spool: ViewSpool,
    resolution: Resolution,
    noise: float,
    support: Support | None,
) -> dict[str, Any]:
    """Clean, refine along the normals, fit to the masks, decimate, write."""
    from gsbake.meshing import cleanup as clean
    from gsbake.meshing.ply import write_ply
    from gsbake.meshing.support_plane import drop_surroundings

    settings = ctx.settings.mesh
    vertices, faces = dense
    with ctx.part("clean"):
        around = 0
        if support is not None:
            vertices, faces, around = drop_surroundings(vertices, faces, BALL - 3 * resolution.cell)
            vertices = support.ground(vertices, resolution.cell)
        vertices, faces, dropped = clean.drop_small(vertices, faces, settings.min_component)
        if settings.normal_reach > 0:
            vertices = _follow(spool, vertices, faces, settings.normal_reach, resolution.cell)
        vertices = clean.smooth(vertices, faces, settings.smooth)
        shape = clean.topology(vertices, faces)
        if not shape.watertight:
            vertices, faces = clean.repair(vertices, faces)
            if settings.holes == "close":
                vertices, faces = clean.close_holes(vertices, faces, MAX_HOLE_EDGES)
            shape = clean.topology(vertices, faces)
    with ctx.part("silhouettes"):
        vertices = _polish(ctx, posed, vertices, faces)
    with ctx.part("photos"):
        vertices, agreed = _agree(ctx, posed, vertices, faces, resolution.cell)
    write_ply(ctx.out / "dense.ply", vertices, faces)
    ctx.check_stop()
    with ctx.part("decimate"):
        low_vertices, low_faces, error = clean.decimate(vertices, faces, settings.faces)
        low = clean.topology(low_vertices, low_faces)
        if low.non_manifold_edges:
            low_vertices, low_faces = clean.repair(low_vertices, low_faces)
            low = clean.topology(low_vertices, low_faces)
        write_ply(ctx.out / "mesh.ply", low_vertices, low_faces)
    if error > 2 * resolution.cell:
        ctx.warn(
            f"mesh: decimation to {len(low_faces)} faces moves the surface by up to {error / resolution.cell:.1f} cells; "
            "raise mesh.faces to keep it."
        )
    return {
        "vertices": len(low_vertices),
        "faces": len(low_faces),
        "dense_vertices": len(vertices),
        "dense_faces": len(faces),
        "cell": resolution.cell,
        "cells": resolution.cells,
        "depth_noise_cells": noise / resolution.cell,
        "components": low.components,
        "dropped_components": dropped + around,
        "watertight": low.watertight,
        "border_edges": low.border_edges,
        "decimation_error_cells": error / resolution.cell,
        **agreed,
    }


def _follow(
    spool: ViewSpool, vertices: NDArray[np.float64], faces: NDArray[np.int32], reach: float, cell: float
) -> NDArray[np.float64]:
    """Move the dense vertices so that they agree with the normals that the views show."""
    from gsbake.meshing.refinement.normals import NormalGather, follow_normals

    gather = NormalGather(vertices, tolerance=3 * cell)
    for index, view in enumerate(spool):
        gather.add(view, spool.normal(index))
    target, trust = gather.normals()
    return follow_normals(vertices, faces, target, trust, reach * cell, limit=1.5 * cell)


def _polish(ctx: Context, posed: PosedPhotos, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Vertices moved until the silhouettes meet the masks, where every photo has one."""
    from gsbake.meshing.refinement.silhouette import polish

    rounds = ctx.settings.mesh.silhouette_rounds
    if not rounds or not posed.has_masks:
        ctx.decide("silhouettes", "left as they are", "not every photo has a mask" if rounds else "the profile asks for no rounds")
        return vertices

    def views() -> Iterator[tuple[Camera, NDArray[np.uint8]]]:
        for index in range(len(posed)):
            ctx.check_stop()
            view = posed.view(index)
            if view.mask is not None:
                yield view.camera, view.mask

    polished = polish(vertices, faces, views, rounds, ctx.threads)
    if polished.rims == 0:
        ctx.decide("silhouettes", "left as they are", "the mesh's outline lies near the masks' border hardly anywhere")
    else:
        evidence = f"{polished.rims} rim points, in the median {polished.before:+.2f} px from the masks' border, now {polished.after:+.2f}"
        ctx.decide("silhouettes", "surface moved to the masks", evidence)
    return polished.vertices


def _agree(
    ctx: Context, posed: PosedPhotos, vertices: NDArray[np.float64], faces: NDArray[np.int32], cell: float
) -> tuple[NDArray[np.float64], dict[str, float]]:
    """Vertices moved until photos of textured places agree, where stereo confirmed depths; with figures for the manifest."""
    from functools import lru_cache

    from gsbake.meshing.refinement.photometric import agree
    from gsbake.meshing.refinement.photometric_measure import Capture
    from gsbake.mvs.depth_maps import read_depth
    from gsbake.mvs.pyramids import Photo, load_photo

    rounds, size, folder = ctx.settings.mesh.photometric_rounds, ctx.settings.stereo.max_size, ctx.inputs.get("stereo")
    files = [] if folder is None else [folder / "depth" / f"{camera.name}.npz" for camera in posed.cameras.cameras]
    if not rounds or not any(file.exists() for file in files):
        ctx.decide("photometric polish", "left out", "stereo confirmed no depths" if rounds else "the profile asks for no rounds")
        return vertices, {}
    cameras = [camera.within(size) for camera in posed.cameras.cameras]

    @lru_cache(maxsize=max(8, PHOTO_BYTES // (2 * max(c.width * c.height for c in cameras))))
    def photo(index: int) -> Photo:
        ctx.check_stop()
        return load_photo(posed, index, size)

    capture = Capture(cameras, photo, lambda index: read_depth(files[index]) if files[index].exists() else None, MEASURED_CELLS * cell)
    agreed = agree(vertices, faces, capture, rounds, ctx.threads)
    evidence = f"{100 * agreed.share:.0f} % of the places look alike in most photos"
    if agreed.rounds:
        evidence += f": moved by {agreed.move:.2f} px in the median, their NCC was {agreed.before:.3f} and is {agreed.after:.3f}"
        ctx.decide("photometric polish", "surface moved to where photos agree", evidence)
    else:
        ctx.decide("photometric polish", "left as it is", f"{evidence}, and moving it gains nothing there")
    return agreed.vertices, {
        "photometric_share": agreed.share,
        "photometric_move_pixels": agreed.move,
        "photometric_ncc_before": agreed.before,
        "photometric_ncc_after": agreed.after,
    }


STAGE = Stage(
    name="mesh",
    version=5,
    title="Mesh",
    run=run,
    needs=("poses", "stereo", "refine"),
    settings=("mesh.*", "train.max_size", "stereo.max_size", "skip.far_cells"),
    uses_device=True,
)
