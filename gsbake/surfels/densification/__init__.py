"""Densification and pruning of surfels: one module per policy, a registry, clone and split, and the refinement after training."""
