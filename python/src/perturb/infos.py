"""Infos of a batch as in Gymnasium's vector environments: arrays [N], each with a mask of environments with a value."""

from __future__ import annotations

from typing import Any


def merge(infos: dict[str, Any], later: dict[str, Any]) -> None:
    """Add later infos to infos. If both have a value for an environment, the later one replaces the earlier."""
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
