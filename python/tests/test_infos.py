"""Infos that are filled when somebody looks."""

from __future__ import annotations

import copy
import json
import operator
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import perturb
from perturb.infos import Later

FILLED = {"a": 1, "_a": 2}

LOOKS: list[Callable[[Any], Any]] = [
    dict,
    list,
    len,
    repr,
    bool,
    json.dumps,
    copy.copy,
    copy.deepcopy,
    lambda it: pickle.loads(pickle.dumps(it)),
    lambda it: {**it},
    lambda it: it | {"b": 3},
    lambda it: {"b": 3} | it,
    lambda it: it == FILLED,
    lambda it: operator.eq(FILLED, it),
    lambda it: it != FILLED,
    lambda it: "a" in it,
    lambda it: it["a"],
    lambda it: it.get("a"),
    lambda it: list(it.items()),
    lambda it: list(it.values()),
    lambda it: list(reversed(it)),
    lambda it: (it.pop("a"), dict(it)),
    lambda it: (it.setdefault("a", 7), dict(it)),
    lambda it: (it.update(b=4), dict(it)),
    lambda it: (it.__setitem__("a", 9), dict(it)),
    lambda it: (it.__delitem__("a"), dict(it)),
]


@pytest.mark.parametrize("look", LOOKS)
def test_whatever_looks_sees_what_a_plain_dictionary_has(look: Callable[[Any], Any]) -> None:
    fills = []

    def fill() -> dict[str, Any]:
        fills.append(1)
        return dict(FILLED)

    assert look(Later(fill)) == look(dict(FILLED))
    assert fills == [1]


def test_pickled_and_copied_it_is_a_plain_one() -> None:
    for made in (pickle.loads(pickle.dumps(Later(FILLED.copy))), copy.deepcopy(Later(FILLED.copy))):
        assert type(made) is dict


def test_what_a_step_brings_is_filled_when_somebody_looks(server: str) -> None:
    envs = perturb.PerturbVectorEnv("CartPole", 16, version="R", server=server)
    envs.reset(seed=1)
    looked = 0
    for _ in range(60):
        *_, infos = envs.step(np.ones(16, dtype=np.int64))
        if "parameters" not in infos:
            continue
        assert [list(dict.__iter__(infos[key])) for key in ("parameters", "receipt")] == [["unfilled"]] * 2
        told = infos["_parameters"]
        for name, values in infos["receipt"]["applied"].items():
            if not name.startswith("_") and name in infos["parameters"]:
                np.testing.assert_allclose(values[told], infos["parameters"][name][told], rtol=1e-9)
                looked += int(told.sum())
        assert infos["context_id"][told].tolist() == infos["receipt"]["trial_index"][told].tolist()
    assert looked > 0
    envs.close()
