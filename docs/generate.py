"""Pages made from the code while the site is built: every setting and every command. They are never stale and never committed.

mkdocs calls `on_files` (see `hooks` in mkdocs.yml); the texts come from the settings' models and from the command line itself.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator
from typing import Any, get_args, get_origin

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from pydantic.fields import FieldInfo

from gsbake.cli.app import app
from gsbake.cli.panels import COMMAND_PANELS, OPTION_PANELS, by_panel
from gsbake.config.load import bounds, load_profile, shipped
from gsbake.config.schema import Profile


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to those in docs/."""
    for uri, text in {"reference/settings.md": settings_page(), "reference/commands.md": commands_page()}.items():
        files.append(File.generated(config, uri, content=text))
    return files


def _cell(text: str) -> str:
    """Text that may stand in a table's cell."""
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())


def _code(value: object) -> str:
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return f"`{text}`" if text else ""


# -- settings ------------------------------------------------------------------------------------------------------------------------------


def _allowed(field: FieldInfo) -> str:
    """The values a setting takes, in words."""
    if field.annotation is bool:
        return "true or false"
    if get_origin(field.annotation) is tuple:
        return bounds(field)
    choices = [c for c in get_args(field.annotation) if not isinstance(c, type)]
    words = [str(inner) for c in choices for inner in (get_args(c) or (c,))]
    if words:
        return ", ".join(_code(word) for word in words) + (", true, false" if bool in get_args(field.annotation) else "")
    return bounds(field)


def settings_page() -> str:
    """One table a section: the setting, its default, what it takes, what it means, and which profiles differ from the default."""
    profiles = {name: load_profile(name).profile for name in shipped()}
    out = [
        "# Settings",
        "",
        "Each setting belongs to a section of the profile. Set it in a TOML file, or once with `--set section.key=value`. "
        "`gsbake profiles NAME` prints the values of one profile and where each comes from.",
        "",
        "This page is made from `gsbake/config/schema.py` whenever the site is built.",
    ]
    for section, info in Profile.model_fields.items():
        model: Any = info.annotation
        if not hasattr(model, "model_fields"):
            continue
        out += ["", f"## {section}", "", (model.__doc__ or "").strip(), ""]
        out += ["| setting | default | takes | meaning | in profiles |", "|---|---|---|---|---|"]
        for key, field in model.model_fields.items():
            values = {name: getattr(getattr(profile, section), key) for name, profile in profiles.items()}
            differ = ", ".join(f"{name} {_code(value)}" for name, value in values.items() if value != field.default)
            cells = (f"`{section}.{key}`", _code(field.default), _allowed(field), _cell(field.description or ""), differ)
            out.append("| " + " | ".join(cells) + " |")
    return "\n".join(out) + "\n"


# -- commands ------------------------------------------------------------------------------------------------------------------------------


def _default(parameter: Any) -> str:
    value = parameter.default
    if value is None or value == () or value == [] or value is False or value is ... or callable(value):
        return ""
    if isinstance(value, enum.Enum):
        value = value.value
    return f" Default: {_code(value)}."


def _parameters(parameters: Iterable[Any]) -> Iterator[str]:
    for parameter in parameters:
        options = [*parameter.opts, *parameter.secondary_opts]
        text = _cell(getattr(parameter, "help", None) or "")
        if any(option.startswith("-") for option in options):
            shown = ", ".join(f"`{option}`" for option in sorted(options, key=len))
            value = parameter.metavar if parameter.metavar else ""
            shown += f" `{value}`" if value else ""
            yield f"| {_cell(shown)} | {text}{_default(parameter) if 'default:' not in text else ''} |"
        else:
            yield f"| `{_cell(parameter.metavar or parameter.name.upper())}` | {text} |"


def _with_subcommands(command: Any) -> Iterator[tuple[str, Any]]:
    """(name, command) of a command and of those below it, such as `cache gc`."""
    yield command.name, command
    for name, below in getattr(command, "commands", {}).items():
        yield f"{command.name} {name}", below


def commands_page() -> str:
    """One section a panel of `gsbake --help`, and in it one a command, with its arguments and options."""
    group: Any = typer.main.get_command(app)
    out = [
        "# Commands",
        "",
        "This page is made from the command line itself whenever the site is built. `gsbake COMMAND --help` prints the same.",
    ]
    panels = by_panel(group.commands.values(), COMMAND_PANELS)
    for title, commands in panels.items():
        out += ["", f"**{title}**", "", "| command | does |", "|---|---|"]
        out += [f"| [`gsbake {command.name}`](#gsbake-{command.name}) | {_cell(command.help or '')} |" for command in commands]
    for title, commands in panels.items():
        out += ["", f"## {title}"]
        for name, command in (pair for listed in commands for pair in _with_subcommands(listed)):
            out += ["", f"### gsbake {name} {{ #gsbake-{name.replace(' ', '-')} }}", "", " ".join((command.help or "").split())]
            arguments = [p for p in command.params if p.param_type_name == "argument"]
            options = by_panel((p for p in command.params if p.param_type_name == "option"), OPTION_PANELS)
            for kind, parameters in ({"Arguments": arguments} | options).items():
                if parameters:
                    out += ["", f"| {kind.lower()} | meaning |", "|---|---|", *_parameters(parameters)]
    return "\n".join(out) + "\n"
