"""Adam (Kingma and Ba 2015) over named tensors whose rows come and go as surfels are added and dropped."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Adam:
    """One step count per tensor; β = (.9, .999), ε = 1e-15 as in the splatting literature."""

    def __init__(self) -> None:
        """Start with no moments."""
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}
        self.count: dict[str, int] = {}

    @torch.no_grad()
    def step(self, name: str, value: Tensor, grad: Tensor, rate: float) -> None:
        """Update `value` in place."""
        if name not in self.first:
            self.first[name], self.second[name], self.count[name] = torch.zeros_like(value), torch.zeros_like(value), 0
        m, v = self.first[name], self.second[name]
        self.count[name] += 1
        n = self.count[name]
        m.mul_(0.9).add_(grad, alpha=0.1)
        v.mul_(0.999).addcmul_(grad, grad, value=0.001)
        root = v.sqrt().mul_(1 / math.sqrt(1 - 0.999**n)).add_(1e-15)
        value.addcdiv_(m, root, value=-rate / (1 - 0.9**n))

    def select(self, names: list[str], index: Tensor, added: int) -> None:
        """Keep the rows at `index` of the named tensors and append `added` rows of zero moments."""
        for table in (self.first, self.second):
            for name in names:
                if name in table:
                    kept = table[name][index]
                    table[name] = torch.cat([kept, kept.new_zeros(added, *kept.shape[1:])])

    def state(self) -> dict[str, object]:
        """Everything a checkpoint needs."""
        return {"first": self.first, "second": self.second, "count": self.count}

    def load(self, state: dict[str, object]) -> None:
        """Restore what `state` returned."""
        self.first, self.second, self.count = dict(state["first"]), dict(state["second"]), dict(state["count"])  # type: ignore[call-overload]
