"""Every setting gsbake has, by section; each field's description is its help text.

A profile (TOML) fills these sections; an unknown key or a value outside its range is an error that names the nearest valid key.
A stage declares the fields it reads (`"train.iterations"` or `"train.*"`): only those enter its cache key.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Fraction = Annotated[float, Field(ge=0, le=1)]
Rule = Literal["auto", "always", "never"]
Pruning = Literal["visibility", "sdf", "gsdf", "gaussianroom", "gs-ror2"]


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, docs come from the field descriptions."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Ingest(Section):
    """Reading photos, masks and known poses."""

    max_size: int = Field(1600, ge=16, le=16384, description="Longer side of the working photos in pixels; larger photos are reduced with an area filter.")
    invert_masks: bool = Field(False, description="Masks are white where the background is.")
    min_photos: int = Field(3, ge=2, description="Fewer usable photos than this is an error.")


class Poses(Section):
    """Structure from motion and the normalisation to the unit object."""

    max_features: int = Field(8192, ge=256, description="SIFT features per photo.")
    peak_threshold: float = Field(0.0033, gt=0, description="SIFT peak threshold; lower finds more features on smooth objects.")
    matching: Literal["auto", "exhaustive", "ranked", "sequential", "vocabulary"] = Field("auto", description="Which pairs are matched; auto chooses by photo count and names.")
    mapper: Literal["incremental", "global"] = Field("incremental", description="COLMAP mapper.")
    min_registered: Fraction = Field(0.5, description="Fewer registered photos than this share is an error.")
    masked_features: bool | Literal["auto"] = Field(
        "auto", description="Find features only inside the masks; auto does so where the background stands still (turntables)."
    )
    max_size: int = Field(1600, ge=64, le=16384, description="Longer side in pixels at which features are found.")
    fine_features: bool | Literal["auto"] = Field(
        "auto", description="Find features in photos enlarged twice too (5 times the cost); auto does so where there are few others or photos fail to register."
    )


class Stereo(Section):
    """Multi-view stereo: depth where photos can be matched."""

    enabled: Literal["auto", "always", "never"] = Field("auto", description="Match photos before training; auto leaves it out when they are too few or too small.")
    max_size: int = Field(800, ge=64, le=4000, description="Longer side in pixels at which photos are matched.")
    neighbours: int = Field(6, ge=1, le=8, description="Photos each photo is matched against.")
    best_views: int = Field(4, ge=1, le=8, description="Of these, how many must fit at each pixel: the best ones there.")
    confirming: int = Field(12, ge=1, le=32, description="Photos whose depths may confirm a photo's depths.")
    min_views: int = Field(2, ge=1, le=10, description="Photos that must confirm a depth.")


class Splat(Section):
    """The surfel model and its rasteriser."""

    shading: Literal["colour", "pbr"] = Field("colour", description="colour: plain colour with view dependence; pbr: deferred split-sum shading with a learnt environment light.")
    sh_degree: int = Field(1, ge=0, le=2, description="Degree of the view dependence (spherical harmonics) in colour shading.")
    transfer: Literal["sech2", "bell", "gaussian", "laplace", "neus"] = Field("sech2", description="How an SDF sample becomes opacity: the discretized SDF's sech2, 3DGSR's bell, a Gaussian, or the laws of VolSDF (laplace) and NeuS on a thin layer.")
    max_surfels: int = Field(60_000, ge=100, description="Upper bound on the number of surfels.")
    env_size: int = Field(32, ge=4, le=128, description="Edge of the environment cube map in texels.")


class Train(Section):
    """Training of the surfels."""

    iterations: int = Field(3000, ge=0, description="Training steps; the schedule scales with it.")
    max_size: int = Field(512, ge=16, description="Longer side of the training photos in pixels.")
    coarse_share: Fraction = Field(0.5, description="Share of the run at half resolution.")
    init_surfels: int = Field(20_000, ge=10, description="Surfels to start with.")
    init: Literal["auto", "stereo", "points", "hull", "sphere"] = Field("auto", description="Where surfels start: stereo, SfM points, visual hull, a sphere, or the best available.")
    densify: Literal["auto", "gradient", "sdf", "gsdf", "gaussianroom", "none"] = Field(
        "gradient", description="Which surfels multiply: those with the largest screen gradient; sdf: of these, those within a spacing of the surface; the rules of GSDF or GaussianRoom; none. auto: none where they start from stereo, else gradient."
    )
    prune: Pruning = Field("visibility", description="Surfels dropped in training for being off the surface by their own SDF samples (the rules of refine.prune).")
    holdout: int = Field(8, ge=0, description="Every n-th photo is held out of training for the quality figure; 0 holds none out.")
    lr_position: float = Field(8e-4, gt=0, description="Adam rate of positions at the start; decays to 1/100.")
    lr_scale: float = Field(0.02, gt=0, description="Adam rate of log-scales.")
    lr_rotation: float = Field(2e-3, gt=0, description="Adam rate of quaternions.")
    lr_sdf: float = Field(0.005, gt=0, description="Adam rate of SDF samples.")
    lr_gamma: float = Field(0.03, gt=0, description="Adam rate of the sharpness.")
    lr_material: float = Field(1.6e-2, gt=0, description="Adam rate of colours and materials; decays to 1/10.")
    lr_light: float = Field(5e-2, gt=0, description="Adam rate of the environment light; decays to 1/10.")


class Loss(Section):
    """Loss weights (METHOD: reflective / diffuse objects)."""

    ssim: Fraction = Field(0.2, description="Share of 1-SSIM in the colour loss.")
    median: float = Field(1.0, ge=0, description="Sharpness: pulls gamma up as the SDF median shrinks.")
    projection: float = Field(10.0, ge=0, description="Surfels moved by their SDF sample must lie on the rendered depth.")
    normal: float = Field(0.2, ge=0, description="Surfel normals against normals of the depth map.")
    distortion: float = Field(100.0, ge=0, description="Concentration of weights along the ray (2DGS).")
    mask: float = Field(0.3, ge=0, description="Alpha against the mask.")
    smoothness: float = Field(0.02, ge=0, description="Edge-aware smoothness of the materials.")
    white_light: float = Field(0.005, ge=0, description="Neutral environment light.")


class Refine(Section):
    """SDF-guided pruning, densification and the short fine-tune after training."""

    iterations: int = Field(600, ge=0, description="Fine-tuning steps after pruning and densifying.")
    prune: Pruning = Field(
        "visibility", description="Surfels dropped for being off the rendered surface: visibility drops none; sdf by spacings (prune_distance); the rules of GSDF, GaussianRoom or GS-ROR²."
    )
    prune_distance: float = Field(3.0, gt=0, description="Drop surfels farther from the zero set than this many surfel spacings (refine.prune = sdf).")
    densify_share: Fraction = Field(0.3, description="At most this share of surfels is added where the surface is under-sampled.")


class Mesh(Section):
    """Field, marching cubes and clean-up."""

    resolution: int = Field(0, ge=0, le=2048, description="Grid cells along the longest side; 0 derives it from surfel spacing and pixel footprint.")
    max_resolution: int = Field(384, ge=16, le=2048, description="Upper bound of the derived resolution.")
    field: Literal["tsdf", "imls"] = Field("tsdf", description="Field that is meshed: fused depth maps or the surfels' own SDF samples.")
    holes: Literal["close", "leave"] = Field("close", description="Close what no photo saw, or leave it open.")
    support: Literal["cut", "keep"] = Field("cut", description="Without masks: leave out the plane that the object stands on, or keep it.")
    faces: int = Field(30_000, ge=100, description="Target triangle count of the asset.")
    smooth: int = Field(2, ge=0, description="Taubin smoothing steps on the dense mesh.")
    normal_reach: float = Field(8.0, ge=0, description="Waves shorter than this many cells follow the rendered normals instead of the depth; 0 leaves them.")
    silhouette_rounds: int = Field(3, ge=0, description="Rounds of moving the surface until its silhouettes meet the masks; 0 leaves it.")
    photometric_rounds: int = Field(2, ge=0, description="Rounds of moving the surface to where photos of textured places agree; 0 leaves it.")
    min_component: Fraction = Field(0.02, description="Drop loose pieces with less than this share of the largest piece's area.")


class Bake(Section):
    """UV atlas and textures."""

    size: Literal[128, 256, 512, 1024, 2048, 4096] = Field(1024, description="Edge of the square textures in texels.")
    occlusion_rays: int = Field(64, ge=0, description="Rays per texel for ambient occlusion; 0 leaves it out.")
    visibility: Literal["none", "ambient", "directional", "bounce", "reflections"] = Field(
        "reflections", description="What the fit of materials knows of the object around a texel: nothing, an even shadow, one that follows the light, light from texel to texel too, and its mirror images."
    )
    materials: Literal["none", "delit", "fit", "surfels"] = Field(
        "none", description="none: colours only; delit: colours without the shading of one diffuse light, for matt things; fit: materials and light fitted to the photos in texture space; surfels: those the surfels learnt (splat.shading = pbr)."
    )
    fit_steps: int = Field(400, ge=1, description="Steps of fitting materials and light in texture space.")
    fit_size: int = Field(800, ge=16, description="Longer side in pixels of the photos that materials are fitted to.")
    smooth_prior: float = Field(0.03, ge=0, description="Neighbouring texels have the same material.")
    dark_prior: float = Field(0.005, ge=0, description="What a reflection explains is not paint; also settles how bright the light is.")
    metal_prior: float = Field(0.003, ge=0, description="Most things are not metal.")
    white_prior: float = Field(0.0005, ge=0, description="Most light is white.")
    parsimony_prior: float = Field(0.03, ge=0, description="An object is made of few materials; counts as much as photos are left unexplained.")
    roughness: Fraction = Field(0.8, description="Roughness of the whole asset where it is not measured (bake.materials = none, delit).")


class Export(Section):
    """The GLB and what lies beside it."""

    max_megabytes: float = Field(5.0, gt=0, description="Size the audit warns above.")
    max_triangles: int = Field(100_000, ge=100, description="Triangle count the audit fails above.")
    copyright: str = Field("", description="Copyright line written into the asset.")


class Report(Section):
    """The HTML report."""

    views: int = Field(4, ge=1, description="Held-out photos shown beside the render of the final asset.")
    view_size: int = Field(512, ge=32, description="Longer side of the renders in pixels.")


class Skip(Section):
    """Work that a scene may not need: auto lets measured evidence decide, always leaves it out, never does it all the same."""

    poses: Rule = Field("auto", description="Structure from motion, where poses were given. always: having none is an error; never: given poses are not used.")
    masks: Rule = Field("auto", description="Telling the object apart without masks, where photos have masks. always: a photo without one is an error; never: masks are not used.")
    resolution: Rule = Field("auto", description="Pixels finer than the photos' sharpness: photos that lose nothing at half their size are kept at half of it.")
    photos: Rule = Field("auto", description="Photos that add nothing: saved twice, or of a place that many others show from the same side. always: in small sets too.")
    view_dependence: Rule = Field("auto", description="Colours that change with the direction, where the places of the surface look the same in all photos.")
    settled: Rule = Field("auto", description="Training steps where stereo has settled the surface: up to half of them, by the share of the object that it confirmed. always: half of them.")
    refined_poses: Rule = Field("auto", description="Refining the photos' poses in training, where that gains nothing on held-out photos.")
    refined_exposure: Rule = Field("auto", description="Learning one exposure gain per photo in training, where that gains nothing on held-out photos.")
    converged: Rule = Field("auto", description="Training steps after held-out PSNR and SDF median stand still. always: the last steps are left out in any case.")
    far_cells: Rule = Field("auto", description="Grid cells far from the surface.")
    normal_map: Rule = Field("auto", description="The normal map, where the decimated mesh has the normals of the dense one.")
    metallic_map: Rule = Field("auto", description="The map of metal, where no texel shows it and the held-out photos do not miss it.")
    roughness_map: Rule = Field("auto", description="The map of roughness, where one number shows the held-out photos as well.")
    exposure: Rule = Field("auto", description="Dividing out one exposure gain per photo, where photos compared on the surface are as bright as one another.")


class Profile(Section):
    """All settings of a run."""

    description: str = Field("", description="What the profile is for.")
    ingest: Ingest = Ingest()
    poses: Poses = Poses()
    stereo: Stereo = Stereo()
    splat: Splat = Splat()
    train: Train = Train()
    loss: Loss = Loss()
    refine: Refine = Refine()
    mesh: Mesh = Mesh()
    bake: Bake = Bake()
    export: Export = Export()
    report: Report = Report()
    skip: Skip = Skip()
