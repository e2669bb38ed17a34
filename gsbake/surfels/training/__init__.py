"""The training loop, its optimiser, checkpoints, early stopping and pose refinement."""
