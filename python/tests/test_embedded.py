"""The embedded server: what a private server does, in this process."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode

import perturb

STEPS = 60


def same(a: Any, b: Any) -> bool:
    """Whether two outcomes are equal to the last bit, with equal types."""
    return all(data_equivalence(one, other, exact=True) for one, other in zip(a, b, strict=True))


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_batch_is_a_private_servers_to_the_last_bit(mode: AutoresetMode) -> None:
    batches = [
        perturb.PerturbVectorEnv("CartPole", 5, version="R", server=server, autoreset_mode=mode, reward_terms=True)
        for server in (None, "embedded")
    ]
    assert same(*(batch.reset(seed=[3, None, 2, 1, 9]) for batch in batches))
    actions = np.random.default_rng(1).integers(2, size=(STEPS, 5))
    ended = np.zeros(5, np.bool_)
    for action in actions:
        if mode is AutoresetMode.DISABLED and ended.any():
            assert same(*(batch.reset(options={"reset_mask": ended}) for batch in batches))
        private, embedded = (batch.step(action) for batch in batches)
        assert same(private, embedded)
        ended = private[2] | private[3]
    assert same(*([batch.snapshot()] for batch in batches))
    for batch in batches:
        batch.close()


def test_single_environment_is_a_private_servers_to_the_last_bit() -> None:
    environments = [perturb.PerturbEnv("CartPole", version="E", server=server) for server in (None, "embedded")]
    for episode in range(3):
        assert same(*(one.reset(seed=7 if episode == 0 else None) for one in environments))
        for step in range(500):
            private, embedded = (one.step(step % 2) for one in environments)
            assert same(private, embedded)
            if private[2] or private[3]:
                break
    for one in environments:
        one.close()
