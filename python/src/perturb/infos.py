"""The `infos` dictionary of a batch, in the format of Gymnasium's vector environments.

Each key has an array [N] of values. The same key with an underscore before it has a mask [N], which is true for the
environments that have a value.
"""

from __future__ import annotations

from typing import Any


def merge(infos: dict[str, Any], later: dict[str, Any]) -> None:
    """Add the entries of `later` to `infos`, in place. New values replace older values of the same environment."""
    for key, values in later.items():
        if key.startswith("_"):
            continue
        mask = later[f"_{key}"]
        if key not in infos:
            infos[key], infos[f"_{key}"] = values, mask
        elif isinstance(values, dict):
            merge(infos[key], values)
            infos[f"_{key}"] = infos[f"_{key}"] | mask
        else:
            infos[key][mask] = values[mask]
            infos[f"_{key}"] = infos[f"_{key}"] | mask
