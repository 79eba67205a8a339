"""The table of results that `perturb export` writes."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

from . import _native
from .errors import InvalidArgumentError
from .policy import native

if TYPE_CHECKING:
    from collections.abc import Iterable

# Counts, which a failed cell does not have.
COUNTS = ("revision", "after_episodes", "episodes", "successes", "timesteps")


def read_results(path: str | os.PathLike[str], settings: Iterable[str] = ()) -> Any:
    """Read a table of `perturb export` as a pandas DataFrame: a row for each cell, test set and tested policy.

    `docs/results-table.md` describes the columns. `success_percent` is added. `frame.attrs["plans"]` has the text of
    each study's experiment file.

    Args:
        path: the Parquet file.
        settings: names of settings that become columns, such as `learning_rate`; of methods without one it is None.

    Raises:
        InvalidArgumentError: if it is no such table, or one of a later schema.
        ImportError: if pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError("read_results() needs pandas, which perturb does not bring: pip install pandas") from error
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
