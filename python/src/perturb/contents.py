"""Folders as values: what pickles of policies and assessments hold."""

from __future__ import annotations

from pathlib import Path


def read_folder(folder: str) -> dict[str, bytes]:
    """Read the plain files of a folder, by name."""
    return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir()) if path.is_file()}


def write_folder(folder: str, files: dict[str, bytes]) -> None:
    """Write files into a folder that is there."""
    for name, content in files.items():
        (Path(folder) / Path(name).name).write_bytes(content)
