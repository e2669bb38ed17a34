"""Report of a finished run: one HTML page that opens offline, and its figures as JSON."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsbake import __version__
from gsbake.capture.full_photos import FullPhotos
from gsbake.capture.photos.roles import test_photos
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Report
from gsbake.errors import BadInputError
from gsbake.gltf.frame import frame_between, read_transforms_json
from gsbake.monitor import SILENT, Monitor
from gsbake.report import compose, coverage, manifests
from gsbake.report.advice import advice
from gsbake.report.asset import open_asset
from gsbake.report.html import Figure, Light, Page, Panel, render_page
from gsbake.report.masks import mask_panels
from gsbake.report.page_model import page_model
from gsbake.report.quality import select_views
from gsbake.report.render import Asset, Renderer
from gsbake.report.sharpness import close_up, detail_panel, texel_density
from gsbake.report.sheets import map_panels, missed_panel
from gsbake.shading.light_motion import LightMotion
from gsbake.text import number

#: Bytes of the page, which mail and messengers still take; the asset's images in it are stored in fewer where it would exceed them.
MAX_PAGE_BYTES = 8_000_000
#: Maximum number of compared photos; more hardly change the mean.
MAX_COMPARED = 24


@dataclass(frozen=True)
class ReportOptions:
    """Settings of the report; `holdout` is that of training: every n-th photo was held out."""

    report: Report = Report()
    holdout: int = 8


def write_report(
    folders: Mapping[str, Path], out: Path, options: ReportOptions | None = None, *, threads: int = 2, monitor: Monitor = SILENT
) -> dict[str, Any]:
    """Write `report.html` and `report.json` into the folder `out` and return the figures.

    `folders` maps the stages ingest to export to their folders with manifests. Raises BadInputError when the number of the asset's cameras
    differs from the number of photos.
    """
    return _ReportWriter(folders, out, options or ReportOptions(), threads, monitor).run()


@dataclass(frozen=True)
class _Renders:
    """The asset, and its renders: metrics per compared photo, panels under other environments, and these environments."""

    asset: Asset
    posed: PosedPhotos
    scored: list[compose.ViewScore]
    held_out: bool
    lit: bool
    relit: tuple[Panel, ...]
    lights: tuple[Light, ...]
    panoramas: tuple[Panel, ...]
    map: str
    places: tuple[str, ...]
    close_up: tuple[Panel, ...]
    density: Figure


@dataclass
class _ReportWriter:
    """One run of the report."""

    folders: Mapping[str, Path]
    out: Path
    options: ReportOptions
    threads: int
    monitor: Monitor

    def __post_init__(self) -> None:
        self.manifests = manifests.load_manifests(self.folders)
        self.glb = self.folders["export"] / "asset.glb"

    def run(self) -> dict[str, Any]:
        """Render, compare and write the page; returns the figures."""
        renders = self._render()
        with self.monitor.part("page"):
            figures = self._figures(renders)
            page = self._page(renders)
            room = MAX_PAGE_BYTES - len(render_page(replace(page, model="-")).encode())
            model = base64.b64encode(page_model(self.glb.read_bytes(), 3 * room // 4)).decode()
            text = render_page(replace(page, model=model))
            views = [
                {"name": s.name, "psnr": s.metrics.psnr, "exposed_psnr": s.metrics.exposed_psnr, "ssim": s.metrics.ssim}
                for s in renders.scored
            ]
            (self.out / "report.html").write_bytes(text.encode())
            (self.out / "report.json").write_bytes(json.dumps(figures | {"views": views}, indent=1).encode())
        return figures | {"page_bytes": len(text)}

    def _render(self) -> _Renders:
        """Render the asset from the cameras of photos and under other environments."""
        settings, monitor = self.options.report, self.monitor
        light = self.folders["bake"] / "light.safetensors"
        posed = PosedPhotos.open(self.folders["poses"], self.folders["refine"])
        with monitor.part("open"):
            asset = open_asset(self.glb, unlit=not light.exists())
            cameras = read_transforms_json(self.folders["export"] / "cameras.json")
            if len(cameras) != len(posed):
                raise BadInputError(
                    f"The asset's cameras.json lists {len(cameras)} cameras for {len(posed)} photos; export the asset again."
                )
            renderer = Renderer(asset, self.threads)
            learnt = None
            if light.exists():
                learnt = compose.learnt_shader(light, compose.light_rotation(cameras[0], posed.cameras.cameras[0]))
            shader = compose.photo_shader(learnt, LightMotion.load(self.folders["bake"] / "light_motion.json"))
        monitor.check_stop()
        with monitor.part("compare"):
            indices, held = select_views(len(posed), test_photos(len(posed), self.options.holdout), MAX_COMPARED)
            scored = compose.score_views(
                renderer, shader, posed, cameras, indices, held, settings.view_size, lambda k, n: monitor.progress(k, 2 * n, "comparison")
            )
        with monitor.part("close-up"), FullPhotos(self.folders["ingest"], self.folders["poses"], self.folders["refine"]) as photos:
            shown = indices[len(indices) // 2]
            of_shown = renderer, shader(shown), photos, cameras[shown], shown
            beside = close_up(*of_shown) + detail_panel(*of_shown)
            full = [photos.camera(k) for k in range(len(photos))]
            sized = [camera.scaled(own.width, own.height) for camera, own in zip(cameras, full, strict=True)]
            metric = (self.manifests["export"].get("results") or {}).get("scale") == "metres"
            density = texel_density(asset, sized, metric)
        monitor.check_stop()
        with monitor.part("relight"):
            directions = compose.viewpoints(asset, cameras, 2 if learnt else 3)
            relit, lights = compose.relit_panels(
                renderer, learnt, directions, settings.view_size, lambda k, n: monitor.progress(n + k, 2 * n, "relighting")
            )
        with monitor.part("coverage"):
            points = coverage.surface_points(asset, self.folders["bake"] / "coverage.exr")
            proposed = () if points is None else coverage.proposals(points, renderer.caster, asset.radius)
            by_name = {s.name: s.metrics.psnr for s in scored}
            named = [replace(camera, name=own.name) for camera, own in zip(cameras, posed.cameras.cameras, strict=True)]
            region = None if posed.region is None else posed.region.moved(frame_between(posed.cameras.cameras, tuple(cameras)))
            drawn = coverage.map_json(asset, named, points, by_name, proposed, region)
            places = tuple(f"{coverage.in_words(d)} ({share:.0%} of it)" for d, share in proposed)
        panoramas = () if learnt is None else (compose.panorama(learnt, self.manifests["bake"].get("results") or {}),)
        return _Renders(asset, posed, scored, held, learnt is not None, relit, lights, panoramas, drawn, places, beside, density)

    def _figures(self, renders: _Renders) -> dict[str, Any]:
        """The figures of `report.json`."""
        return {
            "psnr": compose.mean([s.metrics.psnr for s in renders.scored]),
            "exposed_psnr": compose.mean([s.metrics.exposed_psnr for s in renders.scored]),
            "ssim": compose.mean([s.metrics.ssim for s in renders.scored]),
            "held_out": renders.held_out,
            "compared": len(renders.scored),
            "triangles": len(renders.asset.faces),
            "texture": max(renders.asset.base_color.shape[:2]),
            "bytes": self.glb.stat().st_size,
            "seconds": manifests.total_seconds(self.manifests),
            "peak_bytes": manifests.peak(self.manifests)[0],
        }

    def _page(self, renders: _Renders) -> Page:
        """The contents of the page but for the asset itself."""
        found, lit, posed, scored = self.manifests, renders.lit, renders.posed, renders.scored
        shown, _ = select_views(len(scored), [], self.options.report.views)
        logs = {name: manifests.read_log(self.folders[name] / "log.csv") for name in ("train", "refine")}
        count = len(json.loads((self.folders["ingest"] / "photos.json").read_text(encoding="utf-8"))["photos"])
        refined = (self.folders["refine"] / "cameras.json").exists()
        return Page(
            title=manifests.capture_name(found),
            lead=_lead(count, _kind(lit, found), posed.cameras.poses),
            figures=compose.headline(found, renders.asset, self.glb.stat().st_size, scored, (len(posed), count), renders.density),
            warnings=tuple(replace(w, advice=advice(w.text, renders.places)) for w in manifests.warnings(found)),
            model="",
            lights=renders.lights,
            comparisons=compose.comparisons([scored[i] for i in shown]),
            comparison_note=_comparison_note(renders.held_out, posed.has_masks, lit, refined),
            relit_title="Under other environments" if lit else "Other views",
            relit=renders.relit,
            relit_note="The learnt environment map is that of the photos; studio and sunset are procedural."
            if lit
            else "The base colour contains the shading of the photos, as this profile sets; it is shown unlit.",
            maps=map_panels(renders.asset) + missed_panel(renders.asset, self.folders["bake"] / "coverage.exr"),
            maps_note="The textures of the GLB, downsampled for this page; click to enlarge.",
            audit=manifests.audit_rows(self.folders["export"] / "audit.json"),
            curves=manifests.training_charts(logs),
            curves_note="",
            skip_decisions=manifests.skip_decisions(found),
            decisions=manifests.decisions(found),
            stages=manifests.stage_rows(found),
            time_chart=manifests.time_chart(found),
            memory_chart=manifests.memory_chart(found),
            run_note=manifests.run_note(found),
            footer=f"gsbake {__version__}.",
            panoramas=renders.panoramas,
            map=renders.map,
            places=renders.places,
            close_up=renders.close_up,
            masks=mask_panels(self.folders["poses"], found["poses"].get("results") or {}),
        )


def _kind(lit: bool, found: manifests.Manifests) -> str:
    """What the asset's colours contain."""
    if not lit:
        return "colour with the shading of the photos"
    if found["bake"].get("settings", {}).get("bake.materials") == "delight":
        return "diffuse colour without shading"
    return "base colour, roughness and metallic fitted together with the environment map"


def _lead(photos: int, kind: str, poses: str) -> str:
    """The line below the title."""
    source = "poses given" if poses == "given" else "poses from structure from motion"
    return f"{number(photos)} photos, {source}; {kind}."


def _comparison_note(held: bool, masked: bool, lit: bool, refined: bool) -> str:
    """How photos and renders are compared."""
    shading = "under the learnt environment map" if lit else "unlit"
    fitted = "No photo was held out: training fitted these, so the figures are too high."
    poses = ["Their poses were fitted to the trained surfels."] if refined else []
    pixels = "the pixels where mask or asset shows the object." if masked else "the asset's pixels, because there are no masks."
    return " ".join(
        [
            f"The exported GLB rendered from the photos' cameras, {shading}.",
            "These photos were held out of training." if held else fitted,
            *poses,
            f"Figures are over {pixels}",
        ]
    )
