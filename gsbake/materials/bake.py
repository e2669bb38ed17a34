"""Texture baking: UV atlas, normal map, ambient occlusion and materials of a mesh from photos, as linear half-float images."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from gsbake.capture.full_photos import FullPhotos
from gsbake.config.schema import Bake
from gsbake.errors import BadInputError
from gsbake.geometry.ply import read_textured_mesh
from gsbake.geometry.raycast import RayCaster
from gsbake.imaging.exr import write_exr
from gsbake.kernels.threads import configure
from gsbake.materials.fitting import RAY_OFFSET, SMOOTHING_RADIUS, FitSettings, fit_materials
from gsbake.materials.remaining_shading import find_irradiance, remove_shading
from gsbake.materials.white import KnownWhite, divide_light, find_white, white_factor, with_factor
from gsbake.meshing.repair import repair_foreign
from gsbake.monitor import SILENT, Monitor, Rule, decide_skip
from gsbake.text import number
from gsbake.texturing.atlas import make_atlas
from gsbake.texturing.fine_base_color import fine_base_color, needed_bytes
from gsbake.texturing.given_uvs import given_atlas, given_uvs
from gsbake.texturing.inpainting import fill_empty_texels, inpaint_surface
from gsbake.texturing.normal_map import DenseSamples, normal_map, sample_dense_mesh, vertex_normals
from gsbake.texturing.occlusion_map import bake_occlusion
from gsbake.texturing.photo_projection import project_photos, project_surfel_materials
from gsbake.texturing.projection import ProjectedTexture
from gsbake.texturing.resampling import CoarseTexture
from gsbake.texturing.skip_rules import normals_agree
from gsbake.texturing.texture_size import texture_size
from gsbake.texturing.unwrapped_mesh import UnwrappedMesh

Floats = NDArray[np.float32]

#: Edge in texels of the texture on which delighting estimates the irradiance: ten thousand texels determine its eight coefficients.
DELIGHT_SIZE = 128
#: Share of the surface that no photo observed, above which a warning is given.
MAX_UNOBSERVED = 0.25
#: Maximum boundary edges of a hole that the mesh's repair closes again.
MAX_HOLE_EDGES = 400
#: Share of the texture under charts, below which a warning is given.
MIN_FILL = 0.35
#: Share of the texels of a mesh with given UVs whose rays may miss the dense mesh without a warning.
MAX_MISSED = 0.02


@dataclass(frozen=True)
class BakeOptions:
    """Settings of the bake; `train_size` and `holdout` are those of training, `light_size` the edge of the environment map's faces in
    texels, `max_triangles` the limit of the exported asset, `without` names of passes of the material fit that are left out, the rest are
    rules of [skip]."""

    bake: Bake = Bake()
    train_size: int = 512
    holdout: int = 8
    light_size: int = 32
    max_triangles: int = 100_000
    exposure_equalisation: Rule = "auto"
    specular: Rule = "auto"
    normal_map: Rule = "auto"
    metallic_map: Rule = "auto"
    roughness_map: Rule = "auto"
    without: frozenset[str] = frozenset()

    @classmethod
    def of(cls, settings: Any) -> BakeOptions:
        """Those in the `settings` of a profile, or in the part of them that the stage declares."""
        skip = settings.skip
        rules = skip.exposure_equalisation, skip.specular, skip.normal_map, skip.metallic_map, skip.roughness_map
        sizes = settings.train.max_size, settings.train.holdout, settings.light.size, settings.export.max_triangles
        return cls(settings.bake, *sizes, *rules)


def bake_textures(
    ingest: Path,
    poses: Path,
    surfels: Path,
    mesh: Path,
    out: Path,
    options: BakeOptions | None = None,
    *,
    seed: int = 0,
    threads: int = 2,
    monitor: Monitor = SILENT,
) -> dict[str, Any]:
    """Unwrap the mesh of the folder `mesh` and bake its textures from the photos into the folder `out`; return the figures.

    `ingest` holds the photos at full size (`FullPhotos`), `poses` their cameras, `surfels` those that training refined, if it did.
    Written: `mesh.safetensors` (the unwrapped mesh with its tangent frames), `base_color.exr`, `orm.exr`, `coverage.exr`, where needed
    `normal.exr` and `emissive.exr`, with materials `light.safetensors`, where the light moves `light_motion.json`. Raises BadInputError
    when the mesh is damaged, has too many triangles, does not fit the atlas, or is visible in no photo.
    """
    with FullPhotos(ingest, poses, surfels) as photos:
        return _Baking(ingest, photos, surfels, mesh, out, options or BakeOptions(), seed, threads, monitor).run()


@dataclass(frozen=True)
class Textures:
    """`projected`: values (n, 3, 5 or 8) of the texels, which are linear base colour, then roughness and metallic, then emission; `normal`:
    shading normals of the texels; `figures` for the manifest."""

    projected: ProjectedTexture
    normal: DenseSamples
    figures: dict[str, Any]
    #: Factor on the base colour that known reflectances gave, one or three numbers.
    white: NDArray[np.float64] | float = 1.0


@dataclass
class _Baking:
    """One run."""

    ingest: Path
    photos: FullPhotos
    surfels: Path
    mesh: Path
    out: Path
    options: BakeOptions
    seed: int
    threads: int
    monitor: Monitor

    def run(self) -> dict[str, Any]:
        """Unwrap, sample the dense mesh, trace occlusion, bake materials, fill gaps, write."""
        monitor, settings = self.monitor, self.options.bake
        configure(self.threads)
        if settings.materials == "surfels" and not (self.surfels / "light.safetensors").exists():
            raise BadInputError(
                'bake: bake.materials is "surfels", but the surfels have none; set surfels.shading to "pbr" or bake.materials to "fit".'
            )
        with monitor.part("repair"):
            vertices, faces, uv = self._mesh()
        surface = self._unwrap(vertices, faces, uv)
        monitor.check_stop()
        with monitor.part("normals"):
            dense, detail = self._dense(surface)
        missed = 1 - float(detail.found.mean())
        if uv is not None and missed > MAX_MISSED:
            monitor.warn(f"bake: the rays of {missed:.0%} of the texels missed the dense mesh; they are flat (the report shows where).")
        monitor.check_stop()
        with monitor.part("occlusion"):
            occlusion = self._occlusion(surface, dense, detail)
        white = self._find_white(surface)
        textures = self._with_white(surface, self._materials(surface, detail, occlusion), white)
        if not textures.projected.observed.any():
            raise BadInputError(
                "bake: the mesh is visible in no photo; turn its faces outwards if it is your own, else run from the poses stage on."
            )
        coded = self._normal_map(surface, textures)
        with monitor.part("inpainting"):
            image, emissive = self._image(surface, textures.projected, occlusion, coded, faces, len(vertices))
        colour = self._base_color(surface, image[..., :3], textures.projected.gains[:, :3] / textures.white)
        with monitor.part("write"):
            self._write(surface, textures.projected, detail, image, colour, coded is not None, emissive)
        return self._figures(surface, detail, textures, len(colour))

    def _read(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
        """Vertices, faces and texture coordinates of a PLY of the mesh stage."""
        try:
            return read_textured_mesh(self.mesh / name)
        except ValueError as error:
            raise BadInputError(f"{error}; run the mesh stage again or replace the file.") from error

    def _mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64] | None]:
        """Vertices and faces of the low-poly mesh, which may come from another program, without its faults; its UVs (f, 3, 2), if any."""
        vertices, faces, uv = self._read("mesh.ply")
        try:
            given = given_uvs(vertices, faces, uv)
        except ValueError as error:
            raise BadInputError(f"bake: the mesh {error}.") from error
        if given is not None:
            self.monitor.decide("UVs", "kept", "; ".join([f"{number(len(given.faces))} triangles have some", *given.notes]))
            for fault in given.faults:
                self.monitor.warn(f"bake: {fault}.")
            self._check_count(len(given.faces))
            return given.vertices, given.faces, given.uv
        found = repair_foreign(vertices, faces.astype(np.int32), MAX_HOLE_EDGES)
        if found.joined:
            self.monitor.decide("mesh", "vertices joined", f"{found.joined} of {len(vertices)} lay at the place of another")
        if found.faults:
            self.monitor.warn(f"bake: the mesh was repaired; left out were {found.faults}.")
        self._check_count(len(found.faces))
        return found.vertices, found.faces.astype(np.int64), None

    def _check_count(self, triangles: int) -> None:
        most = self.options.max_triangles
        if triangles > most:
            raise BadInputError(
                f"bake: the mesh has {number(triangles)} triangles, but export.max_triangles allows {number(most)}; decimate it and "
                f"give it as mesh.ply, this one as dense.ply, whose details become the normal map, or raise the limit."
            )

    def _unwrap(self, vertices: NDArray[np.float64], faces: NDArray[np.int64], uv: NDArray[np.float64] | None) -> UnwrappedMesh:
        """The low-poly mesh with its texels, unwrapped into charts unless the UVs (f, 3, 2) of its corners are given."""
        size = self.options.bake.map_size
        with self.monitor.part("atlas"):
            self.monitor.progress(0, len(faces), "unwrapping")
            try:
                atlas = make_atlas(vertices, faces, size) if uv is None else given_atlas(faces, uv, size)
            except ValueError as error:
                raise BadInputError(f"bake: {error}.") from error
        if atlas.fill < MIN_FILL:
            advice = "the rest is padding; raise bake.size, or join the mesh's pieces" if uv is None else "pack them tighter"
            self.monitor.warn(f"bake: {number(atlas.charts)} charts use {atlas.fill:.0%} of the texture; {advice}.")
        with self.monitor.part("texels"):
            surface = UnwrappedMesh.of(vertices, faces, atlas, size, self.threads)
        return surface

    def _dense(self, surface: UnwrappedMesh) -> tuple[tuple[RayCaster, NDArray[np.float64]], DenseSamples]:
        """The dense mesh with its vertex normals, and its points at the texels."""
        vertices, faces, _ = self._read("dense.ply")
        caster, normals = RayCaster(vertices, faces, self.threads), vertex_normals(vertices, faces)
        return (caster, normals), sample_dense_mesh(surface.texel_position, surface.texel_normal, caster, normals, surface.diagonal)

    def _occlusion(self, surface: UnwrappedMesh, dense: tuple[RayCaster, NDArray[np.float64]], detail: DenseSamples) -> Floats:
        """Ambient occlusion (n,) of the texels, 1 = open; all open with `bake.occlusion_rays` = 0."""
        rays = self.options.bake.occlusion_rays
        if rays == 0:
            return np.ones(len(surface.texels), np.float32)

        def each(done: int, total: int) -> None:
            self.monitor.check_stop()
            self.monitor.progress(done, total, "ambient occlusion")

        return bake_occlusion(surface, dense, detail, rays, RAY_OFFSET * surface.diagonal, SMOOTHING_RADIUS, each)

    def _materials(self, surface: UnwrappedMesh, detail: DenseSamples, occlusion: Floats) -> Textures:
        """Textures by the method of `bake.materials`; writes `light.safetensors` if the method finds the light."""
        options, monitor = self.options, self.monitor
        light = self.out / "light.safetensors"
        if options.bake.materials == "surfels":
            with monitor.part("projection"):
                projected = project_surfel_materials(surface, self.photos.posed, self.surfels, options.train_size, monitor)
            shutil.copyfile(self.surfels / "light.safetensors", light)
            return Textures(projected, detail, {})
        with monitor.part("projection"):
            projected = project_photos(surface, self.photos, options.holdout, options.exposure_equalisation, monitor)
        if options.bake.materials == "delight":
            with monitor.part("delighting"):
                return Textures(self._delight(surface, projected, detail, occlusion), detail, {})
        if options.bake.materials == "fit":
            rules = options.specular, options.metallic_map, options.roughness_map
            fit = FitSettings(options.bake, options.light_size, options.holdout, *rules, options.without)
            fitted = fit_materials(surface, self.photos.posed, projected, detail, occlusion, fit, self.seed, monitor)
            fitted.state.light.save(light)
            if fitted.state.light_motion.rotations is not None:
                fitted.state.light_motion.save(self.out / "light_motion.json")
            maps = fitted.maps
            values = np.column_stack([maps.base_color, maps.roughness, maps.metallic])
            values = values if maps.emission is None else np.column_stack([values, maps.emission])
            textures = replace(projected, values=values, views=np.where(fitted.observed, projected.views, 0))
            return Textures(textures, replace(detail, normal=fitted.normal), fitted.figures)
        return Textures(projected, detail, {})

    def _find_white(self, surface: UnwrappedMesh) -> KnownWhite:
        """What has a known reflectance, before any material is fitted."""
        bake = self.options.bake
        if bake.white and bake.materials == "none":
            self.monitor.warn("bake: bake.white is not used: bake.materials is none, and colours contain the light; use --profile relight.")
            return KnownWhite([], [])
        return find_white(bake.white, self.ingest, self.photos.posed, surface)

    def _with_white(self, surface: UnwrappedMesh, textures: Textures, white: KnownWhite) -> Textures:
        """The textures with the brightness and colour that known reflectances give, and the light with what follows for it."""
        if not white:
            return textures
        projected, light = textures.projected, self.out / "light.safetensors"
        factor = white_factor(white, projected, self.photos.posed, surface.caster, light, self.monitor)
        divide_light(light, factor)
        values = projected.values.copy()
        values[:, :3] = with_factor(values[:, :3], factor, self.monitor)
        figures = textures.figures | {"white_factor": factor.tolist()}
        return replace(textures, projected=replace(projected, values=values), figures=figures, white=factor)

    def _delight(self, surface: UnwrappedMesh, projected: ProjectedTexture, detail: DenseSamples, occlusion: Floats) -> ProjectedTexture:
        """Base colour (n, 3): projected colours divided by their shading."""
        occlusion = np.ones_like(occlusion) if self.options.bake.visibility == "none" else occlusion
        coarse = CoarseTexture.sized(surface.atlas.uv, surface.atlas.faces, surface.texels, surface.texel_size, DELIGHT_SIZE)
        weight = projected.observed.astype(np.float32)[:, None]
        share = coarse.down(weight)
        known = share[:, 0] > 0.5
        samples = projected.values, detail.normal, detail.position, occlusion[:, None]
        colour, normal, position, coarse_occlusion = (coarse.down(weight * x)[known] / share[known] for x in samples)
        irradiance = find_irradiance(colour, normal / np.linalg.norm(normal, axis=1, keepdims=True), position, coarse_occlusion[:, 0])
        values, mine = projected.values.copy(), projected.observed
        values[mine], intensity = remove_shading(projected.values[mine], detail.normal[mine], occlusion[mine], irradiance)
        irradiance.light(self.options.light_size, intensity).save(self.out / "light.safetensors")
        return replace(projected, values=values)

    def _normal_map(self, surface: UnwrappedMesh, textures: Textures) -> Floats | None:
        """The tangent-space normal map (n, 3), coded to 0..1, or None where the low-poly mesh needs none."""
        fitted = self.options.bake.materials == "fit"
        agree, evidence = (False, "normals refined by the material fit") if fitted else normals_agree(textures.normal, surface.texel_normal)
        rule = self.options.normal_map
        if decide_skip(self.monitor, "normal_map", rule, agree, evidence, "no normal map", "normal map baked"):
            return None
        interpolate, faces = surface.texels.interpolate, surface.atlas.faces
        return normal_map(textures.normal, interpolate(surface.normal, faces), interpolate(surface.tangent, faces))

    def _image(
        self,
        surface: UnwrappedMesh,
        projected: ProjectedTexture,
        occlusion: Floats,
        coded: Floats | None,
        faces: NDArray[np.int64],
        vertices: int,
    ) -> tuple[Floats, bool]:
        """All maps as one image (size, size, channels), with unobserved texels and gutters filled, and whether it contains emission.

        Channels: base colour, occlusion, roughness, metallic, the normal map if there is one, emission if there is any. `faces` and the
        number of `vertices` are those of the mesh before unwrapping.
        """
        texels, settings = surface.texels, self.options.bake
        values = inpaint_surface(projected.values, projected.observed, texels, faces, vertices)
        if values.shape[1] == 3:
            constant = np.tile(np.array([settings.default_roughness, 0.0], np.float32), (len(texels), 1))
            values = np.concatenate([values, constant], 1)
        values = np.clip(values, 0, 1)
        parts = [values[:, :3], occlusion[:, None], values[:, 3:5], *([] if coded is None else [coded]), values[:, 5:]]
        image = fill_empty_texels(texels.image(np.concatenate(parts, 1)), texels.covered(), gutter=max(2, settings.map_size // 256))
        return image, values.shape[1] == 8

    def _base_color(self, surface: UnwrappedMesh, coarse: Floats, gains: Floats) -> Floats:
        """The linear base colour: the `coarse` one (s, s, 3), or a finer one where its size is automatic and photos are finer."""
        bake, monitor, photos = self.options.bake, self.monitor, self.photos
        if bake.size != "auto" or bake.materials == "surfels":
            return coarse
        with monitor.part("base colour"):
            chosen = texture_size([photos.camera(index) for index in range(len(photos))], surface)
            finer = chosen.size > surface.texels.size
            memory = f", baking it takes {1e-6 * needed_bytes(surface, chosen.size):.0f} MB of memory" if finer else ""
            monitor.decide("base colour", f"{chosen.size}² texels", chosen.evidence + memory)
            if not finer:
                return coarse
            smooth = bake.materials != "fit"
            return fine_base_color(surface, photos, coarse, chosen.size, gains, self.options.holdout, smooth, monitor)

    def _write(
        self,
        surface: UnwrappedMesh,
        projected: ProjectedTexture,
        detail: DenseSamples,
        image: Floats,
        colour: Floats,
        normals: bool,
        emissive: bool,
    ) -> None:
        """Write the images, the coverage and the unwrapped mesh."""
        write_exr(self.out / "base_color.exr", colour)
        write_exr(self.out / "orm.exr", image[..., 3:6])
        if normals:
            write_exr(self.out / "normal.exr", image[..., 6:9])
        if emissive:
            write_exr(self.out / "emissive.exr", image[..., -3:])
        count = len(surface.texels)
        known = np.ones(count), projected.observed, projected.confidence, detail.found
        coverage = np.stack([np.asarray(channel, np.float32) for channel in known], 1)
        write_exr(self.out / "coverage.exr", surface.texels.image(coverage))
        arrays = {"position": surface.position, "normal": surface.normal, "tangent": surface.tangent, "uv": surface.atlas.uv}
        body = {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
        save_file(body | {"faces": np.ascontiguousarray(surface.atlas.faces, np.int32)}, self.out / "mesh.safetensors")

    def _figures(self, surface: UnwrappedMesh, detail: DenseSamples, textures: Textures, base_color: int) -> dict[str, Any]:
        """Results for the manifest; warns of unobserved surface."""
        projected = textures.projected
        unobserved = float(1 - projected.observed.mean())
        if unobserved > MAX_UNOBSERVED:
            self.monitor.warn(f"bake: {unobserved:.0%} of the surface was observed by no photo and is inpainted.")
        return {
            "charts": surface.atlas.charts,
            "fill": surface.atlas.fill,
            "texels": len(surface.texels),
            "base_color_size": base_color,
            "vertices": len(surface.position),
            "faces": len(surface.atlas.faces),
            "texel_edge": surface.texel_size,
            "unobserved_share": unobserved,
            "median_views": float(np.median(projected.views)),
            "detail_share": float(detail.found.mean()),
            "detail_bound": detail.bound,
            "largest_gain": float(np.exp(np.abs(np.log(projected.gains)).max())),
            **textures.figures,
        }
