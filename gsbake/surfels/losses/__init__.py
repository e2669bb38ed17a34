"""Training losses: plain PyTorch terms and their fused kernels."""
