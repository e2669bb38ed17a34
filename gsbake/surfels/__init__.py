"""2D Gaussian surfels with a discretized signed distance field."""

#: Modules with the kernels of surfels with plain colours, for both stages that train them.
KERNELS = (
    "gsbake.surfels.raster.kernel", "gsbake.surfels.raster.projection", "gsbake.surfels.losses.photometric",
    "gsbake.surfels.losses.geometry", "gsbake.surfels.raster.binning", "gsbake.surfels.spherical_harmonics",
    "gsbake.surfels.losses.projection", "gsbake.surfels.adam",
)  # fmt: skip
