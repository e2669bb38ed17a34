"""Every setting gsbake has, by section; each field's description is its help text.

A profile (TOML) fills these sections. An unknown key, or a value outside its range, is an error that names the nearest valid key.
A stage declares the fields it reads ("train.iterations" or "train.*"): only those enter its cache key.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from gsbake.monitor import Rule

Fraction = Annotated[float, Field(ge=0, le=1)]
Pruning = Literal["visibility", "sdf", "gsdf", "gaussianroom", "gs-ror2"]


class Section(BaseModel):
    """Base of all sections: unknown keys are errors, docs come from the field descriptions."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Ingest(Section):
    """Reading photos, masks and known poses."""

    max_size: int = Field(1600, ge=16, le=16384, description="Longer side of the working photos in pixels. Larger photos are reduced with an area filter.")
    masks: Literal["auto", "require", "ignore"] = Field("auto", description="auto: use the masks that are there; require: a photo without a mask is an error; ignore: use none.")
    invert_masks: bool = Field(False, description="Masks are white where the background is.")
    min_photos: int = Field(3, ge=2, description="Fewer usable photos than this are an error.")


class Poses(Section):
    """Structure from motion and the unit frame."""

    source: Literal["auto", "given", "solve"] = Field("auto", description="auto: use given poses, else solve; given: missing poses are an error; solve: structure from motion in any case.")
    max_features: int = Field(8192, ge=256, description="SIFT features per photo.")
    peak_threshold: float = Field(0.0033, gt=0, description="SIFT peak threshold; a lower one finds more features on smooth surfaces.")
    matching: Literal["auto", "exhaustive", "ranked", "sequential", "vocabulary"] = Field("auto", description="Which pairs of photos are matched; auto chooses by number and names of the photos.")
    mapper: Literal["incremental", "global"] = Field("incremental", description="COLMAP mapper.")
    min_registered: Fraction = Field(0.5, description="A smaller share of registered photos is an error.")
    masked_features: bool | Literal["auto"] = Field(
        "auto", description="Detect features only inside the masks; auto does so where the background is static (turntables)."
    )
    max_size: int = Field(1600, ge=64, le=16384, description="Longer side in pixels at which features are detected.")
    fine_features: bool | Literal["auto"] = Field(
        "auto", description="Detect features in photos upsampled twofold too (5 times the cost); auto does so where features are few or photos fail to register."
    )


class Stereo(Section):
    """Multi-view stereo: depth maps where photos can be matched."""

    enabled: Rule = Field("auto", description="Match photos before training; auto skips it when photos are too few or too small.")
    max_size: int = Field(800, ge=64, le=4000, description="Longer side in pixels at which photos are matched.")
    neighbours: int = Field(6, ge=1, le=8, description="Source views per reference view.")
    best_views: int = Field(4, ge=1, le=8, description="Source views whose cost is averaged per pixel: the best ones.")
    consistency_views: int = Field(12, ge=1, le=32, description="Views that a depth map is checked against.")
    min_consistent_views: int = Field(2, ge=1, le=10, description="Views that must agree with a depth.")


class Surfels(Section):
    """The surfel model and its rasteriser."""

    shading: Literal["colour", "pbr"] = Field("colour", description="colour: plain colour with view dependence; pbr: deferred split-sum shading with a learnt environment map.")
    sh_degree: int = Field(1, ge=0, le=2, description="Degree of the spherical harmonics in colour shading.")
    transfer: Literal["sech2", "bell", "gaussian", "laplace", "neus"] = Field("sech2", description="Transfer function from SDF sample to opacity: the discretized SDF's sech², 3DGSR's bell, a Gaussian, VolSDF's Laplace or NeuS's law on a thin layer.")
    max_count: int = Field(60_000, ge=100, description="Upper bound on the number of surfels.")


class Light(Section):
    """The environment map."""

    size: int = Field(32, ge=4, le=128, description="Edge of the cube map's faces in texels.")


class Train(Section):
    """Training of the surfels."""

    iterations: int = Field(3000, ge=0, le=10_000_000, description="Training iterations; the schedule scales with them.")
    max_size: int = Field(512, ge=16, description="Longer side of the training photos in pixels.")
    coarse_share: Fraction = Field(0.5, description="Share of the iterations at half resolution.")
    init_surfels: int = Field(20_000, ge=10, description="Initial number of surfels.")
    init: Literal["auto", "stereo", "points", "hull", "sphere"] = Field("auto", description="Initialisation: stereo points, SfM points, the visual hull, a sphere, or the best of these there is.")
    densify: Literal["auto", "gradient", "sdf", "gsdf", "gaussianroom", "none"] = Field(
        "gradient", description="Densification policy: largest screen-space gradient; sdf: of these, those within a spacing of the surface; the rules of GSDF or GaussianRoom; none. auto: none after stereo initialisation, else gradient."
    )
    prune: Pruning = Field("visibility", description="Pruning policy during training, by SDF sample (the policies of refine.prune).")
    holdout: int = Field(8, ge=0, description="Every n-th photo is held out of training; 0 holds none out.")
    lr_position: float = Field(8e-4, gt=0, description="Learning rate of positions; decays to 1/100.")
    lr_scale: float = Field(0.02, gt=0, description="Learning rate of log-scales; decays to 1/10.")
    lr_rotation: float = Field(2e-3, gt=0, description="Learning rate of quaternions; decays to 1/10.")
    lr_sdf: float = Field(0.005, gt=0, description="Learning rate of SDF samples; decays to 1/10.")
    lr_gamma: float = Field(0.03, gt=0, description="Learning rate of the sharpness γ; decays to 1/10.")
    lr_material: float = Field(1.6e-2, gt=0, description="Learning rate of colours and materials; decays to 1/10.")
    lr_light: float = Field(5e-2, gt=0, description="Learning rate of the environment map; decays to 1/10.")


class Loss(Section):
    """Weights of the training losses."""

    ssim: Fraction = Field(0.2, description="Share of 1 − SSIM in the colour loss; the rest is L1.")
    median: float = Field(1.0, ge=0, description="Median loss: raises the sharpness γ as the median SDF sample shrinks.")
    projection: float = Field(10.0, ge=0, description="Projection loss: surfels moved by their SDF sample lie on the rendered depth.")
    normal: float = Field(0.2, ge=0, description="Surfel normals against normals of the depth map.")
    distortion: float = Field(100.0, ge=0, description="Depth distortion: concentrates the weights along a ray.")
    mask: float = Field(0.3, ge=0, description="Cross-entropy of alpha and mask.")
    smoothness: float = Field(0.02, ge=0, description="Edge-aware smoothness of materials.")
    neutral_light: float = Field(0.005, ge=0, description="Regularisation towards a grey environment map.")


class Refine(Section):
    """Pruning, densification and fine-tuning after training."""

    iterations: int = Field(600, ge=0, le=10_000_000, description="Fine-tuning iterations after pruning and densification.")
    prune: Pruning = Field(
        "visibility", description="Pruning policy: visibility alone; sdf: distance to the rendered surface (prune_distance); the rules of GSDF, GaussianRoom or GS-ROR²."
    )
    prune_distance: float = Field(3.0, gt=0, description="Surfels farther from the rendered surface than this many surfel spacings are pruned (refine.prune = sdf).")
    densify_share: Fraction = Field(0.3, description="At most this share of surfels is added where the surface is undersampled.")


class Mesh(Section):
    """Distance field, marching cubes, clean-up and decimation."""

    resolution: int = Field(0, ge=0, le=2048, description="Voxels along the longest side; 0 derives it from surfel spacing and pixel footprint.")
    max_resolution: int = Field(384, ge=16, le=2048, description="Upper bound of the derived resolution.")
    field: Literal["tsdf", "imls"] = Field("tsdf", description="Field that is meshed: fused depth maps, or the surfels' SDF samples.")
    holes: Literal["close", "leave"] = Field("close", description="Close what no photo observed, or leave it open.")
    support_plane: Literal["remove", "keep"] = Field("remove", description="Without masks: remove the plane that the object stands on, or keep it.")
    faces: int = Field(30_000, ge=100, description="Triangles of the asset.")
    smoothing_iterations: int = Field(2, ge=0, description="Taubin smoothing iterations on the dense mesh.")
    normal_wavelength: float = Field(8.0, ge=0, description="Wavelength in voxels below which detail comes from rendered normals instead of depth; 0 is off.")
    silhouette_iterations: int = Field(3, ge=0, description="Iterations of silhouette refinement against the masks; 0 is off.")
    photometric_iterations: int = Field(2, ge=0, description="Iterations of photometric refinement on textured surfaces; 0 is off.")
    min_component: Fraction = Field(0.02, description="Components with a smaller share of the largest one's area are removed.")


class Bake(Section):
    """UV atlas, textures and materials."""

    size: Literal[128, 256, 512, 1024, 2048, 4096] = Field(1024, description="Edge of the square textures in texels.")
    occlusion_rays: int = Field(64, ge=0, description="Rays per texel for ambient occlusion; 0 is off.")
    visibility: Literal["none", "ambient", "directional", "bounce", "reflections"] = Field(
        "reflections", description="What the material fit knows of the object around a texel: nothing; ambient occlusion; shadows of the current light; indirect diffuse light too; mirror reflections of the object too."
    )
    materials: Literal["none", "delight", "fit", "surfels"] = Field(
        "none", description="none: projected colours; delight: colours without the shading of one diffuse light; fit: materials and light fitted to the photos in texture space; surfels: those the surfels learnt (surfels.shading = pbr)."
    )
    fit_iterations: int = Field(400, ge=1, description="Iterations of the material fit.")
    fit_size: int = Field(800, ge=16, description="Longer side in pixels of the photos that materials are fitted to.")
    smoothness: float = Field(0.03, ge=0, description="Total variation weight: neighbouring texels have similar materials.")
    base_color_l1: float = Field(0.005, ge=0, description="L1 weight on base colour; fixes the albedo–illumination scale.")
    metallic_l1: float = Field(0.003, ge=0, description="L1 weight on metallic: most surfaces are dielectric.")
    neutral_light: float = Field(0.0005, ge=0, description="Regularisation towards a grey environment map.")
    sparsity: float = Field(0.03, ge=0, description="Reflectance sparsity prior: an object has few materials. Scaled by the mean residual.")
    default_roughness: Fraction = Field(0.8, description="Roughness where none is measured (bake.materials = none or delight).")


class Export(Section):
    """The GLB and the files beside it."""

    max_megabytes: float = Field(5.0, gt=0, description="File size above which the audit warns.")
    max_triangles: int = Field(100_000, ge=100, description="Triangle count above which the audit fails.")
    copyright: str = Field("", description="Copyright line of the asset.")


class Report(Section):
    """The HTML report."""

    views: int = Field(4, ge=1, description="Held-out photos shown beside renders of the asset.")
    view_size: int = Field(512, ge=32, description="Longer side of the renders in pixels.")


class Skip(Section):
    """Work that a scene may not need. auto: measured evidence decides; always: skip it; never: do it in any case."""

    resolution: Rule = Field("auto", description="Full resolution, where photos hold no detail above half of it.")
    redundant_photos: Rule = Field("auto", description="Photos saved twice, or of a place that many others show from the same side. always: in small sets too.")
    specular: Rule = Field("auto", description="Fitting specular reflection, where the surface looks the same in all photos.")
    confirmed_steps: Rule = Field("auto", description="Training iterations in proportion to the share of the object that stereo confirmed, up to half of them. always: half of them.")
    converged_steps: Rule = Field("auto", description="Training iterations after held-out PSNR and median SDF sample have reached a plateau. always: the last iterations in any case.")
    pose_refinement: Rule = Field("auto", description="Refining poses during training, where held-out photos gain nothing.")
    exposure_refinement: Rule = Field("auto", description="Learning exposure gains during training, where held-out photos gain nothing.")
    empty_cells: Rule = Field("auto", description="Voxels far from the surface.")
    exposure_equalisation: Rule = Field("auto", description="Dividing out exposure gains, where photos agree in brightness on the surface.")
    normal_map: Rule = Field("auto", description="The normal map, where the low-poly mesh has the normals of the dense one.")
    metallic_map: Rule = Field("auto", description="The metallic map, where no texel is metallic and held-out photos do not need it.")
    roughness_map: Rule = Field("auto", description="The roughness map, where one value explains held-out photos as well.")


class Profile(Section):
    """All settings of a run."""

    description: str = Field("", description="What the profile is for.")
    ingest: Ingest = Ingest()
    poses: Poses = Poses()
    stereo: Stereo = Stereo()
    surfels: Surfels = Surfels()
    light: Light = Light()
    train: Train = Train()
    loss: Loss = Loss()
    refine: Refine = Refine()
    mesh: Mesh = Mesh()
    bake: Bake = Bake()
    export: Export = Export()
    report: Report = Report()
    skip: Skip = Skip()
