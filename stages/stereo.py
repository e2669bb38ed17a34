"""Stage stereo: posed photos → depth maps and oriented points, where photos can be matched."""

from __future__ import annotations

from typing import Any

from gsbake.pipeline.stage import Context, Stage

#: With fewer photos, or smaller ones, matching says too little to be worth its time.
LEAST_PHOTOS, LEAST_SIZE = 5, 200
#: Parts too thin for the hull get points as dense as so many all over the object.
THIN_POINTS = 40_000


def run(ctx: Context) -> dict[str, Any]:
    """Write `points.ply`, `depth/<name>.npz` and, with masks, `hull.npz` and `thin.npz`; nothing when stereo is skipped."""
    import numpy as np

    from gsbake.capture.hull.thin_parts import find_thin
    from gsbake.capture.hull.visual_hull import visual_hull
    from gsbake.capture.posed_photos import PosedPhotos
    from gsbake.mvs.matching import StereoRun
    from gsbake.mvs.outliers import find_ghosts, without_ghosts
    from gsbake.mvs.pyramids import one_thread

    posed = PosedPhotos.open(ctx.inputs["poses"])
    settings = ctx.settings.stereo
    size = float(np.median([max(c.width, c.height) for c in posed.cameras.cameras]))
    if settings.enabled == "never":
        ctx.decide("stereo", "skipped", "the profile asks for none")
        return {"points": 0}
    if settings.enabled == "auto" and (len(posed) < LEAST_PHOTOS or size < LEAST_SIZE):
        ctx.decide("stereo", "skipped", f"{len(posed)} photos of {size:.0f} pixels; {LEAST_PHOTOS} of {LEAST_SIZE} are needed")
        return {"points": 0}

    def step(done: int, text: str) -> None:
        ctx.check_stop()
        ctx.progress(min(done, len(posed)), len(posed), text)

    with one_thread():
        hull = None
        if posed.has_masks:
            with ctx.part("hull"):
                hull = visual_hull(posed)
            hull = None if hull.empty else hull
        run = StereoRun(posed, settings, hull, ctx.seed, ctx.threads, ctx.checkpoint / "planes", step)
        with ctx.part("photos"):
            run.prepare()
        lonely = sum(not n for n in run.matched)
        ctx.decide(
            "depth lies between",
            "the bounds of the visual hull" if hull is not None else "the bounds of the unit ball",
            "all photos have masks" if hull is not None else "not all photos have masks",
        )
        with ctx.part("matching"):
            run.match()
        with ctx.part("confirming"):
            maps = run.confirm()
        with ctx.part("fusing"):
            cloud = run.points(maps)
            ghosts = find_ghosts(cloud, hull)
            if ghosts.points:
                cloud = cloud.select(~ghosts.hold(cloud.points))
                maps = [without_ghosts(one, ghosts) for one in maps]
                ctx.decide(
                    "loose stereo pieces", f"{ghosts.points} points dropped", "too few, or alone and deep under the hull: mirror images"
                )
        with ctx.part("opening"):
            opened = run.opened()
    if opened is not None:
        opened.hull.save(ctx.out / "hull.npz")
        ctx.decide(
            "hull opened at",
            f"{opened.made} places",
            f"photos see through {100 * opened.share:.1f} % of its cells onto a surface behind, "
            f"at {opened.refused} other places onto none, at {opened.holed} against silhouettes",
        )
    if hull is not None:
        with ctx.part("thin parts"):
            slight = find_thin(posed, hull, THIN_POINTS, ctx.seed)
        ctx.decide(
            "thin parts",
            f"{len(slight.points)} points" if len(slight.points) else "none",
            f"{100 * slight.share:.1f} % of the masks is narrower than a cell of the hull",
        )
        slight.save(ctx.out / "thin.npz")
    (ctx.out / "depth").mkdir()
    for one in maps:
        one.save(ctx.out / "depth" / f"{one.camera.name}.npz")
    cloud.save(ctx.out / "points.ply")
    inside = sum(int(sizes[-1].inside.sum()) for sizes in run.photos)
    settled = sum(int((m.confidence > 0).sum()) for m in maps) / max(inside, 1)
    ctx.decide(
        "confirmed",
        f"{len(cloud)} points",
        f"{100 * settled:.0f} % of the object's pixels are confirmed by {settings.min_views} or more other photos",
    )
    if lonely:
        ctx.decide("photos that were not matched", str(lonely), "no other photo sees the same 5 to 45 degrees away")
    return {
        "points": len(cloud),
        "settled_share": settled,
        "pixels": inside,
        "unmatched_photos": lonely,
        "neighbours": float(np.mean([len(n) for n in run.matched])),
        "median_views": float(np.median(cloud.views)) if len(cloud) else 0.0,
    }


STAGE = Stage(
    name="stereo",
    version=4,
    title="Multi-view stereo",
    run=run,
    needs=("poses",),
    settings=("stereo.*",),
    seeded=True,
)
