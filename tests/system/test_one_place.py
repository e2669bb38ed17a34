"""What systems do differently is in gsbake/system, and the tests that need one system are known by name."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.other_systems import LINUX, POSIX, TESTS, is_left_out

ROOT = Path(__file__).resolve().parents[2]
#: Modules that some system lacks, or that work differently there.
MODULES = {"ctypes", "fcntl", "grp", "msvcrt", "pty", "pwd", "resource", "select", "selectors", "termios", "winreg"}
#: Names in `os`, `signal` and `subprocess` that some system lacks, or that work differently there.
NAMES = {
    "fork", "fsync", "getloadavg", "getpgid", "getpgrp", "getppid", "getuid", "geteuid", "kill", "killpg", "link", "mkfifo", "nice", "pipe",
    "sched_getaffinity", "set_blocking", "setpgid", "setsid", "statvfs", "symlink", "sysconf", "uname", "umask", "wait4", "waitpid",
    "SIGHUP", "SIGKILL", "SIGUSR1", "SIGALRM", "CTRL_BREAK_EVENT", "CREATE_NEW_PROCESS_GROUP", "pass_fds", "start_new_session",
    "preexec_fn",
}  # fmt: skip
#: Uses elsewhere: the driver of the GPU is a library in C; a control group is a file, which other systems lack.
ALLOWED = {("gsbake/pipeline/machine.py", "ctypes")}


def used(tree: ast.Module) -> set[str]:
    """The modules and names of the lists above that a file uses."""
    found: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Import():
                found |= {alias.name.partition(".")[0] for alias in node.names} & MODULES
            case ast.ImportFrom(module=str(module)):
                found |= {module.partition(".")[0]} & MODULES
            case ast.Attribute(value=ast.Name(id="os" | "signal" | "subprocess"), attr=name) if name in NAMES:
                found.add(name)
            case ast.keyword(arg=str(name)) if name in NAMES:
                found.add(name)
            case ast.Attribute(value=ast.Name(id="sys"), attr="platform"):
                found.add("sys.platform")
    return found


def test_nothing_else_depends_on_the_system() -> None:
    paths = [path for folder in ("gsbake", "stages") for path in (ROOT / folder).rglob("*.py")]
    elsewhere = [path for path in paths if "system" not in path.relative_to(ROOT).parts]
    assert len(elsewhere) > 300 and len(paths) > len(elsewhere)
    found = {(path.relative_to(ROOT).as_posix(), name) for path in elsewhere for name in used(ast.parse(path.read_text(encoding="utf-8")))}
    assert found - ALLOWED == set()


def test_the_lowest_folder_imports_nothing_of_gsbake() -> None:
    for path in (ROOT / "gsbake" / "system").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                assert not str(node.module).startswith("gsbake") or str(node.module).startswith("gsbake.system"), path


@pytest.mark.parametrize("name", [*LINUX, *POSIX])
def test_names_of_tests_that_are_left_out_elsewhere(name: str) -> None:
    file, _, test = name.partition("::")
    path = TESTS / file
    assert path.exists()
    assert not test or f"def {test}(" in path.read_text(encoding="utf-8")
    assert not is_left_out(path, test or None, "linux") and is_left_out(path, test or None, "win32")
    assert is_left_out(path, test or None, "darwin") == (name in LINUX)
