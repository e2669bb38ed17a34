"""The commands and their options; each body is imported when its command runs, which keeps `--help` quick."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from gsbake import __version__
from gsbake.cli.options import (
    Device,
    DeviceOption,
    DryRunOption,
    InvertOption,
    JsonOption,
    MasksOption,
    Options,
    OutOption,
    PhotosArgument,
    PosesOption,
    ProfileOption,
    QuietOption,
    SeedOption,
    SetOption,
    ThreadsOption,
    VerboseOption,
    complete_profile,
    complete_stage,
)

app = typer.Typer(
    name="gsbake",
    help="Photos in, relightable game-ready asset out.",
    epilog=(
        "Exit codes: 0 done, 2 wrong usage, 42 bad input (do not retry), 75 interrupted, out of memory or disk full (the same command "
        "resumes), 1 internal error."
    ),
    no_args_is_help=True,
    rich_markup_mode=None,  # plain help is there in a third of the time
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

#: What `--invert-masks` stands for.
INVERTED = ("ingest.invert_masks=true",)
#: Commands that bring the pipeline up to one stage, and their help.
STAGE_HELP = {
    "ingest": "Read photos, masks and known poses.",
    "poses": "Find the cameras, and the object in front of them.",
    "stereo": "Match the photos, for points on the surface to start from.",
    "train": "Train the surfels.",
    "refine": "Prune and densify the surfels, then fine-tune them.",
    "mesh": "Turn the surfels into a clean mesh.",
    "bake": "Unwrap the mesh and bake its textures.",
    "export": "Write asset.glb, its cameras and its light, and audit them.",
    "report": "Write the report that shows photo beside asset.",
}


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"gsbake {__version__}")
        raise typer.Exit


@app.callback()
def top(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")] = False,
) -> None:
    """Photos in, relightable game-ready asset out."""


def _pipeline_command(target: str | None) -> Callable[..., None]:
    """The command that brings the pipeline up to `target`; all take the same options."""

    def command(
        photos: PhotosArgument = None,
        out: OutOption = None,
        profile: ProfileOption = None,
        overrides: SetOption = None,
        masks: MasksOption = None,
        poses: PosesOption = None,
        invert_masks: InvertOption = False,
        device: DeviceOption = Device.auto,
        threads: ThreadsOption = 0,
        seed: SeedOption = None,
        dry_run: DryRunOption = False,
        quiet: QuietOption = False,
        verbose: VerboseOption = False,
        as_json: JsonOption = False,
    ) -> None:
        from gsbake.cli.run import run_pipeline

        options = Options(
            photos=photos, out=out, profile=profile, overrides=[*(overrides or []), *(INVERTED if invert_masks else ())], masks=masks,
            poses=poses, device=device.value, threads=threads, seed=seed,
            dry_run=dry_run, quiet=quiet, verbose=verbose, as_json=as_json,
        )  # fmt: skip
        run_pipeline(options, target)

    return command


app.command("run", help="Everything: from PHOTOS to asset.glb and report.html.")(_pipeline_command(None))
for _name, _help in STAGE_HELP.items():
    app.command(_name, help=f"{_help} Runs what it needs first.")(_pipeline_command(_name))


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
    """Which stages are cached, which would run, and why."""
    from gsbake.cli.inspect import status

    status(
        Options(
            photos=photos, out=out, profile=profile, overrides=overrides or [], device=device.value, seed=seed, quiet=quiet, as_json=as_json
        )
    )


@app.command("explain")
def explain_command(
    stage: Annotated[str | None, typer.Argument(help="Stage; all without one.", autocompletion=complete_stage, show_default=False)] = None,
    out: OutOption = None,
    profile: ProfileOption = None,
    overrides: SetOption = None,
    device: DeviceOption = Device.auto,
    seed: SeedOption = None,
    as_json: JsonOption = False,
) -> None:
    """What a stage's key is made of, and which field or file makes it run again."""
    from gsbake.cli.inspect import explain

    explain(Options(out=out, profile=profile, overrides=overrides or [], device=device.value, seed=seed, as_json=as_json), stage)


@app.command("replace")
def replace_command(
    stage: Annotated[str, typer.Argument(help="Stage whose output is replaced.", autocompletion=complete_stage)],
    files: Annotated[list[Path] | None, typer.Argument(metavar="FILE...", help="Your files, or one folder.", show_default=False)] = None,
    out: OutOption = None,
    undo: Annotated[bool, typer.Option("--undo", help="Let the stage's own output count again.")] = False,
    dry_run: DryRunOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Put your own files in place of a stage's output, such as an edited mesh."""
    from gsbake.cli.replace import replace

    replace(Options(out=out, dry_run=dry_run, quiet=quiet, as_json=as_json), stage, files or [], undo)


cache_app = typer.Typer(
    help="Check or clean the stored outputs of an output folder.", no_args_is_help=True, rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip
app.add_typer(cache_app, name="cache")


@cache_app.command("verify")
def cache_verify_command(out: OutOption = None, quiet: QuietOption = False, as_json: JsonOption = False) -> None:
    """Read every stored file again and compare it with its digest."""
    from gsbake.cli.cache import verify

    verify(Options(out=out, quiet=quiet, as_json=as_json))


@cache_app.command("gc")
def cache_gc_command(
    out: OutOption = None,
    keep: Annotated[
        str | None, typer.Option("--keep", metavar="SIZE", help="Keep at most this much, such as 20GB.", show_default=False)
    ] = None,
    older: Annotated[
        str | None, typer.Option("--older", metavar="AGE", help="Delete what was unused for longer, such as 30d.", show_default=False)
    ] = None,
    dry_run: DryRunOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Delete outputs of old settings, checkpoints, and what killed runs left behind; your replacements stay."""
    from gsbake.cli.cache import collect_garbage

    collect_garbage(Options(out=out, dry_run=dry_run, quiet=quiet, as_json=as_json), keep, older)


@app.command("profiles")
def profiles_command(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME|FILE", help="Profile.", autocompletion=complete_profile, show_default=False)
    ] = None,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """List the profiles, or show one: every setting, its value, where that comes from, and what it means."""
    from gsbake.cli.inspect import list_profiles, show_profile

    if name is None:
        list_profiles(as_json)
    else:
        show_profile(name, overrides or [], as_json)


@app.command("doctor")
def doctor_command(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder whose disk is looked at.")] = Path("out"),
    as_json: JsonOption = False,
) -> None:
    """What is installed, which backend runs, what is missing, and what to do about it."""
    from gsbake.cli.doctor import doctor

    doctor(as_json, out)


@app.command("synth")
def synth_command(
    folder: Annotated[Path, typer.Argument(help="Where the capture is written.")],
    views: Annotated[int, typer.Option(min=1, help="Number of photos.")] = 24,
    size: Annotated[int, typer.Option(min=1, help="Edge of the square photos in pixels.")] = 128,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    poses: Annotated[bool, typer.Option("--poses/--no-poses", help="Write transforms.json.")] = True,
    background: Annotated[bool, typer.Option("--background", help="Opaque photos with a patterned ground instead of cut-outs.")] = False,
    dry_run: DryRunOption = False,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the built-in synthetic capture: photos of an analytic object, with the truth beside them."""
    from gsbake.cli.synth import synth

    synth(folder, views=views, size=size, seed=seed, poses=poses, background=background, dry_run=dry_run, quiet=quiet, as_json=as_json)
