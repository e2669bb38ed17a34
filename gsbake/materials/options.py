"""Options of the material fit: prior weights, schedule, and the constants of the optimisation."""

from __future__ import annotations

from dataclasses import dataclass

from gsbake.config.schema import Bake


@dataclass(frozen=True)
class Priors:
    """Weights of the regularisation terms in `gsbake.materials.fit`; the settings of the same names in [bake]."""

    smoothness: float
    base_color_l1: float
    metallic_l1: float
    neutral_light: float
    sparsity: float

    @classmethod
    def of(cls, settings: Bake) -> Priors:
        """The weights in the settings of the bake."""
        return cls(settings.smoothness, settings.base_color_l1, settings.metallic_l1, settings.neutral_light, settings.sparsity)


@dataclass(frozen=True)
class FitSchedule:
    """What a fit does in `iterations` steps of one photo each, whose order follows from `seed`.

    Metals are searched for at the shares `metal_searches_at` of all steps, but not on an object that is `diffuse`. Without `emission`
    nothing is emissive, without `sparsity` the sparsity prior is off. The light's intensity is searched for at `light_searches_at`; between
    these and without any it is left to gradient steps. At `light_scaled_at` only a mostly metallic object has its light scaled.
    `rate` is a factor on all learning rates; with `fixed_light` the light is given. Without `normals` those of the mesh stay.
    """

    iterations: int
    seed: int = 0
    metal_searches_at: tuple[float, ...] = (0.3, 0.55, 0.8)
    emission: bool = True
    light_searches_at: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8)
    light_scaled_at: tuple[float, ...] = ()
    sparsity: bool = True
    diffuse: bool = False
    rate: float = 1.0
    fixed_light: bool = False
    normals: bool = True


@dataclass(frozen=True)
class FitOptions:
    """Constants of the material fit. Points in time are shares of all steps."""

    #: Adam's learning rate of the texels' logits, per step.
    texel_rate: float = 0.15
    #: Adam's learning rate of the environment map's raw values, per step.
    light_rate: float = 0.3
    #: Adam's learning rate of the normal offsets, per step; small, as the mesh's normals are nearly right.
    normal_rate: float = 0.01
    #: Factor on the learning rates of texels and of the light at the last step; the decay is exponential.
    final_rate: float = 0.1
    light_final_rate: float = 0.03
    #: Adam's decay rates of the first and second moments; short, as a fit has a few hundred steps.
    betas: tuple[float, float] = (0.9, 0.99)
    #: Adam's ε for texels and normals, a gradient of the loss per texel: texels that few pixels show take smaller steps.
    epsilon: float = 2e-3

    #: Range of initial linear base colour: logits stay finite.
    base_color_range: tuple[float, float] = (0.01, 0.95)

    #: Factor on the reconstruction error against the priors.
    residual_weight: float = 1.5
    #: Pseudo-Huber scale in sRGB values (0..1): larger errors count linearly.
    robust_scale: float = 0.1
    #: The same where fits are compared: small, as misplaced highlights would decide, which a blurred light avoids and a sharp one does not.
    comparison_scale: float = 0.02
    #: Factors on the smoothness weight for base colour (3), roughness and metallic: prints change the base colour alone.
    smoothness_channels: tuple[float, ...] = (1.0, 1.0, 1.0, 6.0, 4.0)
    #: Weight of the squared normal offset: normals stay near those of the mesh.
    normal_offset_weight: float = 0.1
    #: Weight of the squared difference of neighbouring normal offsets, on a texture of 512 texels; grows with the square of the size.
    normal_smoothness: float = 60.0

    #: Steps between updates of visibility and indirect light; both change slowly.
    visibility_interval: int = 25

    #: Start of the sparsity prior: the light's intensity must be known.
    sparsity_from: float = 0.5
    #: Steps between updates of the common materials.
    sparsity_interval: int = 50
    #: Factor on the accumulated residual at each update of visibility: a running mean over about three updates.
    residual_decay: float = 0.7

    #: When emissive regions are searched for: the light must be known.
    emission_search_at: float = 0.5

    #: Pixels per texel, of all photos together, that such a search uses: neighbouring texels decide together.
    metal_pixels: int = 3
    #: Metallic of texels detected as metal, from where gradient steps go on.
    detected_metallic: float = 0.9
    #: The same of dielectric texels.
    detected_dielectric: float = 0.05
    #: Highest metallic of rescaled metals: logits stay finite.
    max_metallic: float = 0.99

    #: Pixels that a search for the light's intensity uses at most, and the least share of dielectric texels: reflections of metal do not
    #: tell the intensity.
    intensity_pixels: int = 100_000
    min_dielectric_share: float = 0.5
    #: Photos that take part in it where the light moves: each has tables of its own.
    moving_light_photos: int = 12
    #: Texels below this metallic take part as dielectric.
    max_dielectric_metallic: float = 0.3
    #: Searches that include the light's tint on a diffuse object: its reflections hardly determine the tint, which then drifts.
    diffuse_tint_searches: int = 2
    #: Lowest linear base colour after an intensity change.
    min_base_color: float = 1e-3
