"""Finds the VecNormalize of a stable-baselines3 model.

A model that was trained with a VecNormalize plays badly without it, because its observations then have another scale.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import PolicyError

if TYPE_CHECKING:
    from .catalogue import Description

# Maximum error of a fitted linear function, relative to the range of its values. It allows for float32's rounding.
AFFINE_TOLERANCE = 1e-3


def find_normalizer(model: Any, given: Any, description: Description) -> Any:
    """Return the VecNormalize of a model, or None if it has none.

    Args:
        model: a model of stable-baselines3.
        given: a VecNormalize, or the path of a saved one; False for none; None for the model's own.
        description: the description of the environment in which the model is tested.

    Raises:
        PolicyError: if `given` is not a VecNormalize, or is one for observations of another shape; or if the model may
            have been trained with a VecNormalize that it no longer has.
    """
    if given is False:
        return None
    normalizer = model.get_vec_normalize_env() if given is None else given
    if isinstance(normalizer, str | os.PathLike):
        normalizer = _read(Path(normalizer))
    if normalizer is None:
        _require_untouched(model)
        return None
    if not callable(getattr(normalizer, "normalize_obs", None)):
        raise PolicyError(
            f"normalizer is {normalizer!r}; expected stable-baselines3's VecNormalize, the path of a saved one, "
            "or False"
        )
    mean: Any = getattr(getattr(normalizer, "obs_rms", None), "mean", ())
    shape, expected = np.shape(mean), (len(description.observation),)
    if getattr(normalizer, "norm_obs", True) and shape != expected:
        raise PolicyError(
            f"the normalizer is for observations of the shape {shape}, those of {description.name} have {expected}: "
            "give the VecNormalize that the model was trained under"
        )
    return normalizer


def _read(path: Path) -> Any:
    """Load a VecNormalize that `VecNormalize.save` wrote. The file is a pickle, so its source must be trusted."""
    try:
        with path.open("rb") as file:
            return pickle.load(file)
    except OSError as error:
        raise PolicyError(f"normalizer={str(path)!r} cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise PolicyError(
            f"normalizer={str(path)!r} is not a saved VecNormalize ({error}); give what VecNormalize.save(path) wrote"
        ) from error


def _require_untouched(model: Any) -> None:
    """Refuse a model that was, or may have been, trained with a VecNormalize, and was loaded without it.

    stable-baselines3 stores the last observations of a model in `_last_obs`. Under a VecNormalize these are normalised,
    and `_last_original_obs` has the same observations before normalisation. Without a VecNormalize, on-policy
    algorithms do not set `_last_original_obs`, and off-policy algorithms store the observations of the previous step in
    it. So in an off-policy model, `_last_obs` is a scaled and shifted copy of `_last_original_obs` only under a
    VecNormalize.
    """
    original, last = getattr(model, "_last_original_obs", None), getattr(model, "_last_obs", None)
    if original is None:
        return
    how = (
        "give normalizer=, the VecNormalize or the path that VecNormalize.save() wrote; or normalizer=False if the "
        "model takes observations as they are"
    )
    was_trained = f"this {type(model).__name__} model was trained under a VecNormalize, but was loaded without it"
    if not hasattr(model, "replay_buffer"):  # an on-policy model
        raise PolicyError(f"{was_trained}, so it may receive observations on a scale that it was not trained on: {how}")
    if model.get_env() is not None:
        return  # the model has its environment, from training or as an argument of load(), without a VecNormalize
    if last is None or np.shape(last) != np.shape(original) or len(original) < 3:
        raise PolicyError(
            f"this {type(model).__name__} model was loaded without its environment, so it is not known whether it was "
            f"trained under a VecNormalize: {how}"
        )
    if not np.array_equal(last, original) and _is_affine(np.asarray(original, float), np.asarray(last, float)):
        raise PolicyError(
            f"{was_trained}, so it would receive observations on a scale that it was not trained on: {how}"
        )


def _is_affine(original: np.ndarray[Any, Any], last: np.ndarray[Any, Any]) -> bool:
    """Whether each column of `last` [N, O] is a linear function of the same column of `original`. N is at least 3."""
    for x, y in zip(original.T, last.T, strict=True):
        spread = np.ptp(y)
        if np.ptp(x) == 0 or spread == 0:
            if np.ptp(x) != spread:  # a linear function with a non-zero slope maps equal numbers to equal numbers
                return False
            continue
        fitted = np.polyval(np.polyfit(x, y, 1), x)
        if np.abs(fitted - y).max() > AFFINE_TOLERANCE * spread:
            return False
    return True
