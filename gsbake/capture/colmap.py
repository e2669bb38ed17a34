"""The only import of pycolmap in gsbake.

pycolmap 4.1.0–4.2.1 corrupts zlib when it is loaded first: the next PNG written in the process aborts. Importing zlib before it avoids
this, so no other module imports pycolmap. Its logging library also takes over SIGTERM, by which a stage is asked to write a checkpoint and
stop: the handler is set again. Features, matching and mapping run in a separate process, see `gsbake.capture.sfm.process`.
"""

from __future__ import annotations

import signal
import threading
import zlib  # must stay before pycolmap, see above
from typing import Any

_on_terminate = signal.getsignal(signal.SIGTERM)  # before pycolmap, see above

import pycolmap  # noqa: E402

if _on_terminate is not None and threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGTERM, _on_terminate)

__all__ = ["pycolmap", "repeatable_mapping", "zlib"]


def repeatable_mapping(seed: int) -> Any:
    """Options of mapping and triangulation that give the same bytes every time.

    Bundle adjustment of more than 50 000 residuals sums them in the order in which its threads finish. One thread costs little: features
    and matching, which are most of the time, have all.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    return options
