"""The only import of pycolmap in gsbake.

pycolmap 4.1.0–4.2.1 corrupts zlib when it is loaded first: the next PNG written in the process aborts. Importing zlib before it avoids
this, so no other module imports pycolmap. Features, matching and mapping run in a separate process, see `gsbake.capture.sfm.process`.
"""

from __future__ import annotations

import zlib  # must stay before pycolmap, see above

import pycolmap

__all__ = ["pycolmap", "zlib"]
