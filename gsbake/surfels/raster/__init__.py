"""The differentiable rasteriser of surfels: projection, binning, blending; Numba, PyTorch reference and CUDA."""
