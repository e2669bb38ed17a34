"""The kernels compile to machine code for NVIDIA GPUs: Triton's compiler needs no GPU for that, only to run the result."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import json, sys
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from gsbake.surfels.raster.cuda import kernels

TYPES = {"starts": "*i64", "used": "*i64", "slots": "*i64", "ids": "*i32", "tiles_x": "i32", "width": "i32", "height": "i32"}
found = {}
for kernel, options in ((kernels.forward, kernels.FORWARD), (kernels.backward, kernels.BACKWARD)):
    constants = {"C": 8, "CP": 16, "CHUNK": options["CHUNK"]}
    names = kernel.arg_names
    signature = {n: "constexpr" if n in constants else TYPES.get(n, "*fp32") for n in names}
    source = ASTSource(kernel, signature=signature, constexprs={(names.index(n),): v for n, v in constants.items() if n in names})
    built = triton.compile(source, target=GPUTarget("cuda", int(sys.argv[1]), 32), options={"num_warps": options["num_warps"]})
    found[kernel.__name__] = [len(built.asm["cubin"]), built.metadata.shared, built.asm["ptx"].count("atom.")]
print(json.dumps(found))
"""


@pytest.mark.slow
@pytest.mark.parametrize("capability", [80, 90])
def test_machine_code(capability: int, tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(capability)], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert set(found) == {"forward", "backward"}
    for code, shared, atomics in found.values():
        assert code > 10_000 and shared <= 48 * 1024 and atomics == 0
