"""Schema of all settings by section, with defaults, ranges and help texts.

A profile (TOML) fills these sections. An unknown key or a value outside its range is an error that names the setting. Every number has a
lower and an upper bound and is finite. A stage declares the fields it reads ("train.iterations" or "train.*"): only those enter its cache
key.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from gsbake.config.lengths import parse_known_distance
from gsbake.config.targets import parse_target
from gsbake.config.white import parse_white
from gsbake.monitor import Rule

Fraction = Annotated[float, Field(ge=0, le=1)]
#: Weight of a loss term or a prior; 0 switches it off.
Weight = Annotated[float, Field(ge=0, le=10_000)]
LearningRate = Annotated[float, Field(gt=0, le=1)]
#: Longer side of a photo in pixels.
PhotoSize = Annotated[int, Field(ge=16, le=16_384)]


def _not_every_photo(every: int) -> int:
    if every == 1:
        raise ValueError("it would hold out every photo; set 0 to hold out none, or 2 and more")
    return every


#: Every n-th photo is held out.
HeldOut = Annotated[int, Field(ge=0, le=1000), AfterValidator(_not_every_photo)]


def _known_distance(text: str) -> str:
    parse_known_distance(text)
    return text


def _white(text: str) -> str:
    return parse_white(text).text


def _target(text: str) -> str:
    return parse_target(text).text


def _box(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if len(numbers) not in (0, 15) or any(edge <= 0 for edge in numbers[3:6]):
        raise ValueError("it must be empty, or 15 numbers: a centre, three positive edges and a rotation by rows, as --region sets them")
    return numbers


#: Box of a region, empty for none.
BoxNumbers = Annotated[tuple[float, ...], Field(max_length=15), AfterValidator(_box)]


#: Sine of the angle between two sides of a triangle below which its points lie on one line.
MIN_SINE = 0.02


def _up_points(numbers: tuple[float, ...]) -> tuple[float, ...]:
    if not numbers:
        return numbers
    if len(numbers) not in (6, 9):
        raise ValueError("it takes three points or the two ends of an edge, so nine or six numbers")
    sides = [[b - a for a, b in zip(numbers, end, strict=False)] for end in (numbers[3:6], numbers[6:9]) if end]
    lengths = [math.hypot(*side) for side in sides]
    distinct = all(0 < length < math.inf for length in lengths)
    if distinct and len(sides) == 2:
        cosine = sum(a / lengths[0] * b / lengths[1] for a, b in zip(*sides, strict=True))
        distinct = 1 - cosine**2 >= MIN_SINE**2
    if not distinct:
        raise ValueError("its points coincide or lie on one line; give three that span the ground, or two ends")
    return numbers


#: Points that show what is up.
UpPoints = Annotated[tuple[float, ...], AfterValidator(_up_points)]
#: A target that can be parsed, in its usual spelling.
TargetText = Annotated[str, AfterValidator(_target)]
#: A known distance that can be parsed.
KnownDistanceText = Annotated[str, AfterValidator(_known_distance)]
#: A patch of known reflectance that can be parsed.
WhiteText = Annotated[str, AfterValidator(_white)]
Pruning = Literal["visibility", "sdf", "gsdf", "gaussianroom", "gs-ror2"]


class Section(BaseModel):
    """Base of all sections: unknown keys and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Ingest(Section):
    """Reading photos, masks and known poses."""

    max_size: PhotoSize = Field(1600, description="Longer side of the working photos in pixels. Larger photos are downsampled with an area filter.")
    masks: Literal["auto", "require", "ignore"] = Field("auto", description="auto: use the masks there are, and make those that are missing (ingest.mask_network); require: a photo without a mask is an error; ignore: use none and make none.")
    mask_network: Literal["auto", "u2netp", "none"] = Field("auto", description="Network that guesses missing masks, which agreement between photos then corrects. auto: u2netp where its weights are installed; none: masks are not made.")
    invert_masks: bool = Field(False, description="Masks are white on the background instead of the object.")
    leave_out: tuple[str, ...] = Field((), max_length=10_000, description="Photos that are not used: names of their files, or of frames of a video. --leave-out adds one.")
    max_megapixels: float = Field(250.0, gt=0, le=10_000, description="Photos and masks with more megapixels are skipped, from their header alone.")
    frames: int = Field(120, ge=3, le=10_000, description="Most photos taken from a video: evenly along its motion, the sharpest frame of each stretch.")
    min_photos: int = Field(3, ge=2, le=10_000, description="Minimum number of usable photos; fewer are an error.")


class Poses(Section):
    """Structure from motion and the unit frame."""

    source: Literal["auto", "given", "solve"] = Field("auto", description="auto: given poses if there are any, else structure from motion; given: missing poses are an error; solve: always structure from motion.")
    max_features: int = Field(8192, ge=256, le=100_000, description="Maximum number of SIFT features per photo.")
    peak_threshold: float = Field(0.0033, gt=0, le=1, description="SIFT peak threshold; a lower one finds more features on surfaces with little texture.")
    matching: Literal["auto", "exhaustive", "ranked", "sequential", "vocabulary"] = Field("auto", description="Selection of the photo pairs to match; auto decides by the number and names of the photos.")
    mapper: Literal["incremental", "global"] = Field("incremental", description="COLMAP mapper.")
    min_registered: Fraction = Field(0.5, description="Minimum share of registered photos; a smaller one is an error.")
    masked_features: bool | Literal["auto"] = Field(
        "auto", description="Detect features inside the masks only. auto: where cameras from whole photos contradict the masks. Unless false, a background that stands while the object turns is left out."
    )
    max_size: int = Field(1600, ge=64, le=16_384, description="Longer side in pixels of the photos in which features are detected.")
    region: Literal["auto", "none"] = Field("auto", description="auto: what lies outside the box of poses.region_box, or else of Metashape's cameras, is not baked; none: no box.")
    region_box: BoxNumbers = Field((), description="Box that is baked, in the cameras' frame: centre, size, rotation by rows; --region takes it from a file.")
    fine_features: bool | Literal["auto"] = Field(
        "auto", description="Also detect features in photos upsampled by 2 (5 times the time). auto: only where features are few or photos fail to register."
    )


class Stereo(Section):
    """Multi-view stereo: depth maps by patch matching."""

    enabled: Literal["auto", "always", "never"] = Field("auto", description="Run multi-view stereo before training. auto: unless photos are too few or too small.")
    max_size: int = Field(800, ge=64, le=4000, description="Longer side in pixels of the photos that are matched.")
    min_scale: Fraction = Field(0.3, description="Photos larger than working photos are matched at this share of their size, where that is more than max_size. 0: never.")
    neighbours: int = Field(6, ge=1, le=8, description="Source views per reference view.")
    best_views: int = Field(4, ge=1, le=8, description="Source views with the lowest matching cost, over which a pixel's cost is averaged.")
    consistency_views: int = Field(12, ge=1, le=32, description="Views with which the geometric consistency of a depth map is checked.")
    min_consistent_views: int = Field(2, ge=1, le=10, description="Minimum number of views that agree on a depth; other depths are dropped.")
    hollows: Literal["auto", "never"] = Field("auto", description="Open hollows of the visual hull. auto: where the surface inside predicts photos that its colours were not fitted to much better than the hull does.")


class Surfels(Section):
    """Surfel model and rasteriser."""

    shading: Literal["colour", "pbr"] = Field("colour", description="colour: radiance as spherical harmonics; pbr: deferred split-sum shading with a learnt environment map.")
    sh_degree: int = Field(1, ge=0, le=2, description="Degree of the spherical harmonics (surfels.shading = colour).")
    transfer: Literal["sech2", "bell", "gaussian", "laplace", "neus"] = Field("sech2", description="Transfer function from SDF sample to opacity: sech² (discretized SDF), the bell of 3DGSR, a Gaussian, the Laplace density of VolSDF, or the density of NeuS on a thin layer.")
    max_count: int = Field(60_000, ge=100, le=10_000_000, description="Maximum number of surfels.")
    projected_depth: bool = Field(False, description="Rendered depth, in training and in fusion, is that of the surfels moved by their signed distance onto the zero level set.")


class Light(Section):
    """Environment map."""

    size: int = Field(32, ge=4, le=128, description="Edge of the cube map's faces in texels.")


class DistanceField(Section):
    """Signed distance field that the surfels are trained with."""

    kind: Literal["samples", "grid", "octree", "tensor", "hash", "mlp"] = Field("samples", description="Representation. samples: one SDF sample per surfel; grid: sparse voxels; octree: corners, fine where curved; tensor: planes and lines with a network; hash: multi-resolution hash grid with a network; mlp: a network of the position.")
    opacity: Literal["own", "field"] = Field("own", description="Opacity of surfels beside a continuous field. own: trained for itself; field: the transfer function of the field's value at the centre.")
    start: Literal["surfels", "sphere"] = Field("surfels", description="What a continuous field starts from. surfels: the distance to the initial surfels; sphere: a sphere.")
    resolution: int = Field(96, ge=8, le=512, description="Finest cells along the longest side (grid, octree, tensor, hash).")
    levels: int = Field(8, ge=1, le=16, description="Levels of the hash grid.")
    features: int = Field(2, ge=1, le=8, description="Features per level of the hash grid.")
    table_bits: int = Field(15, ge=8, le=22, description="Rows of a level of the hash grid, as a power of two; levels that fit are dense.")
    rank: int = Field(6, ge=1, le=32, description="Components of the factorised tensor per pair of axes.")
    octaves: int = Field(5, ge=0, le=10, description="Octaves of Fourier features (mlp).")
    width: int = Field(32, ge=4, le=256, description="Width of the network's layers.")
    hidden: int = Field(1, ge=1, le=8, description="Hidden layers of the network.")
    splats: bool = Field(False, description="Add embeddings of the nearest surfels to the features of the hash grid.")
    fit_steps: int = Field(200, ge=0, le=100_000, description="Steps of the fit to the known distance before training (tensor, hash, mlp).")
    rate: float = Field(1.0, gt=0, le=1000, description="Factor on the learning rates of the field.")
    points: int = Field(4096, ge=16, le=1_000_000, description="Random points per iteration at which couplings ask for distance and gradient.")
    rays: int = Field(512, ge=8, le=100_000, description="Rays per iteration along which couplings march.")
    ray_samples: int = Field(12, ge=3, le=512, description="Samples per marched ray.")
    sampling: Literal["surfels", "sphere-tracing"] = Field("surfels", description="Where rays are sampled. surfels: around their rendered depth; sphere-tracing: around the field's own hit, else all over the box.")
    renderer: Literal["neus", "laplace", "logistic"] = Field("neus", description="Transfer function of marched rays: NeuS, VolSDF's Laplace density, or the logistic bump.")
    edges: Fraction = Field(0.0, description="Share of the rays drawn in proportion to the photo's gradient.")
    seeds: Fraction = Field(0.0, description="Surfels added where the zero level set has none, at each densification, as a share of all.")
    cycles: int = Field(0, ge=0, le=10, description="Times that all surfels are placed anew on the field's zero level set.")


class Coupling(Section):
    """Weights of the losses between surfels and a continuous field; 0 switches one off."""

    surface: Weight = Field(0.0, description="Surfels lie on the zero level set: |f(μ)| in surfel spacings.")
    alignment: Weight = Field(0.0, description="Normals of surfels are parallel to ∇f.")
    opacity_target: Weight = Field(0.0, description="Opacity of surfels of their own follows the bell of f(μ).")
    pull_surfels: Fraction = Field(0.0, description="Share of the way to the zero level set that surfels are moved in each iteration.")
    depth: Weight = Field(0.0, description="Depth of surfels and marched depth of the field agree.")
    normals: Weight = Field(0.0, description="Normals of surfels and of the field agree along rays.")
    eikonal: Weight = Field(0.0, description="Slope 1.")
    smoothness: Weight = Field(0.0, description="Change of ∇f over a cell and a half near the surface.")
    free_space: Weight = Field(0.0, description="No surface before the depth of the surfels.")
    silhouette: Weight = Field(0.0, description="Rays outside the mask miss the surface, rays inside meet it.")
    pulling: Weight = Field(0.0, description="Points near the surface, moved by f and ∇f, land on the nearest surfel.")
    colour: Weight = Field(0.0, description="Marched colours of the field agree with the photo.")
    mask: Weight = Field(0.0, description="Cross-entropy of marched alpha and mask.")
    extra_views: Weight = Field(0.0, description="Depth and normals of the field agree with surfels rendered between photos.")
    prior_normals: Weight = Field(0.0, description="Agreement with given normal maps (folder normals/ of the capture).")
    prior_depths: Weight = Field(0.0, description="Agreement with given depth maps up to scale and shift (folder depths/ of the capture).")


class Train(Section):
    """Training of the surfels."""

    iterations: int = Field(3000, ge=0, le=10_000_000, description="Training iterations; all schedules scale with them.")
    max_size: PhotoSize = Field(512, description="Longer side of the training photos in pixels.")
    coarse_share: Fraction = Field(0.5, description="Share of the iterations that train at half resolution, before those at full resolution.")
    init_surfels: int = Field(20_000, ge=10, le=10_000_000, description="Initial number of surfels.")
    init: Literal["auto", "stereo", "points", "hull", "sphere"] = Field("auto", description="Initialisation: stereo points, the visual hull, tie points or a sphere. auto: the first of these that is available.")
    densify: Literal["auto", "gradient", "sdf", "gsdf", "gaussianroom", "none"] = Field(
        "gradient", description="Densification. gradient: surfels with the largest screen-space gradient; sdf: of these, those close to the surface; gsdf, gaussianroom: the rules of those papers. auto: none after stereo initialisation, else gradient."
    )
    prune: Pruning = Field("visibility", description="Pruning during training; the policies of refine.prune.")
    band: float = Field(0.0, ge=0, le=20, description="Half-thickness in surfel spacings of the band around the initial surface over which surfels are spread, each with its distance as SDF sample. 0: all on the surface.")
    sharpness: Literal["unit", "spacing"] = Field("unit", description="Unit of SDF samples and sharpness. unit: the unit frame, as in the paper; spacing: surfel spacings, with the distance of half opacity falling to train.final_width.")
    final_width: float = Field(1.0, gt=0, le=100, description="Distance in surfel spacings at which opacity is half at the end (train.sharpness = spacing).")
    reset_opacity: Fraction = Field(0.0, description="Opacity to which more opaque surfels are reset at each densification in the first third of training, by moving them off the surface; 0 is off.")
    holdout: HeldOut = Field(8, description="Every n-th photo is held out of training; 0 holds none out, 1 is an error.")
    lr_position: LearningRate = Field(8e-4, description="Learning rate of positions (unit frame); decays to 1/100.")
    lr_scale: LearningRate = Field(0.02, description="Learning rate of log-scales; decays to 1/10.")
    lr_rotation: LearningRate = Field(2e-3, description="Learning rate of quaternions; decays to 1/10.")
    lr_sdf: LearningRate = Field(0.005, description="Learning rate of SDF samples; decays to 1/10.")
    lr_gamma: LearningRate = Field(0.03, description="Learning rate of the sharpness γ; decays to 1/10. A share of γ with train.sharpness = spacing.")
    lr_sample: LearningRate = Field(0.05, description="Learning rate of SDF samples in surfel spacings (train.sharpness = spacing); decays to 1/10.")
    lr_opacity: LearningRate = Field(0.05, description="Learning rate of opacities of their own, before the sigmoid (field.opacity = own); decays to 1/10.")
    lr_material: LearningRate = Field(1.6e-2, description="Learning rate of colours and materials; decays to 1/10.")
    lr_light: LearningRate = Field(5e-2, description="Learning rate of the environment map; decays to 1/10.")


class Loss(Section):
    """Weights of the training losses."""

    ssim: Fraction = Field(0.2, description="Share of 1 − SSIM in the colour loss; the rest is L1.")
    median: Weight = Field(1.0, description="Median loss: raises the sharpness γ as the median SDF sample shrinks.")
    projection: Weight = Field(10.0, description="Projection loss: surfels displaced by their SDF sample lie on the rendered depth.")
    normal: Weight = Field(0.2, description="Consistency of surfel normals with the normals of the depth map.")
    distortion: Weight = Field(100.0, description="Depth distortion: concentrates the blending weights along a ray.")
    mask: Weight = Field(0.3, description="Cross-entropy of rendered alpha and mask.")
    silhouette: Weight = Field(0.0, description="Distance by which surfels, displaced by their SDF sample, project outside the masks; brings a sphere to the object.")
    smoothness: Weight = Field(0.02, description="Edge-aware smoothness of materials (surfels.shading = pbr).")
    neutral_light: Weight = Field(0.005, description="Regularisation of the environment map towards grey (surfels.shading = pbr).")


class Refine(Section):
    """Pruning, densification and fine-tuning after training."""

    iterations: int = Field(600, ge=0, le=10_000_000, description="Fine-tuning iterations.")
    prune: Pruning = Field(
        "visibility", description="Pruning. visibility: surfels that no photo sees; sdf: also those far from the rendered surface (refine.prune_distance); gsdf, gaussianroom, gs-ror2: the rules of those papers."
    )
    prune_distance: float = Field(3.0, gt=0, le=1000, description="Maximum distance to the rendered surface in surfel spacings (refine.prune = sdf).")
    densify_share: Fraction = Field(0.3, description="Maximum share of surfels added where the surface is undersampled.")


class Mesh(Section):
    """Distance field, marching cubes, clean-up and decimation."""

    resolution: int = Field(0, ge=0, le=2048, description="Voxels along the longest side; 0 derives it from surfel spacing and pixel footprint.")
    max_resolution: int = Field(384, ge=16, le=2048, description="Maximum of the derived resolution in voxels.")
    field: Literal["tsdf", "imls", "trained"] = Field("tsdf", description="Field that is meshed. tsdf: fused depth maps; imls: the surfels' SDF samples; trained: the field they were trained with (field.kind).")
    normals: Literal["surfels", "field"] = Field("surfels", description="Source of the normals that refine the mesh (mesh.normal_wavelength). surfels: rendered; field: the gradient of the trained field.")
    holes: Literal["close", "leave"] = Field("close", description="Fill the surface where no photo observed it, or leave holes.")
    support_plane: Literal["remove", "keep"] = Field("remove", description="Without masks: remove or keep the plane on which the object stands.")
    faces: int = Field(30_000, ge=100, le=10_000_000, description="Triangles of the low-poly mesh, where mesh.max_error does not require more.")
    max_error: float = Field(0.5, ge=0, le=100, description="Maximum deviation of the low-poly from the dense mesh in voxels (99.9 % quantile of the distances between both surfaces); above it the mesh gets more triangles. 0 is off.")
    max_faces: int = Field(0, ge=0, le=10_000_000, description="Maximum triangles of the low-poly mesh under mesh.max_error; 0 derives 4 × mesh.faces, at most export.max_triangles.")
    decimator: Literal["auto", "pymeshlab", "fast-simplification"] = Field("auto", description="Library that decimates. auto: pymeshlab (GPL) where it is installed, else fast-simplification (MIT).")
    smoothing_iterations: int = Field(2, ge=0, le=1000, description="Taubin smoothing iterations on the dense mesh.")
    normal_wavelength: float = Field(8.0, ge=0, le=1000, description="Wavelength in voxels below which detail comes from rendered normals instead of depth; 0 is off.")
    refinement_vertices: int = Field(60_000, ge=0, le=10_000_000, description="Most vertices of the mesh that is refined by parallax, reflections and silhouettes; its displacements move the dense mesh. 0 is off.")
    denoising_iterations: int = Field(20, ge=0, le=1000, description="Iterations of bilateral normal filtering on the dense mesh; 0 is off.")
    min_component: Fraction = Field(0.02, description="Minimum area of a connected component as a share of the largest one's; smaller ones are removed.")


class Bake(Section):
    """UV atlas, textures and materials."""

    size: Literal["auto", 128, 256, 512, 1024, 2048, 4096] = Field(1024, description="Edge of the square textures in texels. auto: 1024, and a base colour of up to 4096, as fine as the photos' pixels on the surface.")
    occlusion_rays: int = Field(64, ge=0, le=4096, description="Rays per texel for ambient occlusion; 0 is off.")
    visibility: Literal["none", "ambient", "directional", "bounce", "reflections"] = Field(
        "reflections", description="Light transport in the material fit, each with those before. none: unoccluded; ambient: ambient occlusion; directional: shadows; bounce: indirect diffuse light; reflections: specular reflections of the object itself."
    )
    materials: Literal["none", "delight", "fit", "surfels"] = Field(
        "none", description="none: projected colours; delight: projected colours divided by the shading of one diffuse environment; fit: materials and environment map fitted to the photos in texture space; surfels: materials learnt in training (surfels.shading = pbr)."
    )
    fit_iterations: int = Field(400, ge=1, le=100_000, description="Iterations of the material fit.")
    fit_size: PhotoSize = Field(800, description="Longer side in pixels of the photos to which materials are fitted.")
    smoothness: Weight = Field(0.03, description="Total variation of materials between neighbouring texels.")
    base_color_l1: Weight = Field(0.005, description="L1 norm of base colour; resolves the albedo–illumination ambiguity.")
    metallic_l1: Weight = Field(0.003, description="L1 norm of metallic; most surfaces are dielectric.")
    neutral_light: Weight = Field(0.0005, description="Regularisation of the environment map towards grey.")
    sparsity: Weight = Field(0.03, description="Reflectance sparsity prior: an object has few materials. Scaled by the mean residual.")
    light_motion: Literal["auto", "static", "turntable", "camera"] = Field("auto", description="How the light moves, as the object sees it. static: it stands; turntable: the object was turned under it; camera: it is on the camera (flash); auto: what explains validation photos best.")
    white: tuple[WhiteText, ...] = Field((), max_length=100, description="Patches of the object whose reflectance is known, in grey or white: they give intensity and colour of the light, and base colour inversely. Photo, pixel and reflectance, as in \"A.jpg:120,80:0.18\"; without a reflectance white paper (0.9). markers: the paper of printed markers beside the object; card: a colour card of 24 patches there. --white adds one.")
    default_roughness: Fraction = Field(0.8, description="Roughness where none is fitted (bake.materials = none or delight).")

    @property
    def map_size(self) -> int:
        """Edge in texels of all maps but a base colour of automatic size."""
        return 1024 if self.size == "auto" else self.size


class Scale(Section):
    """Metric scale of the asset."""

    known_distances: tuple[KnownDistanceText, ...] = Field((), max_length=100, description="Distances between two points of the photos, as in \"A.jpg:120,80 B.jpg:640,410 8cm\": file and pixel of each point. A point that is not on the object is given in two photos or more, as in \"A.jpg:120,80+C.jpg:131,77\".")
    marker_size: float = Field(0.0, ge=0, le=100, description="Edge length in metres of the printed ArUco or AprilTag markers in the photos; 0 looks for none.")
    marker_dictionary: Literal["auto", "aruco-4x4", "aruco-5x5", "aruco-6x6", "aruco-7x7", "aruco-original", "apriltag-16h5", "apriltag-25h9", "apriltag-36h11"] = Field("auto", description="Dictionary of the markers; auto: the one of which most are seen.")
    gps: bool = Field(True, description="Without markers and known distances: use the photos' GPS positions where they tell the scale to 5 %, as of photos taken over tens of metres.")


class Export(Section):
    """GLB and the files beside it."""

    up: Literal["cameras", "markers", "ground"] = Field("cameras", description="What is level. cameras: as they were held, or as given poses say; markers: the plane of the printed markers in the photos; ground: the plane on which the object stands (photos without masks).")
    up_points: UpPoints = Field((), max_length=9, description="What is up, by points in the cameras' frame, before export.up: three points of the ground, or the lower and the upper end of an upright edge. --up takes them.")
    front: str = Field("", description="Photo that shows the front: the asset is turned about its up axis to face that camera. Empty: as the cameras' frame has it.")
    origin: Literal["auto", "bottom", "centre"] = Field("auto", description="Origin of the asset. bottom: the middle of its box's bottom; centre: the middle of its box; auto: that of given poses, else bottom.")
    max_megabytes: float = Field(0.0, ge=0, le=4096, description="Maximum file size in MB: a base colour finer than the other maps is halved to meet it, then normal and material maps are reduced; the audit warns above it. 0: 5 MB for textures of up to 1024² texels, above in proportion to the base colour's texels.")
    max_triangles: int = Field(100_000, ge=100, le=10_000_000, description="Maximum triangle count; the audit fails above it.")
    copyright: str = Field("", description="Copyright line of the asset.")


class Targets(Section):
    """Further files of the asset, for the places where it is used."""

    files: tuple[TargetText, ...] = Field((), max_length=32, description="Targets, each NAME or NAME:FORM+FORM. Names: default, web, ar, banner, planner, film (budgets of bytes, triangles and texels), surfels (splats as PLY). Forms: webp or ktx2, quantised or meshopt; usdz, usdc or obj instead of GLB.")
    levels: int = Field(0, ge=0, le=8, description="Levels of detail below each target: files asset_lod1.glb and on, each with half the extent on the screen.")
    lod_file: bool = Field(False, description="Also write all levels of a target into one GLB (MSFT_lod).")


class Report(Section):
    """HTML report."""

    views: int = Field(4, ge=1, le=24, description="Photos shown beside renders of the asset.")
    view_size: int = Field(512, ge=32, le=4096, description="Longer side of the renders in pixels.")


class Skip(Section):
    """Work that a capture may not need. auto: leave it out where measurements allow; skip: leave it out; keep: do it."""

    resolution: Rule = Field("auto", description="Full resolution, where photos hold no detail above half of it.")
    redundant_photos: Rule = Field("auto", description="Duplicate photos, and photos of views that many others cover. skip: in small captures too.")
    specular: Rule = Field("auto", description="Fitting specular reflection, where the surface shows no view dependence.")
    confirmed_steps: Rule = Field("auto", description="Up to half of the training iterations, in proportion to the share of the object that stereo confirmed. skip: half of them.")
    converged_steps: Rule = Field("auto", description="Training iterations after held-out PSNR and median SDF sample reach a plateau (early stopping). skip: the last iterations in any case.")
    pose_refinement: Rule = Field("auto", description="Refining poses during training, where structure from motion solved them, matched features do not contradict them, or held-out PSNR does not improve.")
    exposure_refinement: Rule = Field("auto", description="Learning exposure gains during training, where photos agree at their tie points, these are too few, or held-out PSNR does not improve.")
    empty_cells: Rule = Field("auto", description="Voxels far from the surface.")
    exposure_equalisation: Rule = Field("auto", description="Dividing out exposure gains, where parts of the surface that face different ways do not share them, and EXIF tells no others. skip: those of EXIF too.")
    normal_map: Rule = Field("auto", description="The normal map, where the low-poly mesh has the normals of the dense one.")
    metallic_map: Rule = Field("auto", description="The metallic map, where no texel is metallic and held-out PSNR does not need it.")
    roughness_map: Rule = Field("auto", description="The roughness map, where one value fits held-out photos as well.")


class Profile(Section):
    """All settings of a run."""

    description: str = Field("", description="What the profile is for.")
    group: Literal["assets", "published"] = Field("assets", description="assets: for baking; published: a published system, for comparison. Neither is a setting of any stage.")
    ingest: Ingest = Ingest()
    poses: Poses = Poses()
    stereo: Stereo = Stereo()
    surfels: Surfels = Surfels()
    light: Light = Light()
    field: DistanceField = DistanceField()
    coupling: Coupling = Coupling()
    train: Train = Train()
    loss: Loss = Loss()
    refine: Refine = Refine()
    mesh: Mesh = Mesh()
    bake: Bake = Bake()
    scale: Scale = Scale()
    export: Export = Export()
    targets: Targets = Targets()
    report: Report = Report()
    skip: Skip = Skip()
