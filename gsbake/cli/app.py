"""Commands and their options; the body of a command is imported when it runs, which keeps `--help` fast."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import typer

from gsbake import __version__
from gsbake.cli.file_commands import file_app
from gsbake.cli.many_commands import many_app
from gsbake.cli.options import (
    Device,
    DeviceOption,
    DryRunOption,
    FrontOption,
    InvertOption,
    JsonOption,
    KnownDistanceOption,
    LeaveOutOption,
    LevelsOption,
    MarkerSizeOption,
    MasksOption,
    MovedOption,
    Options,
    OriginOption,
    OutOption,
    OverwriteOption,
    PhotosArgument,
    PosesOption,
    ProfileOption,
    QuietOption,
    RegionOption,
    RequireOption,
    SeedOption,
    SetOption,
    StoreOption,
    TargetOption,
    ThreadsOption,
    UnsetOption,
    UpOption,
    VerboseOption,
    ViewOption,
    WhiteOption,
    complete_profile,
    complete_stage,
    given_path,
    mask_settings,
    photo_settings,
    scale_settings,
    target_settings,
)
from gsbake.cli.panels import Panel, PanelGroup, command

app = typer.Typer(
    name="gsbake",
    cls=PanelGroup,
    help="Photos in, relightable game-ready asset out.",
    epilog=(
        "Exit codes: 0 done, 2 wrong usage, 3 figures worse than required, 42 bad input (do not retry), 75 interrupted, out of memory or "
        "disk full (the same command resumes), 1 internal error."
    ),
    no_args_is_help=True,
    rich_markup_mode=None,  # plain help takes a third of the time
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: {stage command: help}.
STAGE_HELP = {
    "ingest": "Read photos, masks and known poses.",
    "poses": "Estimate camera poses and the unit frame.",
    "stereo": "Compute depth maps and surface points by multi-view stereo.",
    "train": "Train the surfels.",
    "refine": "Prune and densify the surfels, then fine-tune them.",
    "mesh": "Extract a mesh from the surfels and decimate it.",
    "bake": "Unwrap the mesh and bake its textures.",
    "export": "Write asset.glb, cameras.json and light.hdr, and audit the asset.",
    "report": "Write report.html, which compares photos and renders.",
    "targets": "Write the asset's files for the places where it is used (--target).",
}


def _version(show: bool) -> None:
    if show:
        typer.echo(f"gsbake {__version__}")
        raise typer.Exit


@app.callback()
def top(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")] = False,
) -> None:
    """Photos in, relightable game-ready asset out."""


def _pipeline_command(until: str | None) -> Callable[..., None]:
    """The command that brings the stages up to `until` (None: all) up to date; all have the same options."""

    def pipeline_command(
        photos: PhotosArgument = None,
        out: OutOption = None,
        profile: ProfileOption = None,
        targets: TargetOption = None,
        levels: LevelsOption = None,
        overrides: SetOption = None,
        overwrite: OverwriteOption = False,
        dry_run: DryRunOption = False,
        view: ViewOption = False,
        require: RequireOption = None,
        up: UpOption = None,
        front: FrontOption = None,
        origin: OriginOption = None,
        masks: MasksOption = None,
        invert_masks: InvertOption = False,
        leave_out: LeaveOutOption = None,
        poses: PosesOption = None,
        moved: MovedOption = False,
        region: RegionOption = None,
        known_distances: KnownDistanceOption = None,
        marker_size: MarkerSizeOption = None,
        white: WhiteOption = None,
        device: DeviceOption = Device.auto,
        threads: ThreadsOption = 0,
        seed: SeedOption = None,
        store: StoreOption = None,
        quiet: QuietOption = False,
        verbose: VerboseOption = False,
        as_json: JsonOption = False,
    ) -> None:
        from gsbake.cli.run import run_pipeline

        settings = [
            *(overrides or []), *mask_settings(masks, invert_masks), *(region or ()), *scale_settings(known_distances, marker_size),
            *(up or ()), *photo_settings(leave_out, white, front, origin), *target_settings(targets, levels),
        ]  # fmt: skip
        options = Options(
            photos=photos, out=out, profile=profile, overrides=settings,
            masks=masks.folder if masks else None, poses=poses, device=device.value, threads=threads, seed=seed,
            dry_run=dry_run, quiet=quiet, verbose=verbose, as_json=as_json, store=store, view=view,
            overwrite=overwrite, moved=moved, require=tuple(bound for group in require or () for bound in group),
        )  # fmt: skip
        run_pipeline(options, until)

    return pipeline_command


command(app, "run", Panel.MAKE, help="Run all stages: PHOTOS to asset.glb and report.html.")(_pipeline_command(None))
for _name, _help in STAGE_HELP.items():
    command(app, _name, Panel.STAGES, help=f"{_help} Runs the stages before it first.")(_pipeline_command(_name))


@command(app, "status", Panel.INSPECT)
def status_command(
    photos: PhotosArgument = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    overrides: SetOption = None,
    moved: MovedOption = False,
    device: DeviceOption = Device.auto,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show which stages are cached, which would run, and why."""
    from gsbake.cli.inspect import status

    status(
        Options(
            photos=photos, out=out, profile=profile, overrides=overrides or [], device=device.value, seed=seed, quiet=quiet,
            as_json=as_json, moved=moved,
        )
    )  # fmt: skip


@command(app, "settings", Panel.EDIT)
def settings_command(
    photos: PhotosArgument = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    targets: TargetOption = None,
    levels: LevelsOption = None,
    overrides: SetOption = None,
    unset: UnsetOption = None,
    up: UpOption = None,
    front: FrontOption = None,
    origin: OriginOption = None,
    masks: MasksOption = None,
    invert_masks: InvertOption = False,
    leave_out: LeaveOutOption = None,
    poses: PosesOption = None,
    moved: MovedOption = False,
    region: RegionOption = None,
    known_distances: KnownDistanceOption = None,
    marker_size: MarkerSizeOption = None,
    white: WhiteOption = None,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Store settings in the output folder for its next run; nothing is run."""
    from gsbake.cli.settings import settings

    where = [*(region or ()), *(up or ()), *photo_settings(leave_out, white, front, origin)]
    given = [*(overrides or []), *mask_settings(masks, invert_masks), *where, *scale_settings(known_distances, marker_size)]
    given += target_settings(targets, levels)
    settings(
        Options(
            photos=photos, out=out, profile=profile, overrides=given, masks=masks.folder if masks else None, poses=poses, seed=seed,
            moved=moved, quiet=quiet, as_json=as_json,
        ),
        frozenset(unset or ()),
    )  # fmt: skip


@command(app, "explain", Panel.INSPECT)
def explain_command(
    stage: Annotated[str | None, typer.Argument(help="Stage; default: all.", autocompletion=complete_stage, show_default=False)] = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    overrides: SetOption = None,
    device: DeviceOption = Device.auto,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> None:
    """Show the inputs of a stage's cache key, and which setting or file makes it run again."""
    from gsbake.cli.inspect import explain

    explain(Options(out=out, profile=profile, overrides=overrides or [], device=device.value, seed=seed, as_json=as_json), stage)


@command(app, "replace", Panel.EDIT)
def replace_command(
    stage: Annotated[str, typer.Argument(help="Stage whose output is replaced.", autocompletion=complete_stage)],
    files: Annotated[
        list[Path] | None, typer.Argument(parser=given_path, metavar="FILE...", help="Your files, or one folder.", show_default=False)
    ] = None,
    out: OutOption = None,
    undo: Annotated[bool, typer.Option("--undo", help="Use the stage's own output again.")] = False,
    dry_run: DryRunOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Replace a stage's output with your own files, such as an edited mesh."""
    from gsbake.cli.replace import replace

    replace(Options(out=out, dry_run=dry_run, quiet=quiet, as_json=as_json), stage, files or [], undo)


@command(app, "check", Panel.MAKE)
def check_command(
    photos: Annotated[
        Path,
        typer.Argument(parser=given_path, metavar="PHOTOS", help="Folder of photos, a capture folder, or a video.", show_default=False),
    ],
    masks: MasksOption = None,
    poses: PosesOption = None,
    threads: ThreadsOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Say what will go wrong with photos before they are baked, and what to do about it."""
    from gsbake.cli.check import check

    check(photos, masks.folder if masks else None, poses, threads, as_json)


@command(app, "studio", Panel.MAKE)
def studio_command(
    folder: Annotated[
        Path, typer.Argument(parser=given_path, metavar="FOLDER", help="Folder of captures.  [default: .]", show_default=False)
    ] = Path("."),
    port: Annotated[int, typer.Option("--port", min=0, max=65_535, help="Port on 127.0.0.1; 0: a free one.", show_default=False)] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Serve a page on this machine that does all of this with eyes and a mouse: captures, photos, masks, set-up, runs, assets."""
    from gsbake.cli.studio import studio

    studio(folder, port, browser=browser)


@command(app, "masks", Panel.EDIT)
def masks_command(
    folder: Annotated[Path, typer.Argument(parser=given_path, metavar="DIR", help="New folder for the masks.", show_default=False)],
    doubtful: Annotated[bool, typer.Option("--doubtful", help="Only those that the other photos contradict.")] = False,
    out: OutOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the masks in use, to edit them and give them back with --masks."""
    from gsbake.cli.masks import masks

    masks(Options(out=out, quiet=quiet, as_json=as_json), folder, doubtful)


@command(app, "profiles", Panel.INSPECT)
def profiles_command(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME|FILE", help="Profile.", autocompletion=complete_profile, show_default=False)
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="List the published systems too, which are for comparison.")] = False,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the profiles for assets, or show one: every setting, its value, the source of the value, and its help."""
    from gsbake.cli.inspect import list_profiles, show_profile

    if name is None:
        list_profiles(everything, as_json)
    else:
        show_profile(name, overrides or [], as_json)


@command(app, "doctor", Panel.INSPECT)
def doctor_command(
    out: Annotated[
        Path, typer.Option("--out", "-o", parser=given_path, metavar="DIR", help="Folder whose free disk space is checked.")
    ] = Path("out"),
    fetch_weights: Annotated[
        bool, typer.Option("--fetch-weights", help="Install the weights of the network that makes masks (4.6 MB), and check nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check the installation: libraries, backend, memory and disk, with advice where something is missing."""
    if fetch_weights:
        from gsbake.capture.masks.weights import install
        from gsbake.cli.output import print_text

        print_text(f"The weights of the mask network are in {install()}.")
        return
    from gsbake.cli.doctor import doctor

    doctor(as_json, out)


@command(app, "synth", Panel.MAKE)
def synth_command(
    folder: Annotated[Path, typer.Argument(parser=given_path, help="Output folder of the capture.")],
    views: Annotated[int, typer.Option(min=1, max=10_000, help="Number of photos.")] = 24,
    size: Annotated[int, typer.Option(min=1, max=16_384, help="Edge of the square photos in pixels.")] = 128,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of the noise.")] = 0,
    poses: Annotated[bool, typer.Option("--poses/--no-poses", help="Write transforms.json.")] = True,
    background: Annotated[bool, typer.Option("--background", help="Opaque photos with a ground plane, not transparent ones.")] = False,
    marker: Annotated[bool, typer.Option("--marker", help="A printed ArUco marker of 0.2 units on a ground plane.")] = False,
    dry_run: DryRunOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the built-in synthetic capture: renders of an analytic object, with ground truth."""
    from gsbake.cli.synth import synth

    synth(
        folder, views=views, size=size, seed=seed, poses=poses, background=background, marker=marker, dry_run=dry_run, quiet=quiet,
        as_json=as_json,
    )  # fmt: skip


app.add_typer(many_app)
app.add_typer(file_app)


@lru_cache(maxsize=1)
def parser() -> Callable[..., object]:
    """The parser of all commands; a program that runs several commands builds it once."""
    return typer.main.get_command(app)
