"""The recipe of the material fit: all its passes in order, and those among gradient steps.

Fits from several starts run on the coarsest level, where a step costs a sixteenth; they choose a start, and nothing else of them is used.
The fit from it, with all searches (light, metals, emissive regions), runs on the coarse level, where a step costs a quarter. The fine
level continues from the result for a few steps: it sharpens base colours and the edges of metals. Shares are those of
`bake.fit_iterations`; among gradient steps `at` are shares of these. A pass that is left out by its name is left out wherever it stands
(`benchmarks.ablation`).
"""

from __future__ import annotations

from dataclasses import replace

from gsbake.materials.base_color_noise import MetalNoise
from gsbake.materials.descent import Steps
from gsbake.materials.levels import FineLevel, FullTexture, GradientSteps, MapSelection, PureMetals
from gsbake.materials.metal_superresolution import MetalSuperresolution
from gsbake.materials.metal_trials import KindTrials, LightLevel
from gsbake.materials.passes import Pass
from gsbake.materials.remaining_shading import RemainingShading
from gsbake.materials.searches import EmissionSearch, LightInterval, LightScaling, LightSearch, MetalSearch
from gsbake.materials.starts import ChosenStart, MotionComparison, StartComparison

#: Trials of how the light moves: metals take longer to find than such a fit, and have not changed which light fits better.
MOTION_TRIAL = Steps(0.25, sparsity=False, passes=(Pass("light-scaling", LightScaling(), at=(0.6,)),))
#: The first steps from a start. The light of a mostly metallic object is scaled once metals are found, with the light that they have.
TRIAL = Steps(
    0.25, sparsity=False,
    passes=(Pass("light-scaling", LightScaling(), at=(0.6,)), Pass("metal-search", MetalSearch(), at=(0.4, 0.8))),
)  # fmt: skip
#: The steps that follow, with all searches.
COARSE = Steps(
    0.5,
    passes=(
        Pass("emission", EmissionSearch(), at=(0.5,)),
        Pass("light-search", LightSearch(), at=(0.5, 0.6, 0.7, 0.8)),
        Pass("metal-search", MetalSearch(), at=(0.3, 0.55, 0.8)),
    ),
)
#: A fit that is compared with those from other starts: as many steps as a sharp light takes.
START = Steps(
    0.9, sparsity=False, photos_per_light=2,
    passes=(
        Pass("light-scaling", LightScaling(), at=(0.25,)),
        Pass("emission", EmissionSearch(), at=(0.6,)),
        Pass("light-search", LightSearch(), at=(0.5, 0.65, 0.8)),
        Pass("metal-search", MetalSearch(), at=(0.15, 0.35, 0.6, 0.8)),
    ),
)  # fmt: skip
#: Texels and light adapt to a change; slowly, so that noise of single photos does not decide.
ADAPT = Steps(0.15, rate=0.3, sparsity=False)
#: The same to another kind, in many trials.
TURN = Steps(0.1, rate=0.3, sparsity=False, photos_per_light=2)
ADAPT_AND_SEARCH = Steps(0.15, rate=0.3, sparsity=False, passes=(Pass("light-search", LightSearch(), at=(0.0,)),))
#: Texels adapt to a light that is given.
RELIT = Steps(0.05, rate=0.5, normals=True)
#: The fine level.
FINE = Steps(0.25, normals=True, passes=(Pass("metal-search", MetalSearch(), at=(0.3,)),))


def coarsest(steps: Steps) -> Steps:
    """The same on the coarsest level: fewer, as only the order of the motions counts, with one step of the light, which takes most of the
    time there, for two photos, and without the sparsity prior, whose means take as long as the steps between."""
    return replace(steps, share=0.6 * steps.share, photos_per_light=2, sparsity=False)


_STARTS = StartComparison(START)
#: The fit.
FIT = (
    # On the coarsest level.
    Pass("light-motion", MotionComparison(coarsest(MOTION_TRIAL), coarsest(COARSE))),
    Pass("starts", _STARTS, instead=replace(_STARTS, dielectric_starts=((0.05, 0.45),), metal_starts=())),
    # On the coarse level.
    Pass("coarse-level", ChosenStart()),
    Pass("coarse-steps", GradientSteps(TRIAL, "material fit, coarse level")),
    Pass("coarse-steps", GradientSteps(COARSE, "material fit, coarse level")),
    Pass("metal-noise", MetalNoise(steps=ADAPT)),
    Pass("metal-trials", KindTrials(TURN)),
    Pass("light-level", LightLevel(ADAPT_AND_SEARCH)),
    Pass("remaining-shading", RemainingShading(RELIT, rounds=4)),
    Pass("pure-metals", PureMetals()),
    Pass("light-interval", LightInterval()),
    # On the fine level.
    Pass("fine-level", FineLevel()),
    Pass("fine-steps", GradientSteps(FINE, "material fit, fine level")),
    Pass("metal-noise", MetalNoise()),
)
#: The maps at the texels of the asset.
MAPS = (
    Pass("map-selection", MapSelection()),
    Pass("full-texture", FullTexture()),
    Pass("metal-superresolution", MetalSuperresolution()),
)

#: Names of the passes that can be left out.
OPTIONAL = tuple(
    dict.fromkeys(
        one.name
        for one in (*FIT, *MAPS, *TRIAL.passes, *COARSE.passes)
        if one.name not in ("light-scaling", "coarse-level", "coarse-steps", "fine-level", "fine-steps", "full-texture")
    )
)
