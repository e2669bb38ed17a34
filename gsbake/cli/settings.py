"""`gsbake settings`: settings that the next run of an output folder shall have."""

from __future__ import annotations

from gsbake.cli.options import Options
from gsbake.cli.output import print_json, print_text


def settings(options: Options, unset: frozenset[str]) -> None:
    """Merge the given options with the stored ones, less those that `unset` names, store them, and print them."""
    session = options.session(unset=unset)
    session.store_settings()
    project = session.project
    if options.as_json:
        print_json({"out": str(session.out), "profile": project.profile, "settings": list(project.overrides)}, indent=None)
    elif not options.quiet:
        print_text(f"{session.out}: profile {project.profile} {' '.join(project.overrides)}".rstrip())
