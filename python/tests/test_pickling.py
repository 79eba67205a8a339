"""Policies and assessments can be pickled, and therefore be sent to other processes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import shutil
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import perturb

from .test_policy import CART_POLE

ROWS = np.linspace(-0.02, 0.02, 32, dtype=np.float32).reshape(8, 4)


def act(policy: perturb.Policy) -> list[int]:
    return [int(action) for action in policy.actor(len(ROWS), seed=3)(ROWS)]


def assessed(server: str) -> perturb.Assessment:
    return perturb.evaluate(perturb.load_policy(CART_POLE), "CartPole", episodes=20, versions=["D"], server=server)


def tables(assessment: perturb.Assessment) -> tuple[Any, ...]:
    return str(assessment), assessment.results, {name: it.tolist() for name, it in assessment.columns().items()}


@pytest.mark.parametrize("again", [copy.deepcopy, copy.copy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_pickled_policy_is_the_same(again: Any, tmp_path: Path) -> None:
    file = Path(shutil.copy(CART_POLE, tmp_path))
    policy = perturb.load_policy(file)
    file.unlink()  # on another machine the file does not exist
    other = again(policy)
    assert (other.id, repr(other)) == (policy.id, repr(policy))
    assert act(other) == act(policy)


def test_an_actor_can_be_pickled_only_before_its_first_action() -> None:
    actor = perturb.load_policy(CART_POLE).actor(8, seed=3)
    other = pickle.loads(pickle.dumps(actor))
    assert other(ROWS).tolist() == actor(ROWS).tolist()
    for send in (pickle.dumps, copy.deepcopy):
        with pytest.raises(perturb.PolicyError, match=r"send its policy, and make an actor there, policy\.actor\("):
            send(actor)
    actor.reset()
    assert pickle.loads(pickle.dumps(actor))(ROWS).tolist() == other.__class__(*actor.__reduce__()[1])(ROWS).tolist()


@pytest.mark.parametrize("again", [copy.deepcopy, copy.copy, lambda it: pickle.loads(pickle.dumps(it))])
def test_a_pickled_assessment_is_the_same(again: Any, server: str, tmp_path: Path) -> None:
    assessment = assessed(server)
    other = again(assessment)
    assert tables(other) == tables(assessment)
    other.save(tmp_path / "saved")
    assert tables(perturb.Assessment.load(tmp_path / "saved")) == tables(assessment)


@pytest.mark.parametrize("method", ["spawn", "fork", "forkserver"])
def test_processes_exchange_policies_and_assessments(method: str, server: str) -> None:
    policy = perturb.load_policy(CART_POLE)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context(method)) as executor:
        assert executor.submit(act, policy).result(60) == act(policy)
        assert tables(executor.submit(assessed, server).result(60)) == tables(assessed(server))
