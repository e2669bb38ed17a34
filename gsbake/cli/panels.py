"""Help in panels, as plain text: typer draws its `rich_help_panel` with Rich alone, which would make `gsbake --help` three times as slow.

Commands and options name their panel by typer's own parameter; the order of panels is that of the lists below.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup


class Panel(StrEnum):
    """Panels of commands, in their order."""

    MAKE = "Make"
    INSPECT = "Inspect"
    EDIT = "Edit"
    MANY = "Many captures"
    FILES = "Files"
    STAGES = "Single stages"


#: Panels of commands, in their order; one that names none, as in a group of commands, stands in the first.
COMMAND_PANELS = ("Commands", *Panel)

#: Panels of options, in their order; an option that names none stands in the first.
OPTIONS, PHOTO_OPTIONS, COMMON_OPTIONS = OPTION_PANELS = ("Options", "Options of the photos", "Common options")


def by_panel(items: Iterable[Any], order: Iterable[str]) -> dict[str, list[Any]]:
    """{panel: its commands or options} in the `order` of panels; those that name none are in the first."""
    panels: dict[str, list[Any]] = {title: [] for title in order}
    first = next(iter(panels))
    for item in items:
        panels[getattr(item, "rich_help_panel", None) or first].append(item)
    return {title: members for title, members in panels.items() if members}


def _write_options(command: Any, context: Any, formatter: Any) -> None:
    """The arguments of a command, then its options by panel; `--help` comes last."""
    records = {p: p.get_help_record(context) for p in command.get_params(context)}
    shown = [p for p, record in records.items() if record is not None]
    panels = {"Arguments": [p for p in shown if p.param_type_name == "argument"]}
    panels |= by_panel((p for p in shown if p.param_type_name == "option" and p.name != "help"), OPTION_PANELS)
    panels.setdefault(list(panels)[-1] if len(panels) > 1 else OPTIONS, []).extend(p for p in shown if p.name == "help")
    for title, members in panels.items():
        if members:
            with formatter.section(title):
                formatter.write_dl([records[p] for p in members])


class PanelCommand(TyperCommand):
    """A command whose options stand in panels."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments and options."""
        _write_options(self, ctx, formatter)


class PanelGroup(TyperGroup):
    """A group whose commands stand in panels, each with its first sentence."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the commands, then the group's own options."""
        names = self.list_commands(ctx)
        width = max(map(len, names))
        for title, members in by_panel((self.commands[name] for name in names), COMMAND_PANELS).items():
            with formatter.section(title):
                formatter.write_dl([((c.name or "").ljust(width), c.get_short_help_str(limit=1000)) for c in members])
        _write_options(self, ctx, formatter)


def command(app: typer.Typer, name: str, panel: Panel | None = None, **settings: Any) -> Callable[[Any], Any]:
    """Decorator that adds a command to `app`, in a panel."""
    return app.command(name, cls=PanelCommand, rich_help_panel=panel, **settings)
