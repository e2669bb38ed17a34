"""Commands for many captures: `plan`, `batch` and `cache`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsbake.cli.options import (
    DryRunOption,
    JsonOption,
    MovedOption,
    Options,
    OutOption,
    QuietOption,
    SetOption,
    StoreOption,
    ThreadsOption,
    complete_profile,
    given_path,
)
from gsbake.cli.panels import Panel, PanelGroup, command

many_app = typer.Typer()

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


@command(many_app, "plan", Panel.MANY)
def plan_command(
    captures: CapturesArgument,
    out: RootOption = Path("out"),
    profile: BatchProfileOption = "relight",
    overrides: SetOption = None,
    threads: ThreadsOption = 0,
    seed: BatchSeedOption = 0,
    store: StoreOption = None,
    moved: MovedOption = False,
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

    plan(captures, BatchOptions(out, profile, tuple(overrides or ()), threads, seed, store, moved), form)


@command(many_app, "batch", Panel.MANY)
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
    moved: MovedOption = False,
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

    options = BatchOptions(out, profile, tuple(overrides or ()), threads, seed, store, moved)
    if captures == [Path("status")]:
        batch.status(out, as_json)
    else:
        slurm = SlurmOptions(partition, account)
        batch.batch(captures, options, executor, retry_failed=retry_failed, workers=jobs, slurm=slurm, quiet=quiet, as_json=as_json)


cache_app = typer.Typer(
    cls=PanelGroup, help="List, check or clean the stored outputs of an output folder or of a shared store.", no_args_is_help=True,
    rich_markup_mode=None, context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip
many_app.add_typer(cache_app, name="cache", rich_help_panel=Panel.MANY)


@command(cache_app, "ls")
def cache_ls_command(out: OutOption = None, store: StoreOption = None, as_json: JsonOption = False) -> None:
    """List the stored outputs, least recently used first."""
    from gsbake.cli import cache, shared_cache

    options = Options(out=out, store=store, as_json=as_json)
    (cache if out is not None or store is None else shared_cache).list_outputs(options)


@command(cache_app, "verify")
def cache_verify_command(
    out: OutOption = None, store: StoreOption = None, quiet: QuietOption = False, as_json: JsonOption = False
) -> None:  # fmt: skip
    """Read every stored file again and compare it with its digest."""
    from gsbake.cli import cache, shared_cache

    options = Options(out=out, store=store, quiet=quiet, as_json=as_json)
    (cache if out is not None or store is None else shared_cache).verify(options)


@command(cache_app, "gc")
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
    (cache if out is not None or store is None else shared_cache).collect_garbage(options, keep, older)


@command(cache_app, "quota")
def cache_quota_command(
    size: Annotated[str, typer.Argument(metavar="SIZE|none", help="Most bytes that machines may put into the store, such as 500GB.")],
    store: StoreOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Limit the size of a shared store; a machine that finds it full keeps its outputs to itself."""
    from gsbake.cli.shared_cache import set_quota

    set_quota(Options(store=store, quiet=quiet, as_json=as_json), size)
