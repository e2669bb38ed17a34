"""Stage mesh: surfels → a dense and a low-poly mesh."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage


def run(ctx: Context) -> dict[str, Any]:
    """See `gsbake.meshing.extract.extract_mesh`."""
    from gsbake.meshing.extract import MeshOptions, extract_mesh

    s = ctx.settings
    options = MeshOptions(
        s.mesh,
        s.train.max_size,
        s.stereo.max_size,
        s.stereo.min_scale,
        s.skip.empty_cells,
        s.surfels.projected_depth,
        s.export.max_triangles,
        s.train.holdout,
    )
    return extract_mesh(
        ctx.inputs["poses"], ctx.inputs["refine"], ctx.out, options, ingest=ctx.inputs["ingest"], stereo=ctx.inputs["stereo"],
        seed=ctx.seed, threads=ctx.threads, device=ctx.device, scratch=ctx.checkpoint, monitor=ctx,
    )  # fmt: skip


#: Modules with the kernels of this stage, with those of the shape's refinement, and with one that only depths of stereo need.
KERNELS = (
    "gsbake.meshing.fusion_kernel", "gsbake.meshing.depth_views", "gsbake.meshing.hole_filling", "gsbake.geometry.sparse_lattice",
    "gsbake.meshing.marching_cubes", "gsbake.meshing.refinement.normals", "gsbake.geometry.surface_distance",
    "gsbake.geometry.self_intersection", "gsbake.meshing.untangling",
)  # fmt: skip
REFINEMENT_KERNELS = (
    "gsbake.shape_refinement.samples_kernel", "gsbake.shape_refinement.reflection_kernel", "gsbake.shape_refinement.surface",
)  # fmt: skip
STEREO_KERNELS = ("gsbake.meshing.refinement.photometric_kernel",)


def kernels(settings: Any) -> tuple[str, ...]:
    """Modules with the kernels that these settings need."""
    if not settings.mesh.refinement_vertices:
        return KERNELS
    return KERNELS + REFINEMENT_KERNELS + (() if settings.stereo.enabled == "never" else STEREO_KERNELS)


STAGE = Stage(
    name="mesh",
    version=13,
    title="Mesh",
    run=run,
    summary="{faces} triangles, {dense_faces} before decimation",
    needs=("ingest", "poses", "stereo", "refine"),
    settings=(
        "mesh.*", "surfels.projected_depth", "train.max_size", "train.holdout", "stereo.max_size", "stereo.min_scale", "skip.empty_cells",
        "export.max_triangles",
    ),
    uses_device=True,
    kernels=kernels,
)  # fmt: skip
