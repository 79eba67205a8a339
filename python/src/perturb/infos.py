"""Infos of a batch, as Gymnasium's vector environments have them: arrays [N], and beside each a mask of who has it."""

from __future__ import annotations

from typing import Any


def merge(infos: dict[str, Any], later: dict[str, Any]) -> None:
    """Add what later infos tell; where both tell something of an environment, the later infos count."""
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
