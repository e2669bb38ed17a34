"""Command line options shared by several commands."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsbake.cli.gates import REPORTED, Bounds, bounds_parser
from gsbake.cli.panels import COMMON_OPTIONS, PHOTO_OPTIONS

if TYPE_CHECKING:
    from gsbake.api import Session
    from gsbake.pipeline.engine import Observer


class Device(StrEnum):
    """Device of the kernels."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Origin(StrEnum):
    """Origin of the asset."""

    auto = "auto"
    bottom = "bottom"
    centre = "centre"


def complete_profile(incomplete: str) -> list[str]:
    """Shell completion of profile names."""
    from gsbake.config.load import shipped

    return [name for name in shipped() if name.startswith(incomplete)]


def complete_setting(incomplete: str) -> list[str]:
    """Shell completion of section.key=."""
    from gsbake.config.load import fields

    return [f"{name}=" for name in fields() if "." in name and name.startswith(incomplete)]


def complete_stage(incomplete: str) -> list[str]:
    """Shell completion of stage names."""
    from gsbake.stages import REGISTRY

    return [name for name in REGISTRY.names if name.startswith(incomplete)]


#: {choice of `--masks` that is no folder: ingest.masks}.
MASK_CHOICES = {"auto": "auto", "none": "ignore"}


def given_path(text: str) -> Path:
    """The path that an argument names. An empty one, such as an unset variable of a shell gives, is refused: for Python it is "."."""
    if not str(text):
        raise typer.BadParameter("the path is empty; '.' is the current folder")
    return Path(text)


@dataclass(frozen=True)
class Masks:
    """Value of `--masks`: a folder, or settings that say where masks come from."""

    folder: Path | None = None
    settings: tuple[str, ...] = ()


def given_masks(text: str) -> Masks:
    """The masks that an argument names; `./none` is a folder of that name."""
    if text in MASK_CHOICES:
        return Masks(settings=(f"ingest.masks={MASK_CHOICES[text]}",))
    return Masks(given_path(text))


def mask_settings(masks: Masks | None, inverted: bool) -> tuple[str, ...]:
    """Settings of `--masks` and `--invert-masks`."""
    return (*(masks.settings if masks else ()), *(("ingest.invert_masks=true",) if inverted else ()))


def given_distance(text: str) -> str:
    """A known distance that can be parsed."""
    from gsbake.config.lengths import parse_known_distance

    try:
        return parse_known_distance(text).text
    except ValueError as error:
        raise typer.BadParameter(f"{error}.") from error


def given_length(text: str) -> float:
    """Metres of the length that an argument names."""
    from gsbake.config.lengths import parse_length

    try:
        return parse_length(text)
    except ValueError as error:
        raise typer.BadParameter(f"{error}.") from error


def scale_settings(known_distances: list[str] | None, marker_size: float | None) -> tuple[str, ...]:
    """Settings of `--known-distance` and `--marker-size`."""
    distances = (f"scale.known_distances={json.dumps(known_distances, ensure_ascii=False)}",) if known_distances else ()
    return (*distances, *(() if marker_size is None else (f"scale.marker_size={marker_size!r}",)))


def given_region(text: str) -> tuple[str, ...]:
    """Settings of the region that an argument names: the box of a file, "auto" or "none"."""
    if text in ("auto", "none"):
        return (f"poses.region={text}", "poses.region_box=[]")
    from gsbake.geometry.region import Region

    return ("poses.region=auto", f"poses.region_box={json.dumps(Region.read(given_path(text)).numbers)}")


def given_white(text: str) -> str:
    """A patch of known reflectance that can be parsed."""
    from gsbake.config.white import parse_white

    try:
        return parse_white(text).text
    except ValueError as error:
        raise typer.BadParameter(f"{error}.") from error


def given_up(text: str) -> tuple[str, ...]:
    """Settings of the up axis that an argument names: by what is level, or by two or three points "X,Y,Z"."""
    if text in ("cameras", "markers", "ground"):
        return (f"export.up={text}", "export.up_points=[]")
    try:
        points = [[float(number) for number in part.split(",")] for part in text.split()]
    except ValueError:
        points = []
    if len(points) not in (2, 3) or any(len(point) != 3 for point in points):
        raise typer.BadParameter(f"'{text}' is neither cameras, markers or ground nor two or three points, as in '0,0,0 1,0,0 0,1,0'.")
    return (f"export.up_points={json.dumps([number for point in points for number in point])}",)


def photo_settings(leave_out: list[str] | None, white: list[str] | None, front: str | None, origin: Origin | None) -> tuple[str, ...]:
    """Settings of `--leave-out`, `--white`, `--front` and `--origin`."""
    lists = {"ingest.leave_out": leave_out, "bake.white": white}
    return (
        *(f"{name}={json.dumps(texts, ensure_ascii=False)}" for name, texts in lists.items() if texts),
        *(() if front is None else (f"export.front={front}",)),
        *(() if origin is None else (f"export.origin={origin.value}",)),
    )


def given_targets(text: str) -> tuple[str, ...]:
    """The targets of a list with commas."""
    from gsbake.config.targets import parse_target

    try:
        return tuple(parse_target(part).text for part in text.split(","))
    except ValueError as error:
        raise typer.BadParameter(f"{error}.") from error


def target_settings(targets: list[tuple[str, ...]] | None, levels: int | None) -> tuple[str, ...]:
    """Settings of `--target` and `--levels`; the target default alone asks for nothing but asset.glb."""
    files = list(dict.fromkeys(text for group in targets or () for text in group))
    named = (f"targets.files={json.dumps(files)}",) if files else ()
    return (*named, *(() if levels is None else (f"targets.levels={levels}",)))


PhotosArgument = Annotated[
    Path | None,
    typer.Argument(
        parser=given_path,
        metavar="PHOTOS",
        help="Folder of photos, a capture folder with images/, masks/ and poses, or a video. Needed in the first run only.",
        show_default=False,
    ),
]
OutOption = Annotated[
    Path | None,
    typer.Option(
        "--out", "-o", parser=given_path, metavar="DIR", help="Output folder.  [default: out/<name of PHOTOS>]", show_default=False
    ),
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        "--profile", "-p", metavar="NAME|FILE", help="Profile (see `gsbake profiles`).  [default: relight]", show_default=False,
        autocompletion=complete_profile,
    ),
]  # fmt: skip
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="SECTION.KEY=VALUE", help="Override one setting; repeatable.", show_default=False, autocompletion=complete_setting
    ),
]
UnsetOption = Annotated[
    list[str] | None,
    typer.Option("--unset", metavar="SECTION.KEY", help="Return one setting to the profile's value; repeatable.", show_default=False),
]
MasksOption = Annotated[
    Masks | None,
    typer.Option(
        "--masks",
        parser=given_masks,
        metavar="auto|none|DIR",
        help="Masks, one per photo, white on the object. auto: those of the capture, the missing ones are made; none: use none.",
        show_default=False,
        rich_help_panel=PHOTO_OPTIONS,
    ),
]
KnownDistanceOption = Annotated[
    list[str] | None,
    typer.Option(
        "--known-distance",
        parser=given_distance,
        metavar="'PHOTO:X,Y PHOTO:X,Y LENGTH'",
        help="Length between two points of the photos, as in 'A.jpg:120,80 B.jpg:640,410 8cm': the asset is in metres. Repeatable.",
        show_default=False,
        rich_help_panel=PHOTO_OPTIONS,
    ),
]
MarkerSizeOption = Annotated[
    float | None,
    typer.Option(
        "--marker-size",
        parser=given_length,
        metavar="LENGTH",
        help="Edge of the printed ArUco or AprilTag markers in the photos, as in 5cm: the asset is in metres.",
        show_default=False,
        rich_help_panel=PHOTO_OPTIONS,
    ),
]
RegionOption = Annotated[
    Any,
    typer.Option(
        "--region", parser=given_region, metavar="auto|none|FILE", show_default=False, rich_help_panel=PHOTO_OPTIONS,
        help="Box that is baked, in the cameras' frame: JSON with centre, size and rotation. auto: that of Metashape's file; none: none.",
    ),
]  # fmt: skip
LeaveOutOption = Annotated[
    list[str] | None,
    typer.Option(
        "--leave-out", metavar="PHOTO", show_default=False, rich_help_panel=PHOTO_OPTIONS,
        help="Photo that is not used, by the name of its file. Repeatable.",
    ),
]  # fmt: skip
WhiteOption = Annotated[
    list[str] | None,
    typer.Option(
        "--white", parser=given_white, metavar="PHOTO:X,Y[:R]|markers|card", show_default=False, rich_help_panel=PHOTO_OPTIONS,
        help="Patch of the object with the known reflectance R, of white paper without (0.9), which gives the light's intensity; "
        "or printed markers or a colour card beside the object. Repeatable.",
    ),
]  # fmt: skip
UpOption = Annotated[
    Any,
    typer.Option(
        "--up", parser=given_up, metavar="NAME|'X,Y,Z X,Y,Z [X,Y,Z]'", show_default=False,
        help="What is up: cameras, markers, ground; or, in the cameras' frame, three points of the ground or the ends of an upright edge.",
    ),
]  # fmt: skip
FrontOption = Annotated[
    str | None, typer.Option("--front", metavar="PHOTO", help="Photo that shows the front of the object.", show_default=False)
]
OriginOption = Annotated[
    Origin | None,
    typer.Option("--origin", help="Origin of the asset, by its box.  [default: auto: of given poses theirs]", show_default=False),
]
TargetOption = Annotated[
    list[Any] | None,
    typer.Option(
        "--target",
        parser=given_targets,
        metavar="NAME[:FORM],...",
        help="Further files: default, web, ar, banner, planner, film, surfels; forms webp, ktx2, quantised, meshopt (joined by +), "
        "usdz, usdc, obj. As in web,ar:usdz,default:ktx2+meshopt. Repeatable.",
        show_default=False,
    ),
]
LevelsOption = Annotated[
    int | None, typer.Option("--levels", min=0, max=8, metavar="N", help="Levels of detail below each target.", show_default=False)
]
PosesOption = Annotated[
    Path | None,
    typer.Option(
        "--poses",
        parser=given_path,
        metavar="PATH",
        help="Known poses: transforms.json, a COLMAP model folder, poses_bounds.npy, or cameras of Metashape (XML), RealityScan (CSV, "
        "XMP), OpenSfM, OpenMVG or Polycam (JSON).",
        show_default=False,
        rich_help_panel=PHOTO_OPTIONS,
    ),
]
InvertOption = Annotated[bool, typer.Option("--invert-masks", help="Masks are white on the background.", rich_help_panel=PHOTO_OPTIONS)]
ViewOption = Annotated[
    bool, typer.Option("--view", help="Serve a page on this machine that shows the run: render, curves, decisions, time left.")
]
RequireOption = Annotated[
    list[Any] | None,
    typer.Option(
        "--require", parser=bounds_parser(REPORTED), metavar="KEY=VALUE,...", show_default=False,
        help="End with exit code 3 where a figure of report.json is worse, as in psnr=22,ssim=0.8,bytes=8e6. Repeatable.",
    ),
]  # fmt: skip
DeviceOption = Annotated[Device, typer.Option("--device", help="Device of the kernels.", rich_help_panel=COMMON_OPTIONS)]
ThreadsOption = Annotated[
    int,
    typer.Option(
        "--threads", help="Number of threads, at most 512; 0 uses the physical cores.", show_default=False, rich_help_panel=COMMON_OPTIONS
    ),
]
SeedOption = Annotated[
    int | None,
    typer.Option(
        "--seed", help="Seed of all random numbers, 0 to 2147483647.  [default: 0]", show_default=False, rich_help_panel=COMMON_OPTIONS
    ),
]
StoreOption = Annotated[
    str | None,
    typer.Option(
        "--store", metavar="DIR|URL", envvar="GSBAKE_STORE", help="Shared store beside the output folder: a folder, s3:// or sftp://.",
        show_default=False, show_envvar=True, rich_help_panel=COMMON_OPTIONS,
    ),
]  # fmt: skip
OverwriteOption = Annotated[
    bool,
    typer.Option(
        "--overwrite", help="Publish results in the place of files there that you edited, which are moved to DIR/set-aside. "
        "Else they stay, and the new ones get names such as asset.new.glb.",
    ),
]  # fmt: skip
MovedOption = Annotated[
    bool, typer.Option("--moved", help="The photos of the run in DIR lie at another path now.", rich_help_panel=PHOTO_OPTIONS)
]
ReplaceFileOption = Annotated[bool, typer.Option("--overwrite", help="Replace the output file where it exists.")]
DryRunOption = Annotated[bool, typer.Option("--dry-run", "-n", help="Print what would run, and why; run nothing.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print warnings and errors only.", rich_help_panel=COMMON_OPTIONS)]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", help="Print every decision with its evidence.", rich_help_panel=COMMON_OPTIONS)
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.", rich_help_panel=COMMON_OPTIONS)]


@dataclass(frozen=True)
class Options:
    """Values of the shared options."""

    photos: Path | None = None
    out: Path | None = None
    profile: str | None = None
    overrides: list[str] = field(default_factory=list)
    masks: Path | None = None
    poses: Path | None = None
    device: str = "auto"
    threads: int = 0
    seed: int | None = None
    dry_run: bool = False
    quiet: bool = False
    verbose: bool = False
    as_json: bool = False
    store: str | None = None
    view: bool = False
    overwrite: bool = False
    moved: bool = False
    require: Bounds = ()

    def session(self, observer: Observer | None = None, unset: frozenset[str] = frozenset()) -> Session:
        """Session of the run that the options describe, without the stored settings that `unset` names; nothing is written."""
        from gsbake.api import RunOptions, open_session

        run = RunOptions(
            self.photos, self.out, self.profile, self.overrides, self.masks, self.poses, self.device, self.threads, self.seed,
            self.store, self.overwrite, self.moved, unset,
        )  # fmt: skip
        return open_session(run, observer)
