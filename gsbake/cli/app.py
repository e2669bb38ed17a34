"""Commands and their options; the body of a command is imported when it runs, which keeps `--help` fast."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import typer

from gsbake import __version__
from gsbake.cli.file_commands import file_app
from gsbake.cli.options import (
    Device,
    DeviceOption,
    DryRunOption,
    InvertOption,
    JsonOption,
    KnownDistanceOption,
    LevelsOption,
    MarkerSizeOption,
    MasksOption,
    Options,
    OutOption,
    PhotosArgument,
    PosesOption,
    ProfileOption,
    QuietOption,
    SeedOption,
    SetOption,
    StoreOption,
    TargetOption,
    ThreadsOption,
    VerboseOption,
    ViewOption,
    complete_profile,
    complete_stage,
    given_path,
    scale_settings,
    target_settings,
)

app = typer.Typer(
    name="gsbake",
    help="Photos in, relightable game-ready asset out.",
    epilog=(
        "Exit codes: 0 done, 2 wrong usage, 42 bad input (do not retry), 75 interrupted, out of memory or disk full (the same command "
        "resumes), 1 internal error."
    ),
    no_args_is_help=True,
    rich_markup_mode=None,  # plain help takes a third of the time
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: Setting of `--invert-masks`.
INVERTED = ("ingest.invert_masks=true",)
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


def _pipeline_command(target: str | None) -> Callable[..., None]:
    """The command that brings the stages up to `target` up to date; all have the same options."""

    def command(
        photos: PhotosArgument = None,
        out: OutOption = None,
        profile: ProfileOption = None,
        overrides: SetOption = None,
        masks: MasksOption = None,
        poses: PosesOption = None,
        invert_masks: InvertOption = False,
        known_distances: KnownDistanceOption = None,
        marker_size: MarkerSizeOption = None,
        targets: TargetOption = None,
        levels: LevelsOption = None,
        device: DeviceOption = Device.auto,
        threads: ThreadsOption = 0,
        seed: SeedOption = None,
        store: StoreOption = None,
        dry_run: DryRunOption = False,
        view: ViewOption = False,
        quiet: QuietOption = False,
        verbose: VerboseOption = False,
        as_json: JsonOption = False,
    ) -> None:
        from gsbake.cli.run import run_pipeline

        mask_settings = (*(masks.settings if masks else ()), *(INVERTED if invert_masks else ()))
        settings = [*(overrides or []), *mask_settings, *scale_settings(known_distances, marker_size), *target_settings(targets, levels)]
        options = Options(
            photos=photos, out=out, profile=profile, overrides=settings,
            masks=masks.folder if masks else None, poses=poses, device=device.value, threads=threads, seed=seed,
            dry_run=dry_run, quiet=quiet, verbose=verbose, as_json=as_json, store=store, view=view,
        )  # fmt: skip
        run_pipeline(options, target)

    return command


app.command("run", help="Run all stages: PHOTOS to asset.glb and report.html.")(_pipeline_command(None))
for _name, _help in STAGE_HELP.items():
    app.command(_name, help=f"{_help} Runs the stages before it first.")(_pipeline_command(_name))


@app.command("status")
def status_command(
    photos: PhotosArgument = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    overrides: SetOption = None,
    device: DeviceOption = Device.auto,
    seed: SeedOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Show which stages are cached, which would run, and why."""
    from gsbake.cli.inspect import status

    status(
        Options(
            photos=photos, out=out, profile=profile, overrides=overrides or [], device=device.value, seed=seed, quiet=quiet, as_json=as_json
        )
    )


@app.command("explain")
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


@app.command("replace")
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


@app.command("check")
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


@app.command("masks")
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


CapturesArgument = Annotated[
    list[Path], typer.Argument(parser=given_path, metavar="CAPTURES...", help="Folders of photos, or capture folders.", show_default=False)
]
RootOption = Annotated[
    Path, typer.Option("--out", "-o", parser=given_path, metavar="DIR", help="Folder with one output folder per capture.")
]
BatchProfileOption = Annotated[
    str, typer.Option("--profile", "-p", metavar="NAME|FILE", help="Profile of all captures.", autocompletion=complete_profile)
]
BatchSeedOption = Annotated[int, typer.Option("--seed", help="Seed of all random numbers, 0 to 2147483647.")]


@app.command("plan")
def plan_command(
    captures: CapturesArgument,
    out: RootOption = Path("out"),
    profile: BatchProfileOption = "relight",
    overrides: SetOption = None,
    threads: ThreadsOption = 0,
    seed: BatchSeedOption = 0,
    store: StoreOption = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--emit", metavar="FORMAT", help="Print the jobs for a scheduler: json, sh, snakemake, slurm, opencue or openjd.",
            show_default=False,
        ),
    ] = None,
) -> None:  # fmt: skip
    """Show the jobs that bring captures up to date, with dependencies, time and memory; nothing is run."""
    from gsbake.batch.captures import BatchOptions
    from gsbake.cli.batch import plan

    plan(captures, BatchOptions(out, profile, tuple(overrides or ()), threads, seed, store), form)


@app.command("batch")
def batch_command(
    captures: Annotated[
        list[Path],
        typer.Argument(
            parser=given_path, metavar="CAPTURES...|status", show_default=False,
            help="Folders of photos, or capture folders; or the word status, which shows how far the batch in DIR is.",
        ),
    ],
    out: RootOption = Path("out"),
    profile: BatchProfileOption = "relight",
    executor: Annotated[str, typer.Option("--executor", metavar="local|slurm", help="Where the jobs run.")] = "local",
    overrides: SetOption = None,
    threads: ThreadsOption = 0,
    seed: BatchSeedOption = 0,
    store: StoreOption = None,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", min=0, max=100_000, help="Most jobs in Slurm's queue at a time; 0: two for each core, at least 100.",
            show_default=False,
        ),
    ] = 0,
    partition: Annotated[str | None, typer.Option("--partition", help="Slurm's partition.  [default: Slurm's]", show_default=False)] = None,
    account: Annotated[str | None, typer.Option("--account", help="Slurm's account.  [default: the user's]", show_default=False)] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Run captures again that failed with the same input.")] = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Bake many captures on this machine or with Slurm, through Snakemake; the same command goes on where it stopped."""
    from gsbake.batch.captures import BatchOptions
    from gsbake.batch.slurm import SlurmOptions
    from gsbake.cli import batch

    options = BatchOptions(out, profile, tuple(overrides or ()), threads, seed, store)
    if captures == [Path("status")]:
        batch.status(out, as_json)
    else:
        slurm = SlurmOptions(partition, account)
        batch.batch(captures, options, executor, retry_failed=retry_failed, workers=jobs, slurm=slurm, quiet=quiet, as_json=as_json)


cache_app = typer.Typer(
    help="List, check or clean the stored outputs of an output folder or of a shared store.", no_args_is_help=True, rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip
app.add_typer(cache_app, name="cache")


@cache_app.command("ls")
def cache_ls_command(out: OutOption = None, store: StoreOption = None, as_json: JsonOption = False) -> None:
    """List the stored outputs, least recently used first."""
    from gsbake.cli import cache, shared_cache

    options = Options(out=out, store=store, as_json=as_json)
    (cache if store is None else shared_cache).list_outputs(options)


@cache_app.command("verify")
def cache_verify_command(
    out: OutOption = None, store: StoreOption = None, quiet: QuietOption = False, as_json: JsonOption = False
) -> None:  # fmt: skip
    """Read every stored file again and compare it with its digest."""
    from gsbake.cli import cache, shared_cache

    options = Options(out=out, store=store, quiet=quiet, as_json=as_json)
    (cache if store is None else shared_cache).verify(options)


@cache_app.command("gc")
def cache_gc_command(
    out: OutOption = None,
    store: StoreOption = None,
    keep: Annotated[
        str | None, typer.Option("--keep", metavar="SIZE", help="Keep at most this much, such as 20GB.", show_default=False)
    ] = None,
    older: Annotated[
        str | None, typer.Option("--older", metavar="AGE", help="Delete what is unused for longer, such as 30d.", show_default=False)
    ] = None,
    dry_run: DryRunOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Delete outputs of old settings, checkpoints and files of killed runs; your replacements are kept."""
    from gsbake.cli import cache, shared_cache

    options = Options(out=out, store=store, dry_run=dry_run, quiet=quiet, as_json=as_json)
    (cache if store is None else shared_cache).collect_garbage(options, keep, older)


@cache_app.command("quota")
def cache_quota_command(
    size: Annotated[str, typer.Argument(metavar="SIZE|none", help="Most bytes that machines may put into the store, such as 500GB.")],
    store: StoreOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Limit the size of a shared store; a machine that finds it full keeps its outputs to itself."""
    from gsbake.cli.shared_cache import set_quota

    set_quota(Options(store=store, quiet=quiet, as_json=as_json), size)


@app.command("profiles")
def profiles_command(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME|FILE", help="Profile.", autocompletion=complete_profile, show_default=False)
    ] = None,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the profiles, or show one: every setting, its value, the source of the value, and its help."""
    from gsbake.cli.inspect import list_profiles, show_profile

    if name is None:
        list_profiles(as_json)
    else:
        show_profile(name, overrides or [], as_json)


@app.command("doctor")
def doctor_command(
    out: Annotated[
        Path, typer.Option("--out", "-o", parser=given_path, metavar="DIR", help="Folder whose free disk space is checked.")
    ] = Path("out"),
    as_json: JsonOption = False,
) -> None:
    """Check the installation: libraries, backend, memory and disk, with advice where something is missing."""
    from gsbake.cli.doctor import doctor

    doctor(as_json, out)


@app.command("synth")
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


app.add_typer(file_app)


@lru_cache(maxsize=1)
def parser() -> Callable[..., object]:
    """The parser of all commands; a program that runs several commands builds it once."""
    return typer.main.get_command(app)
