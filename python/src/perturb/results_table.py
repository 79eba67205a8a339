"""Reading of the results table that `perturb export` writes."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

from . import _native
from .errors import InvalidArgumentError
from .policy import native

if TYPE_CHECKING:
    from collections.abc import Iterable

# Columns of integers that have no value in the row of a failed cell.
COUNTS = ("revision", "after_episodes", "episodes", "successes", "timesteps")


def read_results(path: str | os.PathLike[str], settings: Iterable[str] = ()) -> Any:
    """Read a results table of `perturb export` as a pandas DataFrame.

    The table has a row for each experiment cell, test set and tested policy. `docs/results-table.md` describes the
    columns. The column `success_percent` is added. `frame.attrs["plans"]` has the text of each study's experiment file,
    by the study's name.

    Args:
        path: the Parquet file.
        settings: names of training settings to add as columns, such as `learning_rate`. The value is None for a method
            without this setting.

    Raises:
        InvalidArgumentError: if the file is not a results table, or was written by a later version of perturb.
        ImportError: if pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError("read_results() needs pandas, which perturb does not install: pip install pandas") from error
    if not isinstance(path, str | os.PathLike):
        raise InvalidArgumentError(f"path is {path!r}; expected a file that `perturb export` wrote")
    columns, plans = native(_native.read_results, os.fspath(path))
    frame = pd.DataFrame(columns)
    for name in COUNTS:
        frame[name] = frame[name].astype("Int64")
    frame["success_percent"] = 100.0 * columns["successes"] / columns["episodes"]
    names = list(settings)
    if names:
        known = {text: json.loads(text) for text in frame["settings"].unique()}
        for name in names:
            frame[name] = [known[text].get(name) for text in frame["settings"]]
    frame.attrs["plans"] = dict(plans)
    return frame
