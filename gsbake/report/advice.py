"""What to do about each warning, beside it in the report."""

from __future__ import annotations

import re
from collections.abc import Sequence

#: (pattern of a warning, what to do).
ADVICE = (
    (r"observed by no photo", "Add photos of it, or lay the object on another side and mask it; red in the camera map. {where}"),
    (r"more blurred than the rest", "Take these photos again: closer to the light, with a shorter exposure, or from a tripod."),
    (r"could not be registered", "Add photos between these and their neighbours, so that each shows much of what the next one does."),
    (r"object in another position", "Bake each position by itself, from folders of their own."),
    (r"have no mask", "Run `gsbake masks`, draw what is missing, and give the folder with `--masks`."),
    (r"near-duplicates", "Nothing has to be done; photos from new sides would help more."),
    (r"was skipped", "Save the photo again from its original, or remove it."),
    (r"have no pose|have no photo", "Check that the names in the pose file are those of the photos, or set `poses.source=solve`."),
    (r"hull of the masks is empty", "White is the object: try `--invert-masks`, and check that masks and photos belong together."),
    (r"file size", "Take a target with a smaller budget, as in `--target web`, or raise `export.max_megabytes`."),
    (r"raise mesh\.faces", "Run again with more triangles, as in `--set mesh.faces=60000`."),
    (r"degenerate|without area", "Viewers draw the asset all the same; a few triangles have no area."),
    (r"printed marker", "Lay the marker flat beside the object, so that several photos show all of it."),
    (r"scale by .* differs", "Measure that length again, and check the pixels of its points."),
)  # fmt: skip


def advice(text: str, where: Sequence[str] = ()) -> str:
    """What to do about a warning; `where` says from where to photograph what no photo saw. Empty where nothing is known."""
    for pattern, what in ADVICE:
        if re.search(pattern, text):
            places = "Best from " + "; ".join(where) + "." if where else ""
            return what.format(where=places).strip()
    return ""
