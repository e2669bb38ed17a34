"""The surface among those that a front passed through that the photos agree on most: a minimum cut.

Cells that the front removed are a graph between the air outside and what is left. Cutting between two neighbouring cells costs what the
photos' disagreement was when the front was there, plus a constant that keeps the surface small (Vogiatzis et al., *Multiview stereo via
volumetric graph-cuts and occlusion robust photo-consistency*, PAMI 2007).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

#: Capacities are whole numbers: this many to a unit of cost.
UNITS = 1000


def cut_cells(removed: NDArray[np.bool_], left: NDArray[np.bool_], cost: NDArray[np.float32], area: float) -> NDArray[np.bool_]:
    """Which of the `removed` cells (n, n, n) stay air: the cut of least cost between the air and what is `left` (n, n, n).

    `cost` (n, n, n), 0 to 10⁵, of a surface in a cell; `area` is added for each face between two cells.
    """
    index = np.full(removed.shape, -1, np.int64)
    count = int(removed.sum())
    index[removed] = np.arange(count)
    source, sink = count, count + 1
    rows, columns, values = [], [], []
    for axis in range(3):
        first = tuple(slice(0, -1) if k == axis else slice(None) for k in range(3))
        second = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        for a, b in ((first, second), (second, first)):
            here, there, solid = index[a], index[b], left[b]
            inner = (here >= 0) & (there >= 0)
            rows.append(here[inner])
            columns.append(there[inner])
            values.append(0.5 * (cost[a][inner] + cost[b][inner]))
            end = (here >= 0) & (there < 0)
            inward, outward = end & solid, end & ~solid
            rows += [here[inward], np.full(int(outward.sum()), source)]
            columns += [np.full(int(inward.sum()), sink), here[outward]]
            values += [cost[a][inward], cost[a][outward]]
    flat = np.concatenate(values) + area
    graph = sparse.coo_matrix((flat, (np.concatenate(rows), np.concatenate(columns))), (count + 2, count + 2)).tocsr()
    units = np.maximum(np.round(graph.data * UNITS), 1).astype(np.int32)
    capacity = sparse.csr_matrix((units, graph.indices.astype(np.int32), graph.indptr.astype(np.int32)), graph.shape)
    flow = maximum_flow(capacity, source, sink).flow
    residual = (capacity - flow).tocsr()
    residual.eliminate_zeros()
    reached = breadth_first_order(residual, source, return_predecessors=False)
    air = np.zeros(count + 2, bool)
    air[reached] = True
    out = np.zeros(removed.shape, bool)
    out[removed] = air[:count]
    return out
