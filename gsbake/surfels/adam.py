"""Adam (Kingma and Ba 2015) over named tensors whose rows change as surfels are densified and pruned.

On the CPU one fused pass over value, gradient and moments does the update and, at no extra cost, detects values that are not finite.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsbake.kernels.declaration import kernel
from gsbake.kernels.threads import run_chunks
from gsbake.surfels.finite import first_non_finite
from gsbake.surfels.raster.blocks import JIT

EPSILON = 1e-15


@kernel("i8, i8, f4[::1], f4[::1], f4[::1], f4[::1], f4, f4", **JIT)
def _update(lo, hi, value, grad, first, second, root, rate):  # type: ignore[no-untyped-def]
    """Update elements lo..hi; `root` is 1/√(1 − β₂ⁿ), `rate` the rate over 1 − β₁ⁿ. Returns 0, or NaN when anything is not finite."""
    probe = np.float32(0.0)
    for i in range(np.uint64(lo), np.uint64(hi)):
        g = grad[i]
        m = np.float32(0.9) * first[i] + np.float32(0.1) * g
        v = np.float32(0.999) * second[i] + np.float32(0.001) * (g * g)
        x = value[i] - rate * m / (np.sqrt(v) * root + np.float32(EPSILON))
        first[i] = m
        second[i] = v
        value[i] = x
        probe += (x + v) * np.float32(0.0)
    return probe


class Adam:
    """One step count per tensor; β = (.9, .999), ε = 1e-15 as in the splatting literature."""

    def __init__(self) -> None:
        """Without moments."""
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}
        self.count: dict[str, int] = {}

    @torch.no_grad()
    def step(self, name: str, value: Tensor, grad: Tensor, rate: float) -> None:
        """Update `value` (contiguous float32) in place.

        Raises FloatingPointError naming the tensor when its gradient, its values or its second moment are not finite; the tensor and
        its moments are invalid then.
        """
        if name not in self.first:
            self.first[name], self.second[name], self.count[name] = torch.zeros_like(value), torch.zeros_like(value), 0
        m, v = self.first[name], self.second[name]
        self.count[name] += 1
        n = self.count[name]
        root, rate = 1 / math.sqrt(1 - 0.999**n), rate / (1 - 0.9**n)
        if value.device.type == "cpu":
            fine = self._fused(value, grad, m, v, root, rate)
        else:
            m.mul_(0.9).add_(grad, alpha=0.1)
            v.mul_(0.999).addcmul_(grad, grad, value=0.001)
            value.addcdiv_(m, v.sqrt().mul_(root).add_(EPSILON), value=-rate)
            fine = bool(torch.isfinite((value + v).sum()))
        if not fine:
            what = first_non_finite({f"the gradient of {name}": grad, name: value, f"the squared gradient of {name}": v})
            raise FloatingPointError(f"{what or name} is not finite after {n} updates")

    @staticmethod
    def _fused(value: Tensor, grad: Tensor, m: Tensor, v: Tensor, root: float, rate: float) -> bool:
        arrays: list[Any] = [x.view(-1).numpy() for x in (value, grad.contiguous(), m, v)]
        probe: list[float] = []  # appending is atomic
        factors = np.float32(root), np.float32(rate)
        run_chunks(lambda lo, hi: probe.append(_update(lo, hi, *arrays, *factors)), value.numel(), 1, 16384)
        return not any(math.isnan(x) for x in probe)

    def select(self, names: list[str], index: Tensor, added: int) -> None:
        """Keep the rows at `index` of the named tensors and append `added` rows of zero moments."""
        for table in (self.first, self.second):
            for name in names:
                if name in table:
                    kept = table[name][index]
                    table[name] = torch.cat([kept, kept.new_zeros(added, *kept.shape[1:])])

    def forget(self, names: list[str]) -> None:
        """Drop the moments and step counts of the named tensors, whose shapes have changed."""
        for name in names:
            for table in (self.first, self.second, self.count):
                table.pop(name, None)

    def state(self) -> dict[str, object]:
        """Everything a checkpoint needs."""
        return {"first": self.first, "second": self.second, "count": self.count}

    def load(self, state: dict[str, object]) -> None:
        """Restore what `state` returned."""
        self.first, self.second, self.count = dict(state["first"]), dict(state["second"]), dict(state["count"])  # type: ignore[call-overload]
