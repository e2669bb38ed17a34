"""Meshes and views to textures: UV atlas, normal map, occlusion, and what the views show, as linear half-float masters."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from gsbake.pipeline.errors import BadInputError
from gsbake.pipeline.skip import leave_out, wanted
from gsbake.pipeline.stage import Context, Stage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from gsbake.geometry.cameras import Camera
    from gsbake.geometry.raycast import RayCaster
    from gsbake.materials.pixels import Pixels
    from gsbake.texturing.normal_map import Detail
    from gsbake.texturing.projection import Blended
    from gsbake.texturing.unwrapped_mesh import Surface

#: Rays for occlusion start this share of the diagonal above the surface; the result is averaged within this many texels.
OFFSET, REACH = 0.002, 3.0
#: Held-out photos count this much: they fill only what no other photo saw, so that figures taken on them stay honest.
HELD_OUT_WEIGHT = 1e-4
#: Within this share of a photo's longer side from the mask's border, pixels count less.
MASK_MARGIN = 0.008
#: Materials are fitted to at most this many pixels of each photo.
MOST_PIXELS = 60_000
#: Materials are fitted where the photos together saw a texel as well as this many frontal views do; elsewhere they are continued.
LEAST_SEEN = 0.3
#: Edge of the texture on which the shading of matt things is estimated: some ten thousand texels tell a light of nine numbers.
DELIT_SIZE = 128
#: Rendered materials count where the surfels are at least this opaque.
SOLID = 0.8


def run(ctx: Context) -> dict[str, Any]:
    """Write `mesh.safetensors` and the EXR masters; return the figures of the atlas and the coverage."""
    import numpy as np

    from gsbake.imaging.exr import write_exr
    from gsbake.surfels.raster.threads import configure
    from gsbake.texturing.inpainting import continue_over_surface, flood
    from gsbake.texturing.needed import normals_agree
    from gsbake.texturing.normal_map import normal_map

    configure(ctx.threads)
    settings = ctx.settings.bake
    if settings.materials == "surfels" and not (ctx.inputs["refine"] / "light.safetensors").exists():
        raise BadInputError(
            'bake: bake.materials is "surfels", but the surfels learnt none; set splat.shading to "pbr" or bake.materials to "fit".'
        )
    vertices, faces = _mesh(ctx, "mesh.ply")
    surface = _unwrap(ctx, vertices, faces)
    texels = surface.texels
    ctx.check_stop()
    with ctx.part("normals"):
        dense, detail = _detail(ctx, surface)
    ctx.check_stop()
    with ctx.part("occlusion"):
        open_share = _occlusion(ctx, surface, dense, detail)
    with ctx.part("projection"):
        own = settings.materials == "surfels"
        blended = _project_materials(ctx, surface) if own else _project_photos(ctx, surface)
    fit: dict[str, Any] = {}
    if settings.materials == "fit":
        with ctx.part("fit"):
            blended, detail, fit = _fit_materials(ctx, surface, blended, detail, open_share)
    elif settings.materials == "delit":
        with ctx.part("delit"):
            blended = _delit(ctx, surface, blended, detail, open_share)
    tangent = texels.interpolate(surface.tangent, surface.atlas.faces)
    agree, evidence = (False, "materials are fitted, which bends normals") if fit else normals_agree(detail, surface.facing)
    plain = leave_out(ctx, "normal_map", agree, evidence, "no normal map", "normal map baked")
    coded = None if plain else normal_map(detail, texels.interpolate(surface.normal, surface.atlas.faces), tangent)
    with ctx.part("flood"):
        if not blended.seen.any():
            raise BadInputError("bake: no photo sees the mesh; poses and mesh do not belong together, run from the poses stage again.")
        values = continue_over_surface(blended.values, blended.seen, texels, faces, len(vertices))
        if values.shape[1] == 3:
            constant = np.tile(np.array([settings.roughness, 0.0], np.float32), (len(texels), 1))
            values = np.concatenate([values, constant], 1)
        values = np.clip(values, 0, 1)
        coverage = np.stack([np.ones(len(texels), np.float32), blended.seen.astype(np.float32), blended.confidence], 1)
        parts = [values[:, :3], open_share[:, None], values[:, 3:5], *([] if coded is None else [coded]), values[:, 5:]]
        image = flood(texels.image(np.concatenate(parts, 1)), texels.covered(), rim=max(2, settings.size // 256))
    with ctx.part("write"):
        write_exr(ctx.out / "base_color.exr", image[..., 0:3])
        write_exr(ctx.out / "orm.exr", image[..., 3:6])
        if coded is not None:
            write_exr(ctx.out / "normal.exr", image[..., 6:9])
        if values.shape[1] == 8:
            write_exr(ctx.out / "emissive.exr", image[..., -3:])
        write_exr(ctx.out / "coverage.exr", texels.image(coverage))
        _save_mesh(ctx, surface)
    unseen = float(1 - blended.seen.mean())
    if unseen > 0.25:
        ctx.warn(f"bake: {unseen:.0%} of the surface was seen by no photo; its colours are continued from what was seen.")
    return {
        "charts": surface.atlas.charts,
        "fill": surface.atlas.fill,
        "texels": len(texels),
        "vertices": len(surface.position),
        "faces": len(surface.atlas.faces),
        "texel_edge": surface.texel,
        "unseen_share": unseen,
        "median_views": float(np.median(blended.views)),
        "detail_share": float(detail.found.mean()),
        "detail_bound": detail.bound,
        "largest_gain": float(np.exp(np.abs(np.log(blended.gains)).max())),
        **fit,
    }


def _mesh(ctx: Context, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices and faces of a PLY of the mesh stage."""
    import numpy as np
    import trimesh

    path = ctx.inputs["mesh"] / name
    try:
        mesh: Any = trimesh.load(path, process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except (OSError, ValueError, AttributeError, IndexError, KeyError) as error:
        raise BadInputError(f"{path} is not a readable triangle mesh ({error}); run the mesh stage again.") from error
    if len(faces) == 0 or not np.isfinite(vertices).all():
        raise BadInputError(f"{path} has no triangles or positions that are not numbers; run the mesh stage again or replace the file.")
    return vertices, faces


def _unwrap(ctx: Context, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Surface:
    """The light mesh cut into charts, with its texels."""
    from gsbake.texturing.atlas import make_atlas
    from gsbake.texturing.unwrapped_mesh import Surface

    size = ctx.settings.bake.size
    with ctx.part("atlas"):
        try:
            atlas = make_atlas(vertices, faces, size)
        except ValueError as error:
            raise BadInputError(f"bake: {error}; raise bake.size or lower mesh.faces.") from error
    with ctx.part("texels"):
        surface = Surface.of(vertices, faces, atlas, size, ctx.threads)
    ctx.progress(1, 4, "atlas", charts=atlas.charts, fill=atlas.fill)
    return surface


def _detail(ctx: Context, surface: Surface) -> tuple[tuple[RayCaster, NDArray[np.float64]], Detail]:
    """The dense surface with its vertex normals, and what of it each texel shows."""
    from gsbake.geometry.raycast import RayCaster
    from gsbake.texturing.normal_map import find_detail, vertex_normals

    vertices, faces = _mesh(ctx, "dense.ply")
    caster, normals = RayCaster(vertices, faces, ctx.threads), vertex_normals(vertices, faces)
    return (caster, normals), find_detail(surface.at, surface.facing, caster, normals, surface.diagonal)


def _occlusion(ctx: Context, surface: Surface, dense: tuple[RayCaster, NDArray[np.float64]], detail: Detail) -> NDArray[np.float32]:
    """Open share of the hemisphere per texel (n,), traced on the dense surface where there is one."""
    import numpy as np

    from gsbake.texturing.occlusion_map import open_share

    rays = ctx.settings.bake.occlusion_rays
    if rays == 0:
        return np.ones(len(surface.texels), np.float32)

    def each(done: int, total: int) -> None:
        ctx.check_stop()
        ctx.progress(done, total, "occlusion")

    return open_share(surface, dense, detail, rays, OFFSET * surface.diagonal, REACH, each)


def _project_photos(ctx: Context, surface: Surface) -> Blended:
    """Base colour (n, 3) from the photos at their stored size."""
    from gsbake.capture.photos.exposure import TiePoints
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.imaging.srgb import decode_bytes
    from gsbake.surfels.training.views import held_out
    from gsbake.texturing.needed import constant_exposure
    from gsbake.texturing.projection import ProjectionBlender, mask_weights

    posed = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["refine"])
    aside = set(held_out(len(posed), ctx.settings.train.holdout))
    blender = ProjectionBlender(surface.at, surface.facing, surface.caster, 3, surface.texel)
    asked = ctx.settings.skip.exposure != "always"
    tied = TiePoints.of(ctx.inputs["poses"] / "sparse", posed.cameras.to_world.inverse()) if asked else None
    for index in range(len(posed)):
        ctx.check_stop()
        view = posed.view(index)
        linear = decode_bytes(view.rgb)
        if tied is not None:
            tied.add(view.camera, linear)
        margin = MASK_MARGIN * max(view.camera.width, view.camera.height)
        weights = None if view.mask is None else mask_weights(view.mask, margin)
        blender.add(view.camera, linear, weights, HELD_OUT_WEIGHT if index in aside else 1.0)
        ctx.progress(index + 1, len(posed), "photos onto the texture")
    blended = blender.result(solve_exposure=asked)
    steady, evidence = True, "not measured"
    if asked:
        steady, evidence = constant_exposure(blended.gains, blended.explained, None if tied is None else tied.spread())
    if leave_out(ctx, "exposure", steady, evidence, "exposure taken as constant", "exposure equalised") and (blended.gains != 1).any():
        blended = blender.result()
    return blended


def _delit(ctx: Context, surface: Surface, shown: Blended, detail: Detail, open_share: NDArray[np.float32]) -> Blended:
    """Base colour (n, 3): what the photos show without its shading; the light that made it is written beside the textures."""
    import numpy as np

    from gsbake.materials.delighting import find_irradiance, without_shading
    from gsbake.texturing.resampling import Coarse

    openness = np.ones_like(open_share) if ctx.settings.bake.visibility == "none" else open_share
    coarse = Coarse.sized(surface.atlas.uv, surface.atlas.faces, surface.texels, surface.texel, DELIT_SIZE)
    seen = shown.seen.astype(np.float32)[:, None]
    share = coarse.down(seen)
    known = share[:, 0] > 0.5
    colour, normal, position, open_there = (
        coarse.down(seen * x)[known] / share[known] for x in (shown.values, detail.normal, detail.position, openness[:, None])
    )
    irradiance = find_irradiance(colour, normal / np.linalg.norm(normal, axis=1, keepdims=True), position, open_there[:, 0])
    values = shown.values.copy()
    values[shown.seen], level = without_shading(shown.values[shown.seen], detail.normal[shown.seen], openness[shown.seen], irradiance)
    irradiance.light(ctx.settings.splat.env_size, level).save(ctx.out / "light.safetensors")
    return replace(shown, values=values)


def _fit_materials(
    ctx: Context, surface: Surface, shown: Blended, detail: Detail, open_share: NDArray[np.float32]
) -> tuple[Blended, Detail, dict[str, Any]]:
    """Base colour, roughness, metallic (n, 5) and normals fitted to the photos with the light, which is written beside the textures.

    Where something glows, its radiance follows as three more columns.

    `shown` is what the photos show (n, 3): the fit starts from it, and where the fit works on a coarser texture it gives the fine detail.
    """
    import time
    from functools import partial

    import numpy as np

    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.capture.view_dependence import looks_diffuse
    from gsbake.materials.adjacency import neighbours
    from gsbake.materials.fit import MaterialFit, Priors
    from gsbake.materials.initialisation import best_fit, trial_cost, trial_roughness
    from gsbake.materials.map_selection import plainer
    from gsbake.materials.metal_superresolution import sharp_metals
    from gsbake.materials.pixels import PixelReader
    from gsbake.materials.reflections import Mirrors
    from gsbake.materials.view_dependence import PLACES, MeshWatch
    from gsbake.materials.visibility import Visibility
    from gsbake.meshing.resolution import pixel_footprint
    from gsbake.surfels.training.views import held_out
    from gsbake.texturing.resampling import Coarse

    settings = ctx.settings.bake
    posed = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["refine"])
    cameras = [camera.within(settings.fit_size) for camera in posed.cameras.cameras]
    footprint = pixel_footprint(cameras, surface.position.mean(0))
    coarse = Coarse.of(surface.atlas.uv, surface.atlas.faces, surface.texels, surface.texel, footprint)
    ctx.decide("materials fitted at", f"{coarse.texels.size} texels", f"a texel is {coarse.edge / footprint:.2f} pixels of the photos")
    reader = PixelReader(surface.whole, surface.atlas.uv, coarse.texels, surface.diagonal)
    aside = set(held_out(len(posed), ctx.settings.train.holdout))
    some = slice(None, None, max(1, len(surface.at) // PLACES))
    watch = MeshWatch(surface.at[some], surface.facing[some], surface.caster, surface.diagonal)
    photos: list[Pixels] = []
    held: list[Pixels] = []
    shot: list[Camera] = []
    for index in range(len(posed)):
        ctx.check_stop()
        view = posed.view(index, settings.fit_size)
        watch.add(view)
        pixels = reader.read(view.camera, view.rgb, view.mask).thinned(MOST_PIXELS)
        (held if index in aside else photos).append(pixels.without_gain(shown.gains[index]))
        shot += [] if index in aside else [view.camera]

    def each(done: int, total: int) -> None:
        ctx.check_stop()
        ctx.progress(done, total, "materials and light")

    priors = Priors(settings.smooth_prior, settings.dark_prior, settings.metal_prior, settings.white_prior, settings.parsimony_prior)
    normal, occlusion, base = (coarse.down(x) for x in (detail.normal, open_share[:, None], shown.values))
    at = coarse.texels.interpolate(surface.position, surface.atlas.faces)
    pairs = neighbours(coarse.texels, at, normal)

    seen, above = None, OFFSET * surface.diagonal
    if settings.visibility in ("directional", "bounce", "reflections") and settings.occlusion_rays:
        near, rays = REACH * coarse.edge, 2 * settings.occlusion_rays  # over the whole sphere
        seen = Visibility.trace(coarse.texels, surface.atlas.uv, surface.whole, normal, rays, above, near, lambda *_: ctx.check_stop())
    if settings.visibility == "none":
        occlusion = np.ones_like(occlusion)

    def start(roughness: float) -> MaterialFit:
        light_size, bounce = ctx.settings.splat.env_size, settings.visibility in ("bounce", "reflections")
        return MaterialFit(coarse.texels, at, pairs, normal, occlusion[:, 0], base, light_size, priors, roughness, seen, bounce)

    diffuse, why = looks_diffuse(*watch.changes())
    matte = wanted(ctx, "view_dependence", diffuse)
    if seen is not None and settings.visibility == "reflections" and not matte:
        mirrors = Mirrors(surface.whole, surface.atlas.uv, coarse.texels, at, normal, above)
        photos, held = ([mirrors.traced(pixels) for pixels in part] for part in (photos, held))
    trials = {} if matte else trial_roughness(start, photos, ctx.seed, lambda done, total: ctx.check_stop())
    begun = time.perf_counter()
    choice = best_fit(start, photos, held, settings.fit_steps, ctx.seed, trials, matte, each)
    spent = (time.perf_counter() - begun) / (settings.fit_steps * choice.fits)
    fit, fitted = choice.fit, choice.fitted
    ctx.decide("roughness starts at", f"{choice.roughness:g}", choice.why)
    if choice.metals:
        ctx.decide("metals doubted", "kept" if fitted.metal.any() else "taken for paint", choice.metals)
    leave_out(
        ctx, "view_dependence", diffuse, why, "reflections taken for broad, none tried", "reflections looked for", trial_cost(photos, spent)
    )
    ctx.decide("level of the light", ", then ".join(map(str, fitted.levels)), "under which paint explains the photos best")
    ctx.decide("light of its own", f"{fitted.glowing} regions", "bright, ending at an edge, and the same whatever light falls on them")
    fitted.light.save(ctx.out / "light.safetensors")
    fine = coarse.detail(shown.values)
    judges = held if any(map(len, held)) else photos
    metals = int(fitted.metal.sum())
    plain = plainer(fitted.values, fitted.weight, metals, partial(fit.psnr, judges), partial(leave_out, ctx))
    values = coarse.up(plain)
    values[:, :3] *= fine
    if metals and plain[:, 4].any():
        values = sharp_metals(surface, coarse, fit, fitted.metal, plain[:, 3], values, list(zip(photos, shot, strict=True)))
    if fitted.glowing:
        values = np.concatenate([values, coarse.up(fitted.glow) * fine], 1)
    known = coarse.up(fitted.weight[:, None])[:, 0] > LEAST_SEEN * (coarse.edge / footprint) ** 2
    figures: dict[str, Any] = {
        "fit_psnr": fitted.held_out,
        "fit_pixels": sum(map(len, photos)),
        "fit_texels": len(coarse.texels),
        "fit_metal_texels": metals,
        "fit_glowing_regions": fitted.glowing,
    }
    turned = detail.normal + np.where(known[:, None], coarse.up(fitted.bend), 0)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return replace(shown, values=values, views=np.where(known, shown.views, 0)), replace(detail, normal=turned), figures


def _project_materials(ctx: Context, surface: Surface) -> Blended:
    """Base colour, roughness, metallic (n, 5) from the trained surfels, rendered at the photos' poses; their light goes with them."""
    import shutil

    import numpy as np

    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.surfels.raster.render import SurfelRenderer
    from gsbake.texturing.projection import ProjectionBlender, mask_weights

    posed = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["refine"])
    renderer = SurfelRenderer.load(ctx.inputs["refine"])
    blender = ProjectionBlender(surface.at, surface.facing, surface.caster, 5, surface.texel)
    size = ctx.settings.train.max_size
    for index, full in enumerate(posed.cameras.cameras):
        ctx.check_stop()
        camera = full.within(size)
        buffers = renderer.gbuffer(camera)
        image = np.dstack([buffers["albedo"], buffers["roughness"], buffers["metallic"]])
        solid = (buffers["alpha"] > SOLID).astype(np.uint8) * 255
        blender.add(camera, image, mask_weights(solid, MASK_MARGIN * size))
        ctx.progress(index + 1, len(posed), "materials onto the texture")
    shutil.copyfile(ctx.inputs["refine"] / "light.safetensors", ctx.out / "light.safetensors")
    return blender.result()


def _save_mesh(ctx: Context, surface: Surface) -> None:
    """Write the cut mesh with its frames."""
    import numpy as np
    from safetensors.numpy import save_file

    save_file(
        {
            "position": np.ascontiguousarray(surface.position, np.float32),
            "normal": np.ascontiguousarray(surface.normal, np.float32),
            "tangent": np.ascontiguousarray(surface.tangent, np.float32),
            "uv": np.ascontiguousarray(surface.atlas.uv, np.float32),
            "faces": np.ascontiguousarray(surface.atlas.faces, np.int32),
        },
        ctx.out / "mesh.safetensors",
    )


STAGE = Stage(
    name="bake",
    version=15,
    title="Textures",
    run=run,
    needs=("poses", "refine", "mesh"),
    settings=(
        "bake.*", "splat.env_size", "train.max_size", "train.holdout",
        "skip.exposure", "skip.normal_map", "skip.view_dependence", "skip.metallic_map", "skip.roughness_map",
    ),
    uses_device=True,
    seeded=True,
)  # fmt: skip
