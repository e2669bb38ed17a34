"""Files of all targets from one bake: decimated, filtered, encoded within their budgets, with levels of detail; nothing is baked again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsbake import __version__
from gsbake.capture.full_photos import FullPhotos
from gsbake.config.schema import Export, Targets
from gsbake.config.targets import BUDGETS, SURFELS, Budget, Target, parse_target, require_packages
from gsbake.errors import BadInputError
from gsbake.geometry.ply import read_mesh
from gsbake.gltf.audit import as_json, audit, failed
from gsbake.gltf.baked import load_mesh_arrays, mesh_in_frame
from gsbake.gltf.container import unpack_glb
from gsbake.gltf.encode import size_limit
from gsbake.gltf.frame import frame_between, read_transforms_json
from gsbake.gltf.write import Geometry, GltfMesh, GltfTextures, Level, build_glb
from gsbake.meshing.decimation import Deviation, surface_deviation
from gsbake.meshing.decimator_choice import Decimator
from gsbake.monitor import SILENT, Monitor
from gsbake.targets.decimation import WedgeMesh, decimate_to_bound, decimate_to_count
from gsbake.targets.images import fit_images
from gsbake.targets.maps import BakedMaps, MapSource
from gsbake.targets.new_charts import with_new_charts
from gsbake.targets.texel_density import pixels_per_texel, texture_edge

#: Error of a level of detail on the screen, in pixels.
PIXEL_ERROR = 0.5
#: Largest share of a level's triangles that the next one has, as long as the former has more than so many: else it would save nothing.
LEVEL_SHARE, MIN_TRIANGLES = 0.75, 1000
#: Largest share of a target's bytes that the mesh takes.
GEOMETRY_SHARE = 0.5
#: Factor on that share up to which a mesh whose seams keep it above is taken; else it gets new charts, in at most so many tries.
SEAM_ALLOWANCE, NEW_CHART_TRIES = 1.2, 3
#: Bytes of the document beside mesh and images.
DOCUMENT_BYTES = 4096
#: Extensions that each form requires.
EXTENSIONS = {
    "webp": {"EXT_texture_webp"}, "ktx2": {"KHR_texture_basisu"}, "quantised": {"KHR_mesh_quantization"},
    "meshopt": {"KHR_mesh_quantization", "EXT_meshopt_compression"},
}  # fmt: skip
#: One pixel, in place of the images where the mesh alone is measured.
_PIXEL = GltfTextures(*([b"\x89PNG\r\n\x1a\n"] * 3))


@dataclass(frozen=True)
class TargetOptions:
    """Settings of the targets, those of the export that they share, and the mesh's decimator."""

    targets: Targets = Targets()
    export: Export = Export()
    decimator: Decimator = "pymeshlab"
    threads: int = 2


@dataclass(frozen=True)
class LevelFile:
    """A finished level: mesh, images, their edge and what was done to them, deviation from the dense mesh, constant factors, whether the
    mesh has charts of its own."""

    mesh: GltfMesh
    images: GltfTextures
    texture: int
    step: str
    deviation: Deviation
    factors: tuple[float, float] | None
    new_charts: bool


def build_targets(folders: Mapping[str, Path], out: Path, options: TargetOptions, *, monitor: Monitor = SILENT) -> dict[str, Any]:
    """Write the files of all targets into the folder `out` and return their figures.

    `folders` maps the stages poses, refine, mesh, bake and export to their artifact folders. Raises BadInputError when a target fails its
    audit, UsageError when a package is missing.
    """
    targets = list(dict.fromkeys(parse_target(text) for text in options.targets.files))
    require_packages(targets)
    builder = _Builder(folders, out, options, monitor)
    files: dict[str, Any] = {}
    for index, target in enumerate(targets):
        monitor.progress(index, len(targets), target.text)
        monitor.check_stop()
        with monitor.part(target.text):
            files |= builder.surfels() if target.name == SURFELS else builder.write(target)
    (out / "targets.json").write_bytes(json.dumps(files, indent=1).encode())
    return {"files": len(files), "targets": files}


class _Builder:
    """The bake, opened once, and what targets share: decimated meshes, filtered maps, the dense mesh."""

    def __init__(self, folders: Mapping[str, Path], out: Path, options: TargetOptions, monitor: Monitor) -> None:
        self.folders, self.out, self.options, self.monitor = folders, out, options, monitor
        arrays = load_mesh_arrays(folders["bake"] / "mesh.safetensors")
        self.cameras = read_transforms_json(folders["export"] / "cameras.json")
        with FullPhotos(folders.get("ingest"), folders["poses"], folders["refine"]) as photos:
            unit, full = photos.posed.cameras.cameras, [photos.camera(index) for index in range(len(photos))]
        self.frame = frame_between(unit, self.cameras)
        self.mesh = mesh_in_frame(arrays, self.frame)
        self.maps = BakedMaps.open(folders["bake"], self.mesh)
        self.source = MapSource(self.maps)
        self.extent = float(np.ptp(self.mesh.position, axis=0).max())
        self.diagonal = float(np.linalg.norm(np.ptp(self.mesh.position, axis=0)))
        self.extras = _extras_of(folders["export"] / "asset.glb")
        sharp = [camera.scaled(other.width, other.height) for camera, other in zip(self.cameras, full, strict=True)]
        self.pixels = pixels_per_texel(self.mesh, sharp, self.maps.edge)
        self._wedges: WedgeMesh | None = None
        self._dense: tuple[NDArray[Any], NDArray[Any]] | None = None
        self._bounded: dict[float, WedgeMesh] = {}
        self._decimated: dict[tuple[int, float], GltfMesh] = {}
        self._measured: dict[int, Deviation] = {}
        self._new_charts: dict[tuple[int, int], MapSource] = {}

    # -- shared ---------------------------------------------------------------------------------------------------------------------

    @property
    def wedges(self) -> WedgeMesh:
        """The baked mesh by vertices and wedges."""
        if self._wedges is None:
            self._wedges = WedgeMesh.of(self.mesh)
        return self._wedges

    @property
    def dense(self) -> tuple[NDArray[Any], NDArray[Any]]:
        """Vertices and triangles of the dense mesh in the asset's frame; the baked mesh where the user's has no dense one."""
        if self._dense is None:
            path = self.folders["mesh"] / "dense.ply"
            if path.exists():
                vertices, faces = read_mesh(path)
                self._dense = self.frame.apply(vertices), faces
            else:
                self._dense = self.wedges.surface
        return self._dense

    def deviation(self, mesh: GltfMesh) -> Deviation:
        """Deviation of a mesh from the dense one."""
        if id(mesh) not in self._measured:
            self._measured[id(mesh)] = surface_deviation(self.dense, (mesh.position.astype(np.float64), mesh.faces))
        return self._measured[id(mesh)]

    def budget(self, target: Target) -> tuple[float, int, Budget]:
        """Megabytes and triangles of a target, with its budget."""
        budget, export = BUDGETS[target.name], self.options.export
        megabytes = budget.megabytes or size_limit(export.max_megabytes, min(self.maps.edge, budget.texture), self.maps.map_edge)
        return megabytes, budget.triangles or export.max_triangles, budget

    # -- one target -----------------------------------------------------------------------------------------------------------------

    def write(self, target: Target) -> dict[str, Any]:
        """Write the files of a target; returns {name: figures}."""
        megabytes, triangles, budget = self.budget(target)
        levels, most = [], triangles
        for k in range(self.options.targets.levels + 1):
            levels.append(self.level(target, k, int(megabytes * 1e6), most, budget))
            if (count := len(levels[-1].mesh.faces)) > MIN_TRIANGLES:
                most = min(triangles, int(LEVEL_SHARE * count))
        figures: dict[str, Any] = {}
        for k, level in enumerate(levels):
            if k == 0 and target.text == "default":
                continue  # that is asset.glb
            figures |= self.write_level(target, k, level, megabytes, triangles)
        if self.options.targets.lod_file and len(levels) > 1 and target.file_form == "glb":
            figures |= self.write_levels(target, levels, megabytes * len(levels), triangles)
        if target.name == "film":
            figures |= self.write_masters(target)
        return figures

    def level(self, target: Target, k: int, budget: int, triangles: int, limits: Budget) -> LevelFile:
        """Mesh and images of level `k` of a target within `budget` bytes."""
        bound = PIXEL_ERROR * self.extent / (limits.pixels / 2**k)
        keep = k == 0 and target.name in ("default", "film") and len(self.mesh.faces) <= triangles
        mesh = self.mesh if keep else self.decimated(triangles if k == 0 else min(triangles, len(self.mesh.faces) >> k), bound)
        edge = texture_edge(self.maps.edge, self.pixels)
        edge = max(64, min(edge, limits.texture) >> k)
        source = self.source
        geometry, room = self.geometry_bytes(mesh, target), int(GEOMETRY_SHARE * budget)
        if geometry > room:
            triangles = min(triangles, int(0.97 * len(mesh.faces) * room / geometry))
            mesh = self.decimated(triangles, bound)
            geometry = self.geometry_bytes(mesh, target)
        wanted = len(mesh.faces)
        for _ in range(NEW_CHART_TRIES):
            if geometry <= SEAM_ALLOWANCE * room and len(mesh.faces) <= triangles:
                break
            wanted = int(0.97 * wanted * min(1, triangles / len(mesh.faces), room / geometry))
            source = self.with_new_charts(wanted, edge)
            mesh = source.maps.mesh
            geometry = self.geometry_bytes(mesh, target)
        found: dict[int, Any] = {}

        def maps(at: int) -> Any:
            if at not in found:
                found[at] = source.at(mesh, at)
            return found[at]

        images, step, texture = fit_images(maps, edge, budget - geometry - DOCUMENT_BYTES, target.texture_form, self.monitor.check_stop)
        new_charts = source is not self.source
        return LevelFile(mesh, images, texture, step.text, self.deviation(mesh), source.plain(texture).factors, new_charts)

    def with_new_charts(self, triangles: int, edge: int) -> MapSource:
        """The maps on a mesh of about `triangles` with charts of its own."""
        key = (triangles, edge)
        if key not in self._new_charts:
            self.monitor.check_stop()
            options = self.options
            self._new_charts[key] = with_new_charts(self.source, self.wedges.surface, triangles, edge, options.decimator, options.threads)
        return self._new_charts[key]

    def decimated(self, triangles: int, bound: float) -> GltfMesh:
        """The baked mesh with at most `triangles`, or fewer where the error bound allows; the same object for the same result."""
        key = (triangles, bound)
        if key not in self._decimated:
            if bound not in self._bounded:
                self._bounded[bound] = decimate_to_bound(self.wedges, bound)[0]
            free = self._bounded[bound]
            mesh = free if len(free.faces) <= triangles else decimate_to_count(self.wedges, triangles)
            self._decimated[key] = self.mesh if mesh is self.wedges else mesh.to_mesh()
        return self._decimated[key]

    def geometry_bytes(self, mesh: GltfMesh, target: Target) -> int:
        """Bytes of the mesh in the target's form."""
        return len(build_glb(mesh, _PIXEL, "asset", "", geometry=_geometry(target)))

    def write_level(self, target: Target, k: int, level: LevelFile, megabytes: float, triangles: int) -> dict[str, Any]:
        """Write the file of one level."""
        stem = f"{target.stem}_lod{k}" if k else target.stem
        extras = self.level_extras(target, k, level)
        if target.file_form != "glb":
            from gsbake.targets.other_files import write_other

            names = write_other(target.file_form, self.out, stem, level.mesh, level.images, level.factors, extras)
            size = sum((self.out / name).stat().st_size for name in names)
            return {names[0]: self.figures(target, k, level, size) | {"parts": names[1:]}}
        data = self.glb(target, level, extras)
        return {f"{stem}.glb": self.publish(f"{stem}.glb", data, target, megabytes, triangles) | self.figures(target, k, level, len(data))}

    def write_levels(self, target: Target, levels: list[LevelFile], megabytes: float, most: int) -> dict[str, Any]:
        """Write all levels into one file."""
        coarser = [Level(level.mesh, level.images, _coverage(k + 1)) for k, level in enumerate(levels[1:])]
        extras = self.level_extras(target, 0, levels[0]) | {"levels": [self.level_extras(target, k, v) for k, v in enumerate(levels)]}
        data = self.glb(target, levels[0], extras, coarser)
        name = f"{target.stem}_lods.glb"
        body = self.publish(name, data, target, megabytes, most)
        triangles = sum(len(level.mesh.faces) for level in levels)
        decided = f"{len(levels)} levels, {triangles} triangles"
        self.monitor.decide(f"{target.text}, all levels in one file", decided, f"{len(data) / 1e6:.2f} MB")
        return {name: body | {"target": target.text, "level": 0, "bytes": len(data), "triangles": triangles, "levels": len(levels)}}

    def glb(self, target: Target, level: LevelFile, extras: dict[str, Any], coarser: list[Level] | None = None) -> bytes:
        """The bytes of a GLB."""
        return build_glb(
            level.mesh, level.images, "asset", f"gsbake {__version__}", self.options.export.copyright, extras, level.factors,
            geometry=_geometry(target), levels=coarser or [], coverage=_coverage(0),
        )  # fmt: skip

    def publish(self, name: str, data: bytes, target: Target, megabytes: float, triangles: int) -> dict[str, Any]:
        """Write a GLB after its audit. Raises BadInputError where that fails."""
        extensions = frozenset[str]().union(*(EXTENSIONS.get(form, set()) for form in target.forms))
        findings = audit(data, name, megabytes, triangles, extensions, budget="error")
        errors = failed(findings)
        if errors:
            details = "; ".join(f"{f.rule} ({f.detail})" for f in errors)
            raise BadInputError(f"targets: {name} fails {len(errors)} audit rules: {details}; change the mesh or take another target.")
        for finding in findings:
            if not finding.passed and finding.severity == "warning":
                self.monitor.warn(f"targets: {name}: {finding.rule}: {finding.detail}.")
        (self.out / name).write_bytes(data)
        (self.out / f"{name.removesuffix('.glb')}.audit.json").write_bytes(json.dumps(as_json(findings), indent=1).encode())
        return {"audit_passed": sum(f.passed for f in findings), "audit_rules": len(findings)}

    def figures(self, target: Target, k: int, level: LevelFile, size: int) -> dict[str, Any]:
        """Figures of a file for the manifest."""
        charts = " with new charts" if level.new_charts else ""
        decided = f"{len(level.mesh.faces)} triangles{charts}, {level.texture}² texels, {level.step}"
        self.monitor.decide(f"{target.text}, level {k}", decided, f"{size / 1e6:.2f} MB; {self.pixels:.2f} pixels per baked texel")
        return {
            "target": target.text,
            "level": k,
            "bytes": size,
            "triangles": len(level.mesh.faces),
            "texture_size": level.texture,
            "images": level.step,
            "deviation": level.deviation.quantile / self.diagonal,
            "max_deviation": level.deviation.maximum / self.diagonal,
        }

    def level_extras(self, target: Target, k: int, level: LevelFile) -> dict[str, Any]:
        """The asset's extras with target, level and its error against the dense mesh, as shares of the diagonal."""
        error = {"quantile_999": level.deviation.quantile / self.diagonal, "max": level.deviation.maximum / self.diagonal}
        return self.extras | {"target": target.text, "level": k, "error_to_dense_mesh": error}

    # -- other files ----------------------------------------------------------------------------------------------------------------

    def write_masters(self, target: Target) -> dict[str, Any]:
        """Copy the baked maps, linear half floats, beside the film's GLB."""
        folder = self.out / target.stem
        folder.mkdir(exist_ok=True)
        names = []
        for role in ("base_color", "orm", "normal", "emissive"):
            path = self.folders["bake"] / f"{role}.exr"
            if path.exists():
                (folder / path.name).write_bytes(path.read_bytes())
                names.append(f"{target.stem}/{path.name}")
        if self.maps.edge < BUDGETS["film"].texture:
            evidence = "the bake has no more; bake.size = 4096 gives all maps 4096²"
            self.monitor.decide("film", f"{self.maps.edge}² texels", evidence)
        size = sum((self.out / name).stat().st_size for name in names)
        return {names[0]: {"target": target.text, "level": 0, "bytes": size, "texture_size": self.maps.edge, "parts": names[1:]}}

    def surfels(self) -> dict[str, Any]:
        """Write the surfels as splats."""
        from gsbake.targets.splats import write_splats

        profile = self.extras.get("profile")
        maps = self.maps if isinstance(profile, dict) and profile.get("materials") in ("fit", "surfels") else None
        count = write_splats(self.folders["refine"] / "surfels.safetensors", self.out / "surfels.ply", self.frame, maps)
        size = (self.out / "surfels.ply").stat().st_size
        return {"surfels.ply": {"target": SURFELS, "level": 0, "bytes": size, "splats": count}}


def _geometry(target: Target) -> Geometry:
    return target.geometry_form or "float"  # type: ignore[return-value]


def _coverage(k: int) -> float:
    """Share of the screen's height from which on level `k` is shown: each level below takes over at half the size."""
    return float(0.5 ** (k + 1))


def _extras_of(path: Path) -> dict[str, Any]:
    """Extras of the exported asset that hold for all targets; none where the user's file has none."""
    document, _ = unpack_glb(path.read_bytes(), str(path))
    found = document.get("asset", {}).get("extras", {})
    kept = ("profile", "scale", "scale_relative_error", "poses")
    return {key: found[key] for key in kept if key in found} if isinstance(found, dict) else {}
