"""From a finished run to its report: one HTML page that opens offline, and its figures as JSON."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbake import __version__
from gsbake.capture.posed_photos import PosedPhotos
from gsbake.config.schema import Report
from gsbake.errors import BadInputError
from gsbake.monitor import SILENT, Monitor
from gsbake.report import compose, manifests
from gsbake.report.asset import open_asset
from gsbake.report.html import Page, render_page
from gsbake.report.quality import asset_cameras, chosen_views
from gsbake.report.render import Asset, Renderer, Shader, unlit
from gsbake.report.sheets import map_panels
from gsbake.surfels.training.views import held_out

#: Photos compared at most; more would not change the mean.
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

    `folders` maps the names of the stages before (ingest to export) to their folders with manifests. Raises BadInputError when the asset's
    cameras are not those of the photos.
    """
    return _Reporting(folders, out, options or ReportOptions(), threads, monitor).run()


@dataclass
class _Reporting:
    """One run."""

    folders: Mapping[str, Path]
    out: Path
    options: ReportOptions
    threads: int
    monitor: Monitor

    def run(self) -> dict[str, Any]:
        """The recipe."""
        settings, monitor = self.options.report, self.monitor
        said = manifests.load_manifests(self.folders)
        glb, light = self.folders["export"] / "asset.glb", self.folders["bake"] / "light.safetensors"
        posed = PosedPhotos.open(self.folders["poses"], self.folders["refine"])
        with monitor.part("open"):
            asset = open_asset(glb, unlit=not light.exists())
            cameras = asset_cameras(self.folders["export"] / "cameras.json")
            if len(cameras) != len(posed):
                raise BadInputError(
                    f"The asset's cameras.json lists {len(cameras)} cameras for {len(posed)} photos; export the asset again."
                )
            renderer = Renderer(asset, self.threads)
            learnt = None
            if light.exists():
                learnt = compose.learnt_shader(light, compose.light_rotation(cameras[0], posed.cameras.cameras[0]))
        shader: Shader = learnt or unlit
        monitor.check_stop()
        with monitor.part("compare"):
            indices, held = chosen_views(len(posed), held_out(len(posed), self.options.holdout), MAX_COMPARED)
            scored = compose.score(
                renderer, shader, posed, cameras, indices, held, settings.view_size, lambda k, n: monitor.progress(k, 2 * n, "comparison")
            )
            shown, _ = chosen_views(len(scored), [], settings.views)
        monitor.check_stop()
        with monitor.part("relight"):
            directions = compose.viewpoints(asset, cameras, 2 if learnt else 3)
            relit, lights = compose.relit_panels(
                renderer, learnt, directions, settings.view_size, lambda k, n: monitor.progress(n + k, 2 * n, "relighting")
            )
        with monitor.part("page"):
            figures = self._figures(asset, scored, held, glb.stat().st_size, said)
            page = self._page(said, asset, posed, scored, [scored[i] for i in shown], held, bool(learnt), glb, lights, relit)
            text = render_page(page)
            views = [{"name": s.name, "psnr": s.likeness.psnr, "ssim": s.likeness.ssim} for s in scored]
            (self.out / "report.html").write_text(text, encoding="utf-8")
            (self.out / "report.json").write_text(json.dumps(figures | {"views": views}, indent=1))
        return figures | {"page_bytes": len(text)}

    def _figures(
        self, asset: Asset, scored: list[compose.Scored], held: bool, size: int, said: Mapping[str, Mapping[str, Any]]
    ) -> dict[str, Any]:
        """The figures of `report.json`."""
        return {
            "psnr": compose.mean([s.likeness.psnr for s in scored]),
            "ssim": compose.mean([s.likeness.ssim for s in scored]),
            "held_out": held,
            "compared": len(scored),
            "triangles": len(asset.faces),
            "texture": max(asset.base_color.shape[:2]),
            "bytes": size,
            "seconds": manifests.total_seconds(said),
            "peak_bytes": manifests.peak(said)[0],
        }

    def _page(
        self, said: Mapping[str, Mapping[str, Any]], asset: Asset, posed: PosedPhotos, scored: list[compose.Scored],
        shown: list[compose.Scored], held: bool, lit: bool, glb: Path, lights: Any, relit: Any,
    ) -> Page:  # fmt: skip
        """The contents of the page."""
        logs = {name: manifests.read_log(self.folders[name] / "log.csv") for name in ("train", "refine")}
        count = len(json.loads((self.folders["ingest"] / "photos.json").read_text(encoding="utf-8"))["photos"])
        refined = (self.folders["refine"] / "cameras.json").exists()
        return Page(
            title=manifests.capture_name(said),
            lead=_lead(count, _kind(lit, said), posed.cameras.poses),
            figures=compose.headline(said, asset, glb.stat().st_size, scored, (len(posed), count)),
            warnings=manifests.warnings(said),
            model=base64.b64encode(glb.read_bytes()).decode(),
            lights=lights,
            comparisons=compose.comparisons(shown),
            comparison_note=_comparison_note(held, posed.has_masks, lit, refined),
            relit_title="Under other light" if lit else "From other sides",
            relit=relit,
            relit_note="The learnt light is the one in the photos; studio and sunset lit none of them."
            if lit
            else "The base colour contains the light of the photos, as this profile asks; it is shown without any other light.",
            maps=map_panels(asset),
            maps_note="The textures inside the GLB, reduced for this page; click to enlarge.",
            audit=manifests.audit_rows(self.folders["export"] / "audit.json"),
            curves=manifests.training_charts(logs),
            curves_note="",
            left_out=manifests.left_out(said),
            decisions=manifests.decisions(said),
            stages=manifests.stage_rows(said),
            time_chart=manifests.time_chart(said),
            memory_chart=manifests.memory_chart(said),
            run_note=manifests.run_note(said),
            footer=f"gsbake {__version__}.",
        )


def _kind(lit: bool, said: Mapping[str, Mapping[str, Any]]) -> str:
    """What the asset's colours are."""
    if not lit:
        return "colour as photographed"
    if said["bake"].get("settings", {}).get("bake.materials") == "delight":
        return "diffuse colour, without the shading of the photos' light"
    return "base colour, roughness and metallic fitted together with the light"


def _lead(photos: int, kind: str, poses: str) -> str:
    """The line below the title."""
    found = "poses given" if poses == "given" else "poses solved from the photos"
    return f"{photos} photos, {found}; {kind}."


def _comparison_note(held: bool, masked: bool, lit: bool, refined: bool) -> str:
    """What is compared, and how."""
    words = ["The exported GLB drawn from the photos' cameras" + (" under the learnt light." if lit else ", unlit.")]
    unseen, seen = "Training never saw these photos.", "No photo was held out, so training saw these: the figures flatter."
    both = "Figures are over the pixels where mask or asset shows the object."
    own = "There are no masks: figures are over the asset's pixels."
    fitted = ["Their poses were fitted to the trained surfels."] if refined else []
    return " ".join([*words, unseen if held else seen, *fitted, both if masked else own])
