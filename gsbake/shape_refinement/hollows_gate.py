"""Whether an opened hollow explains photos that its opening did not see.

A glossy surface shows its surroundings behind itself, and a front follows them inwards. So the closed hull is given its reflections:
diffuse colour, reflectance and distant light are fitted to the photos that the front saw, for the hull and for the opened shape, each with
and without reflections, and predict the others. An opened region stays where it predicts them much better than the hull's surface over it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from gsbake.capture.hull.visual_hull import Hull
from gsbake.kernels.threads import run_chunks
from gsbake.shape_refinement.appearance import Appearance, Geometry, choose_light_vertices, fit_appearance, fit_light
from gsbake.shape_refinement.reflection_kernel import gauss_newton_rows
from gsbake.shape_refinement.reflection_map import ReflectionMap
from gsbake.shape_refinement.samples import Doubles, Floats, Photo, VertexSamples, sample_photos
from gsbake.shape_refinement.surface import Surface, tangents

#: Share of the hull's error that an opened region may have: hollows of development objects have 0 to .16, false ones .35 to 1.4.
MOST_SHARE = 0.25
#: Least error of the hull's surface: a lid that the photos hardly disagree about may be the object. Hollows have .028 and more.
LEAST_ERROR = 0.02
#: Least cells of a region; vertices off the other surface by more than this many cells count, at least so many of them.
LEAST_CELLS, OFF, LEAST_VERTICES = 100, 1.5, 5
#: Photos that a vertex's appearance has to be fitted to.
LEAST_VIEWS = 3
#: Edge of the light's map, its level at the start, alternations of light and appearance.
LIGHT_SIZE, LIGHT_LEVEL, ALTERNATIONS = 16, 0.5, 8
#: Rounds of robust weights without reflections.
ROBUST_ROUNDS = 3


@dataclass(frozen=True)
class Verdict:
    """A region of `cells`: median relative squared error of held-out photos on the `closed` hull and on the `opened` shape, NaN where too
    few vertices are seen, and whether it was `accepted`."""

    cells: int
    closed: float
    opened: float
    accepted: bool


def judge_regions(hull: Hull, opened: Hull, photos: Sequence[Photo], held: NDArray[np.bool_]) -> tuple[list[Verdict], NDArray[np.bool_]]:
    """What is decided about each connected region that is solid in `hull` and air in `opened`, the largest first, and the cells
    (n, n, n) of those that are refused; smaller ones are refused without a verdict. `held` (photos,) are the photos that decide."""
    removed = (hull.field < 0) & (opened.field >= 0)
    label, count = ndimage.label(ndimage.binary_dilation(removed), np.ones((3, 3, 3)))
    if not count:
        return [], np.zeros(removed.shape, bool)
    size = np.bincount(label[removed], minlength=count + 1)
    before, after = (_RegionErrors(one, other, label, photos, held) for one, other in ((hull, opened), (opened, hull)))
    verdicts, accepted = [], np.zeros(count + 1, bool)
    accepted[0] = True
    for number in np.argsort(-size, kind="stable"):
        if size[number] >= LEAST_CELLS:
            closed, new = before(int(number)), after(int(number))
            accepted[number] = closed >= LEAST_ERROR and new <= MOST_SHARE * closed
            verdicts.append(Verdict(int(size[number]), closed, new, bool(accepted[number])))
    return verdicts, ~accepted[label]


class _RegionErrors:
    """Median errors of a shape by region."""

    def __init__(self, shape: Hull, other: Hull, label: NDArray[np.int32], photos: Sequence[Photo], held: NDArray[np.bool_]) -> None:
        vertices, corners = shape.triangles()
        cells = np.clip(np.floor((vertices - shape.lower) / shape.cell), 0, len(label) - 1).astype(np.int64)
        self._region = np.where(np.abs(other.field[tuple(cells.T)]) > OFF * shape.cell, label[tuple(cells.T)], 0)
        self._values = [
            prediction_errors(np.ascontiguousarray(vertices), np.ascontiguousarray(corners, np.int32), photos, held, reflections)
            for reflections in (True, False)
        ]

    def __call__(self, number: int) -> float:
        found = []
        for values in self._values:
            inside = values[(self._region == number) & np.isfinite(values)]
            if len(inside) >= LEAST_VERTICES:
                found.append(float(np.median(inside)))
        return min(found, default=float("nan"))


def prediction_errors(
    vertices: Doubles, faces: NDArray[np.int32], photos: Sequence[Photo], held: NDArray[np.bool_], reflections: bool
) -> Doubles:
    """Squared error (v,) of the `held` photos (photos,) over the squared brightness, mean over photos and channels, of what the others
    say; NaN where either see too little. Photos are linear RGB."""
    surface = Surface(len(vertices), faces)
    normals = surface.normals(vertices)
    geometry = Geometry(vertices, normals, np.stack([photo.camera.centre for photo in photos]))
    samples = sample_photos(vertices, normals, faces, photos)
    seen, asked = np.where(held, np.float32(0), samples.weight), np.where(held, samples.weight, np.float32(0))
    known = VertexSamples(samples.colour, samples.slope, np.ascontiguousarray(seen))
    robust = np.ones_like(seen)
    appearance, light = Appearance.initial(len(vertices)), ReflectionMap.constant(LIGHT_SIZE, LIGHT_LEVEL)

    def residual(weight: Floats, weights: Floats) -> Floats:
        """Squared residuals (v,) of the samples with this `weight`; `weights` get the robust ones."""
        hessian, gradient, out = np.zeros((len(vertices), 4)), np.zeros((len(vertices), 3)), np.zeros((len(vertices), 2), np.float32)
        fixed = (
            vertices, normals, tangents(normals), geometry.centres, samples.colour, samples.slope, np.ascontiguousarray(weight), weights,
            light.tables(), appearance.kind, appearance.reflectance, appearance.diffuse, appearance.variance, 0.5 * np.pi / light.size,
            hessian, gradient, out,
        )  # fmt: skip
        run_chunks(lambda start, stop: gauss_newton_rows(start, stop, *fixed), len(vertices))
        return out[:, 0]

    if reflections:
        chosen = choose_light_vertices(known, 0)
        for index in range(ALTERNATIONS):
            light = fit_light(geometry, known, robust, appearance, light, chosen)
            appearance = fit_appearance(surface, geometry, known, robust, light)
            if index >= ALTERNATIONS // 2:
                residual(seen, robust)
    else:
        appearance = fit_appearance(surface, geometry, known, robust, light)
        appearance = replace(appearance, reflectance=np.zeros_like(appearance.reflectance))
        for _ in range(ROBUST_ROUNDS):
            residual(seen, robust)
            weight = seen * robust
            total = np.maximum(weight.sum(1), 1e-9)[:, None]
            appearance = replace(appearance, diffuse=np.asarray((weight[..., None] * samples.colour).sum(1) / total, np.float32))
    error = residual(asked, np.ones_like(asked)) * appearance.importance / 3
    enough = (asked.sum(1) > 0) & ((seen > 0).sum(1) >= LEAST_VIEWS)
    return np.where(enough, error.astype(float), np.nan)
