"""Targets as people write them: `web`, `ar:usdz`, `default:ktx2+meshopt`. A target is a place where the asset is used, with its budget.

Budgets follow the Khronos *3D Commerce Asset Creation Guidelines*: bytes, triangles and texture edge; `pixels` is the longest extent of the
object on the screen, from which the error bound of the decimation follows.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable
from dataclasses import dataclass

from gsbake.errors import UsageError


@dataclass(frozen=True)
class Budget:
    """Limits of a target; None leaves the limit of `[export]`, or none for a film."""

    megabytes: float | None
    triangles: int | None
    texture: int
    pixels: int


BUDGETS = {
    "default": Budget(None, None, 2048, 2048),
    "web": Budget(3.0, 150_000, 2048, 2048),
    "ar": Budget(3.0, 150_000, 2048, 2048),
    "banner": Budget(0.5, 30_000, 512, 512),
    "planner": Budget(1.0, 40_000, 1024, 1024),
    "film": Budget(4096.0, 10_000_000, 4096, 4096),
}
#: Target that holds the surfels instead of the mesh.
SURFELS = "surfels"
#: Forms of the GLB: texture codecs and geometry codecs.
TEXTURE_FORMS, GEOMETRY_FORMS = ("webp", "ktx2"), ("quantised", "meshopt")
#: Forms that are other files than a GLB.
FILE_FORMS = ("usdz", "usdc", "obj")
#: {form: (module, package, extra)} of what must be installed.
PACKAGES = {
    "ktx2": ("alktx2", "alktx2", "web"),
    "meshopt": ("meshopt", "meshopt", "web"),
    "usdz": ("pxr", "usd-core", "usd"),
    "usdc": ("pxr", "usd-core", "usd"),
}
#: Names of the files that targets make: GLB with its forms and levels, USD and OBJ with their images, the masters of a film, the surfels.
_PLACE = "|".join(name for name in BUDGETS if name != "default")
_CODECS = rf"(_({'|'.join(TEXTURE_FORMS)}))?(_({'|'.join(GEOMETRY_FORMS)}))?"
_ROLE = r"_(base_color|orm|roughness|metallic|normal|emissive)\.(png|jpg)"
_FILE = re.compile(
    rf"asset(_({_PLACE}))?{_CODECS}(_lod[1-9]|_lods)?\.glb|asset(_({_PLACE}))?(_lod[1-9])?(\.(usdz|usdc|obj|mtl)|{_ROLE})"
    rf"|asset_film{_CODECS}/(base_color|orm|normal|emissive)\.exr|{SURFELS}\.ply"
)


def is_target_file(name: str) -> bool:
    """Whether `name` is one that a target's file may have in the output folder; `asset.glb` is the export's."""
    return name != "asset.glb" and _FILE.fullmatch(name) is not None


@dataclass(frozen=True)
class Target:
    """A parsed target: `name` in BUDGETS or SURFELS, and its `forms` in the order of the tables above."""

    name: str
    forms: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The target as it is written."""
        return f"{self.name}:{'+'.join(self.forms)}" if self.forms else self.name

    @property
    def stem(self) -> str:
        """Name of its file without suffix: asset_web, asset_ktx2_meshopt."""
        words = [*(() if self.name == "default" else (self.name,)), *(f for f in self.forms if f not in FILE_FORMS)]
        return "_".join(["asset", *words])

    @property
    def file_form(self) -> str:
        """Kind of its file: glb, usdz, usdc, obj or ply."""
        return "ply" if self.name == SURFELS else next((f for f in self.forms if f in FILE_FORMS), "glb")

    @property
    def texture_form(self) -> str | None:
        """webp or ktx2; None for PNG and JPEG."""
        return next((f for f in self.forms if f in TEXTURE_FORMS), None)

    @property
    def geometry_form(self) -> str | None:
        """quantised or meshopt; None for floats."""
        return next((f for f in self.forms if f in GEOMETRY_FORMS), None)


def parse_target(text: str) -> Target:
    """The target that `text` names. Raises ValueError, which says what there is."""
    name, colon, rest = text.strip().partition(":")
    if "udim" in text.lower():
        raise ValueError("UDIM is not written: gsbake bakes one UV tile; take film, one tile of up to 4096 texels")
    if name not in (*BUDGETS, SURFELS):
        raise ValueError(f"'{name}' is no target; there are {', '.join(BUDGETS)} and {SURFELS}")
    known = (*TEXTURE_FORMS, *GEOMETRY_FORMS, *FILE_FORMS)
    given = [form.strip() for form in rest.split("+")] if colon else []
    unknown = [form for form in given if form not in known]
    if unknown:
        raise ValueError(f"'{unknown[0]}' is no form of a target; there are {', '.join(known)}")
    if given and name == SURFELS:
        raise ValueError(f"{SURFELS} is one PLY file and has no forms")
    for group in (TEXTURE_FORMS, GEOMETRY_FORMS, FILE_FORMS):
        if sum(form in group for form in set(given)) > 1:
            raise ValueError(f"'{text}' names several of {', '.join(group)}; give them as targets of their own")
    if any(form in FILE_FORMS for form in given) and len(set(given)) > 1:
        raise ValueError(f"'{text}': compression is for GLB files; {', '.join(FILE_FORMS)} stand alone")
    return Target(name, tuple(form for form in known if form in given))


def require_packages(targets: Iterable[Target]) -> None:
    """Raise UsageError when a target needs a package that is not installed."""
    for target in targets:
        for form in target.forms:
            module, package, extra = PACKAGES.get(form, ("", "", ""))
            if module and importlib.util.find_spec(module) is None:
                raise UsageError(f"The target '{target.text}' needs {package}, which is not installed: pip install 'gsbake[{extra}]'.")
