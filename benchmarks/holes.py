"""Known holes: what was tried, how it ended in version 0.1.0, and the tests that try it now."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Hole:
    """What was `tried`, what happened `before`, and its `tests`: whole files, or "file::test"."""

    tried: str
    before: str
    tests: tuple[str, ...]


HOLES = (
    Hole("a store that is none", "files deleted", ("tests/pipeline/test_foreign_folders.py",)),
    Hole("`cache gc` among other tools' data", "deleted", ("tests/pipeline/test_garbage.py",)),
    Hole(
        "edited and foreign results", "overwritten",
        (
            "tests/cli/test_publishing.py", "tests/batch/test_page.py",
            "tests/viewing/test_tools.py::test_outputs_replace_no_input_and_no_other_file",
        ),
    ),
    Hole(
        "folders of others", "overwritten",
        ("tests/cli/test_output_folder.py", "tests/synth/test_folder.py", "tests/safety/test_home.py::test_known_holes"),
    ),
    Hole(
        "hand edits of stages", "deleted",
        (
            "tests/pipeline/test_cache_integrity.py::test_an_output_edited_in_place_is_set_aside",
            "tests/pipeline/test_replace.py::test_the_only_copy_of_the_users_files_is_set_aside",
        ),
    ),
    Hole("names in a store", "files elsewhere deleted", ("tests/pipeline/test_hostile_entries.py", "tests/system/test_names.py")),
    Hole("names in jobs for schedulers", "second command", ("tests/batch/test_names.py",)),
    Hole("glTF that asks for memory", "1 TB", ("tests/gltf/test_hostile_files.py", "tests/viewing/test_hostile_files.py")),
    Hole(
        "photos, models, videos, XML", "161 GB, other files read",
        (
            "tests/capture/test_hostile_files.py", "tests/test_memory_budget.py",
            "tests/capture/photos/test_video.py::test_a_list_of_other_files_opens_none_of_them",
        ),
    ),
    Hole("a store's password", "printed, stored", ("tests/batch/test_credentials.py",)),
    Hole("`make VENV=DIR setup`, `clean`", "DIR deleted", ("tests/packaging/test_make.py",)),
)  # fmt: skip
