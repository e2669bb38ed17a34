"""Write requirements.lock: every pinned package of constraints.txt with the SHA-256 digests of its files, for `pip --require-hashes`.

python packaging/lock.py [--index https://pypi.org/simple] [--wheels DIR]

The digests come from the package index (PEP 691 JSON), without files for Python versions that gsbake does not support. `--wheels` names a
folder with PyTorch's CPU builds ("2.13.0+cpu"), which lie on an index of their own: Linux takes these, since the plain release there
needs the CUDA libraries. Install with

pip install --require-hashes --extra-index-url https://download.pytorch.org/whl/cpu -r requirements.lock
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
import urllib.request
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Python tags of wheels that gsbake's Pythons can install.
TAGS = re.compile(r"cp31[1-3]|abi3|py3|py2\.py3")


def pins(constraints: Path) -> list[tuple[str, str]]:
    """(name, version) of every line of constraints.txt. Raises SystemExit for a line without an exact version."""
    found = []
    for line in constraints.read_text().splitlines():
        text = line.partition("#")[0].strip()
        if not text:
            continue
        match = re.fullmatch(r"([A-Za-z0-9._-]+)==([A-Za-z0-9.+!]+)", text)
        if not match:
            raise SystemExit(f"{constraints}: '{text}' is no exact version.")
        found.append((match.group(1), match.group(2)))
    return found


def normalised(name: str) -> str:
    """A package name as PEP 503 writes it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def version_of(filename: str) -> str:
    """Version in the name of a wheel or source archive, without a local part ("+cpu")."""
    stem = re.sub(r"\.(whl|tar\.gz|zip)$", "", filename)
    parts = stem.split("-")
    version = parts[1] if filename.endswith(".whl") else parts[-1]
    return version.partition("+")[0]


def usable(filename: str) -> bool:
    """Whether a file can be installed on a supported Python."""
    if filename.endswith(".whl"):
        return TAGS.search("-".join(filename[:-4].split("-")[2:])) is not None
    return filename.endswith((".tar.gz", ".zip"))


def digests(index: str, name: str, version: str) -> list[str]:
    """SHA-256 digests of the usable files of one release."""
    request = urllib.request.Request(
        f"{index.rstrip('/')}/{normalised(name)}/", headers={"Accept": "application/vnd.pypi.simple.v1+json"}
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        files = json.load(answer)["files"]
    return sorted({f["hashes"]["sha256"] for f in files if version_of(f["filename"]) == version and usable(f["filename"])})


def local_builds(folder: Path | None) -> dict[tuple[str, str], dict[str, list[str]]]:
    """{(name, version): {version with its local part: digests}} of the wheels in a folder."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for path in sorted(folder.glob("*+*.whl")) if folder is not None else []:
        name, full = path.name.split("-")[:2]
        builds = found.setdefault((normalised(name), version_of(path.name)), {})
        builds.setdefault(full, []).append(hashlib.sha256(path.read_bytes()).hexdigest())
    return found


def entry(requirement: str, every: Iterable[str]) -> str:
    """One requirement with its digests."""
    return " \\\n".join([requirement, *(f"    --hash=sha256:{digest}" for digest in sorted(every))])


def lock(releases: Iterable[tuple[str, str]], index: str, wheels: Path | None) -> str:
    """The text of requirements.lock. Raises SystemExit for a release without files."""
    releases, local = list(releases), local_builds(wheels)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda release: digests(index, *release), releases))
    lines = ["# Written by packaging/lock.py from constraints.txt; install with pip --require-hashes."]
    for (name, version), remote in zip(releases, found, strict=True):
        if not remote:
            raise SystemExit(f"The index has no file of {name} {version} for Python 3.11 to 3.13.")
        builds = local.get((normalised(name), version), {})
        lines += [entry(f"{name}=={full} ; sys_platform == 'linux'", every) for full, every in builds.items()]
        lines.append(entry(f"{name}=={version} ; sys_platform != 'linux'" if builds else f"{name}=={version}", remote))
    return "\n".join(lines) + "\n"


def main() -> None:
    """Write requirements.lock beside constraints.txt."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--index", default="https://pypi.org/simple")
    parser.add_argument("--wheels", type=Path)
    options = parser.parse_args()
    text = lock(pins(ROOT / "constraints.txt"), options.index, options.wheels)
    (ROOT / "requirements.lock").write_text(text)
    sys.stdout.write(f"{text.count('==')} packages, {text.count('--hash')} digests\n")


if __name__ == "__main__":
    main()
