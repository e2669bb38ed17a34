"""Stage report: the finished run → one HTML page that opens offline, and its figures as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsbake.pipeline.errors import BadInputError
from gsbake.pipeline.stage import Context, Stage

#: Photos compared at most; more would not change the mean.
MOST_COMPARED = 24


def run(ctx: Context) -> dict[str, Any]:
    """Write `report.html` and `report.json`; return the figures."""
    import base64
    import json

    from gsbake import __version__
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.report import compose, manifests
    from gsbake.report.asset import open_asset
    from gsbake.report.html import Page, render_page
    from gsbake.report.quality import asset_cameras, chosen_views
    from gsbake.report.render import Renderer, Shader, unlit
    from gsbake.report.sheets import map_panels
    from gsbake.surfels.training.views import held_out

    settings = ctx.settings.report
    said = manifests.load_manifests(ctx.inputs)
    glb = ctx.inputs["export"] / "asset.glb"
    light = ctx.inputs["bake"] / "light.safetensors"
    posed = PosedPhotos.open(ctx.inputs["poses"], ctx.inputs["refine"])
    with ctx.part("open"):
        asset = open_asset(glb, unlit=not light.exists())
        cameras = asset_cameras(ctx.inputs["export"] / "cameras.json")
        if len(cameras) != len(posed):
            raise BadInputError(f"The asset's cameras.json lists {len(cameras)} cameras for {len(posed)} photos; export the asset again.")
        renderer = Renderer(asset, ctx.threads)
        learnt = None
        if light.exists():
            learnt = compose.learnt_shader(light, compose.light_rotation(cameras[0], posed.cameras.cameras[0]))
    shader: Shader = learnt or unlit
    ctx.check_stop()
    with ctx.part("compare"):
        indices, held = chosen_views(len(posed), held_out(len(posed), ctx.settings.train.holdout), MOST_COMPARED)
        scored = compose.score(
            renderer, shader, posed, cameras, indices, held, settings.view_size, lambda k, n: ctx.progress(k, 2 * n, "photo and render")
        )
        shown, _ = chosen_views(len(scored), [], settings.views)
    ctx.check_stop()
    with ctx.part("relight"):
        directions = compose.viewpoints(asset, cameras, 2 if learnt else 3)
        relit, lights = compose.relit_panels(
            renderer, learnt, directions, settings.view_size, lambda k, n: ctx.progress(n + k, 2 * n, "other lights")
        )
    with ctx.part("page"):
        size = glb.stat().st_size
        figures = {
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
        views = [{"name": s.name, "psnr": s.likeness.psnr, "ssim": s.likeness.ssim} for s in scored]
        logs = {name: manifests.read_log(ctx.inputs[name] / "log.csv") for name in ("train", "refine")}
        count = len(json.loads((ctx.inputs["ingest"] / "photos.json").read_text(encoding="utf-8"))["photos"])
        masked = posed.has_masks
        page = Page(
            title=manifests.capture_name(said),
            lead=_lead(count, _kind(bool(learnt), said), posed.cameras.poses),
            figures=compose.headline(said, asset, size, scored, (len(posed), count)),
            warnings=manifests.warnings(said),
            model=base64.b64encode(glb.read_bytes()).decode(),
            lights=lights,
            comparisons=compose.comparisons([scored[i] for i in shown]),
            comparison_note=_comparison_note(held, masked, bool(learnt), (ctx.inputs["refine"] / "cameras.json").exists()),
            relit_title="Under other light" if learnt else "From other sides",
            relit=relit,
            relit_note="The learnt light is the one in the photos; studio and sunset lit none of them."
            if learnt
            else "The base colour holds the light of the photos, as this profile asks; it is shown without any other light.",
            maps=map_panels(asset),
            maps_note="The textures inside the GLB, reduced for this page; click to enlarge.",
            audit=manifests.audit_rows(ctx.inputs["export"] / "audit.json"),
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
        text = render_page(page)
        (ctx.out / "report.html").write_text(text, encoding="utf-8")
        (ctx.out / "report.json").write_text(json.dumps(figures | {"views": views}, indent=1))
    return figures | {"page_bytes": len(text)}


def _kind(lit: bool, said: Mapping[str, Mapping[str, Any]]) -> str:
    """What the asset's colours are."""
    if not lit:
        return "colour as photographed"
    if said["bake"].get("settings", {}).get("bake.materials") == "delit":
        return "diffuse colour, without the shading of the photos' light"
    return "base colour, roughness and metallic learnt together with the light"


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


STAGE = Stage(
    name="report",
    version=2,
    title="write the report",
    run=run,
    needs=("ingest", "poses", "stereo", "train", "refine", "mesh", "bake", "export"),
    settings=("report.*", "train.holdout"),
)
