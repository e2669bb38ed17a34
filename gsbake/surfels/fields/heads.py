"""What turns features into a distance: nothing (the feature is the distance), or a small network evaluated with its spatial derivative.

The derivative runs forward beside the value: a layer h = φ(W x + b) has ∂h = φ'(W x + b) · W ∂x. Both are ordinary outputs, so losses of
the gradient (Eikonal, normals) need one backward pass and no second derivative of the encoding. φ is the softplus with β = 100 of the
implicit-surface literature (Gropp et al., *Implicit geometric regularization*, ICML 2020).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

#: Sharpness of the softplus.
BETA = 100.0


class Network:
    """A network of `hidden` layers of equal width; its last layer starts at 0, so that the output does."""

    def __init__(self, inputs: int, width: int, hidden: int, outputs: int, generator: torch.Generator) -> None:
        """Weights by He et al. 2015."""
        sizes = [inputs, *[width] * hidden, outputs]
        self.weights: dict[str, Tensor] = {}
        for i, (a, b) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            last = i == hidden
            w = torch.zeros(b, a) if last else torch.randn(b, a, generator=generator) * math.sqrt(2 / a)
            self.weights[f"w{i}"], self.weights[f"b{i}"] = w, torch.zeros(b)
        self.layers = hidden + 1

    def __call__(self, x: Tensor) -> Tensor:
        """Outputs (n, o) of inputs (n, i)."""
        for i in range(self.layers):
            x = F.linear(x, self.weights[f"w{i}"].to(x), self.weights[f"b{i}"].to(x))
            if i < self.layers - 1:
                x = F.softplus(x, BETA)
        return x

    def with_jacobian(self, x: Tensor, jacobian: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs (n, o) and their Jacobian (n, 3, o), from inputs (n, i) and theirs (n, 3, i)."""
        for i in range(self.layers):
            w = self.weights[f"w{i}"].to(x)
            x, jacobian = F.linear(x, w, self.weights[f"b{i}"].to(x)), F.linear(jacobian, w)
            if i < self.layers - 1:
                jacobian = jacobian * torch.sigmoid(BETA * x)[:, None]
                x = F.softplus(x, BETA)
        return x, jacobian
