"""Reads and writes all files of a folder, so that policies and assessments can be pickled."""

from __future__ import annotations

from pathlib import Path


def read_folder(folder: str) -> dict[str, bytes]:
    """Return the content of each file in a folder, by file name. Subfolders are left out."""
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir()) if path.is_file()}


def write_folder(folder: str, files: dict[str, bytes]) -> None:
    """Write files, given by name, into an existing folder."""
    for name, content in files.items():
        (Path(folder) / Path(name).name).write_bytes(content)
