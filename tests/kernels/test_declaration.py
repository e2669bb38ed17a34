"""Declared kernels: their types, and that a bake compiles nothing else."""

from __future__ import annotations

import ast
from pathlib import Path

import numba
import numpy as np
import pytest

from gsbake.config.load import load_profile
from gsbake.kernels.declaration import also_built_by, argument_types, compile_module, declared, kernel
from gsbake.stages import REGISTRY

ROOT = Path(__file__).resolve().parents[2]


def test_types_are_those_of_the_arrays() -> None:
    text = "f4[:, ::1], i8[::1], u1[:, :, ::1], b1, f8, UniTuple(f4[::1], 2)"
    arrays = (np.zeros((2, 3), np.float32), np.zeros(2, np.int64), np.zeros((1, 2, 3), np.uint8), True, 1.0, (np.zeros(2, np.float32),) * 2)
    assert argument_types(text) == tuple(numba.typeof(value) for value in arrays)
    assert argument_types((numba.f8,)) == (numba.f8,)
    with pytest.raises(NameError):
        argument_types("f5")


def test_a_module_is_compiled_before_it_is_called() -> None:
    @kernel("f8[::1], f8")
    def scaled(values, factor):  # type: ignore[no-untyped-def]
        return values * factor

    built = []
    also_built_by(__name__, lambda: built.append(1))
    assert compile_module(__name__) == 1 and built == [1]
    assert len(scaled.signatures) == 1
    assert scaled(np.ones(2), 3.0).tolist() == [3.0, 3.0] and len(scaled.signatures) == 1


def kernel_modules() -> set[str]:
    """Modules of the library that declare kernels."""
    found = set()
    for path in sorted((ROOT / "gsbake").rglob("*.py")):
        functions = [node for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.FunctionDef)]
        if any(ast.unparse(one).startswith("kernel(") for function in functions for one in function.decorator_list):
            found.add(".".join(path.relative_to(ROOT).with_suffix("").parts))
    return found


def test_stages_name_every_module_with_kernels_and_its_types_are_valid() -> None:
    settings = load_profile("relight").profile
    named = {name for stage in REGISTRY.up_to() for name in stage.kernels(settings)}
    assert named | {"gsbake.shading.split_sum_kernel"} == kernel_modules()  # a part of the fit's kernels, called alone by the report
    for name in sorted(named):
        for dispatcher, types in declared(name):
            assert len(types) == dispatcher.py_func.__code__.co_argcount, dispatcher


def compiled_functions() -> dict[tuple[str, str], tuple[str, set[str]]]:
    """{(file, function): (its options as text, names of the functions it calls)} of all compiled functions of the library."""
    found = {}
    for path in sorted((ROOT / "gsbake").rglob("*.py")):
        tree = ast.parse(path.read_text("utf-8"))
        assigned = [node for node in ast.walk(tree) if isinstance(node, ast.AnnAssign) and node.value is not None]
        shared = {ast.unparse(node.target): ast.unparse(node.value) for node in assigned if node.value is not None}
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef):
                texts = [ast.unparse(one) for one in function.decorator_list]
                options = " ".join(text for text in texts if "njit" in text or text.startswith("kernel("))
                if options:
                    options += "".join(f" {value}" for name, value in shared.items() if f"**{name}" in options)
                    options += " fastmath" if "**JIT" in options else ""  # of the rasteriser's blocks
                    calls = {one.func.id for one in ast.walk(function) if isinstance(one, ast.Call) and isinstance(one.func, ast.Name)}
                    found[path.name, function.name] = (options, calls)
    return found


def test_what_a_kernel_with_fast_math_calls_names_its_own_flags() -> None:
    functions = compiled_functions()
    named = {name for (_, name), (options, _) in functions.items() if "fastmath" in options}
    names = {name for _, name in functions}
    missing = {
        (file, name, call)
        for (file, name), (options, calls) in functions.items() if "fastmath" in options and "fastmath=False" not in options
        for call in calls & names - named
    }  # fmt: skip
    assert len(functions) > 100 and not missing
