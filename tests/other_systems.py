"""Tests that need Linux or POSIX, by name: a file, or a test in it. `conftest` leaves them out on other systems."""

from __future__ import annotations

import sys
from pathlib import Path

TESTS = Path(__file__).parent

#: What only Linux has: /proc, LD_PRELOAD, Slurm, file names of any bytes, a limit on address space.
LINUX = (
    "faults/test_faults.py",
    "slurm",
    "safety",
    "batch/test_names.py",
    "cli/test_commands.py",
    "cli/test_hostile_names.py",
    "capture/test_hostile_files.py::test_name_that_is_no_text",
    "capture/test_hostile_files.py::test_a_sparse_colmap_model_is_refused_by_its_size",
    "gltf/test_hostile_files.py::test_sparse_files_are_refused_by_their_size",
    "test_memory_budget.py::test_a_child_that_takes_more_than_its_limit_is_the_files_fault",
    "test_memory_budget.py::test_a_limit_of_the_process_counts",
    "test_memory_budget.py::test_inspect_under_a_limit_ends_in_a_sentence",
    "test_memory_budget.py::test_what_is_refused_is_named",
    "pipeline/test_cache_integrity.py::test_project_survives_names_of_any_bytes",
    "pipeline/test_engine.py::test_unwritable_output",
    "system/test_bare.py::test_the_same_parser_where_the_system_limits_it",
)
#: What Windows has not: signals that a process can handle, links for every user, modes of files, `sh`.
POSIX = (
    "batch/test_batch.py::test_a_batch_goes_on_after_its_coordinator_was_killed",
    "batch/test_plan.py::test_slurm_jobs_wait_for_each_other",
    "batch/test_plan.py::test_the_shell_script_goes_on_after_a_failure",
    "batch/test_slurm_commands.py",
    "benchmarks/test_batch.py",
    "benchmarks/test_materials.py::test_a_missing_scorer_has_no_score_and_a_failed_one_is_an_error",
    "benchmarks/test_peers.py",
    "benchmarks/test_skip.py",
    "capture/photos/test_reader_pool.py",
    "cli/test_shared_cache.py::test_links_are_named_and_left_alone",
    "capture/test_colmap.py::test_sigterm_is_left_to_the_stage",
    "capture/test_sources.py::test_mask_folder_that_leads_out_of_the_capture_must_be_named",
    "capture/test_sources.py::test_masks_are_images_inside_their_folder",
    "packaging/test_make.py",
    "gltf/test_stages.py::test_a_known_distance_makes_metres",
    "gltf/test_stages.py::test_materials_and_light_of_a_relightable_asset",
    "pipeline/test_cache_integrity.py::test_links_to_folders_are_not_followed",
    "pipeline/test_cache_integrity.py::test_planted_link_to_a_folder_is_set_aside",
    "pipeline/test_engine.py::test_a_worker_ended_from_outside_can_be_run_again",
    "pipeline/test_engine.py::test_native_crash_raises_stage_failed",
    "pipeline/test_foreign_folders.py::test_a_store_whose_folders_are_links_is_refused",
    "pipeline/test_foreign_folders.py::test_links_in_a_store_lead_nowhere",
    "pipeline/test_garbage.py::test_a_link_with_a_name_of_gsbake_stays",
    "pipeline/test_garbage.py::test_nothing_behind_a_link_is_deleted",
    "pipeline/test_interruption.py",
    "pipeline/test_shared_store.py::test_puts_that_are_killed_leave_nothing_that_counts",
    "pipeline/test_store_servers.py",
    "surfels/training/test_interrupted_stages.py",
    "system/test_bare.py",
    "system/test_exit_codes.py",
)


def left_out(system: str = sys.platform) -> tuple[str, ...]:
    """The names that are left out on a system ("linux", "darwin", "win32")."""
    return () if system == "linux" else LINUX if system == "darwin" else (*LINUX, *POSIX)


def is_left_out(path: Path, name: str | None = None, system: str = sys.platform) -> bool:
    """Whether the test `name` in the file `path` is left out, or without a name the whole file or folder."""
    relative = path.relative_to(TESTS).as_posix() if path.is_relative_to(TESTS) else ""
    return (f"{relative}::{name}" if name else relative) in left_out(system)
