"""Locating values that are not finite: the optimiser detects a NaN at no extra cost, then the tensors are searched by name."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


def first_non_finite(tensors: Mapping[str, Tensor | None]) -> str | None:
    """The first of the named tensors that contains a NaN or an infinity, as "name (row 17)"; None when all are finite."""
    for name, x in tensors.items():
        if x is None or not x.numel():
            continue
        bad = ~torch.isfinite(x.detach()).reshape(x.shape[0] if x.ndim else 1, -1).all(1)
        if bool(bad.any()):
            return f"{name} (row {int(bad.nonzero()[0, 0])})"
    return None
