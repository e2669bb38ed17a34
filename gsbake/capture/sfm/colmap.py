"""The one door to pycolmap.

pycolmap 4.1.0–4.2.1 corrupts zlib when it is loaded first: the next PNG written in the process aborts. Importing zlib before it cures
that, so nothing else in gsbake imports pycolmap. Heavy work (features, matching, mapping) runs in a process of its own all the same, see
`gsbake.capture.sfm.process`.
"""

from __future__ import annotations

import zlib  # must stay before pycolmap, see above

import pycolmap

__all__ = ["pycolmap", "zlib"]
