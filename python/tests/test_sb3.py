"""stable-baselines3's side: a VecEnv that trains as it is, and models that are assessed. Gigabytes of PyTorch: skipped
where they are not installed, as `make python-acceptance` does.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest

import perturb

if TYPE_CHECKING:
    from pathlib import Path

torch = pytest.importorskip("torch")
stable_baselines3 = pytest.importorskip("stable_baselines3")
from perturb.sb3 import PerturbVecEnv, make_vec_env  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("error")]


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def trained(server: str, steps: int, version: perturb.Version = "D", **settings: Any) -> Any:
    envs = make_vec_env("CartPole", 8, version=version, server=server, seed=1)
    model = stable_baselines3.PPO("MlpPolicy", envs, n_steps=128, seed=1, device="cpu", **settings).learn(steps)
    envs.close()
    return model


def test_ppo_trains_without_wrapper_or_warning(server: str) -> None:
    """Its default settings but for the rollout learn CartPole; returns come from the environments themselves."""
    model = trained(server, 40_000)
    returns = [episode["r"] for episode in model.ep_info_buffer]
    assert len(returns) == 100
    assert np.mean(returns) > 100


def test_a_step_has_what_stable_baselines3_expects(server: str) -> None:
    envs = make_vec_env("CartPole", 4, version="R", server=server, receipts=True)
    plain = perturb.PerturbVectorEnv("CartPole", 4, version="R", server=server, autoreset_mode="SameStep")
    envs.seed(7)
    observations, (expected, infos) = envs.reset(), plain.reset(seed=7)
    np.testing.assert_array_equal(observations, expected)
    assert [info["context_id"] for info in envs.reset_infos] == infos["context_id"].tolist()
    assert envs.reset_infos[2]["parameters"]["length"] == infos["parameters"]["length"][2]
    assert envs.reset_infos[2]["receipt"]["applied"]["mass"] == infos["receipt"]["applied"]["mass"][2]
    ends, returns, lengths = 0, np.zeros(4), np.zeros(4, int)
    rng = np.random.default_rng(1)
    truncations = 0
    for step in range(500):
        actions = rng.integers(2, size=4) if step < 250 else (observations[:, 2] + observations[:, 3] > 0).astype(int)
        observations, rewards, dones, told = envs.step(actions)
        expected, expected_rewards, terminated, truncated, infos = plain.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(dones, terminated | truncated)
        assert observations.flags.writeable
        returns, lengths = returns + rewards, lengths + 1
        for slot in range(4):
            if not dones[slot]:
                assert told[slot] == {}
                continue
            ends += 1
            info = told[slot]
            np.testing.assert_array_equal(info["terminal_observation"], infos["final_obs"][slot])
            assert info["TimeLimit.truncated"] == (truncated[slot] and not terminated[slot])
            truncations += info["TimeLimit.truncated"]
            assert info["episode"] == {"r": returns[slot], "l": lengths[slot]}
            assert info["is_success"] == infos["final_info"]["is_success"][slot]
            assert info["parameters"]["length"] == infos["final_info"]["parameters"]["length"][slot]
            assert isinstance(info["is_success"], bool)
            returns[slot] = lengths[slot] = 0
    assert ends > 20
    assert truncations > 0
    envs.close()
    plain.close()


def test_rewards_terms_are_told_on_request(server: str) -> None:
    envs = make_vec_env("Pendulum", 2, server=server, reward_terms=True, seed=1)
    envs.reset()
    _, rewards, _, infos = envs.step(np.zeros((2, 1), np.float32))
    for reward, info in zip(rewards, infos, strict=True):
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, rel=1e-5)  # rewards are float32
    envs.close()


def test_seeds_and_options_are_for_one_reset(server: str) -> None:
    envs = make_vec_env("CartPole", 3, version="R", server=server, receipts=True, seed=5)
    first = envs.reset()
    second = envs.reset()
    assert (first != second).any()
    envs.seed(5)
    np.testing.assert_array_equal(envs.reset(), first)
    envs.seed(5)
    envs.set_options({"parameters": {"length": 0.6}, "state": [0.1, 0, 0, 0]})
    observations = envs.reset()
    np.testing.assert_array_equal(observations, np.array([[0.1, 0, 0, 0]] * 3, np.float32))
    assert [info["parameters"]["length"] for info in envs.reset_infos] == [0.6] * 3
    envs.seed(5)
    envs.set_options([{}, {"parameters": {"length": 0.7}}, {"state": [0.2, 0, 0, 0]}])
    observations = envs.reset()
    assert [info["parameters"]["length"] for info in envs.reset_infos] == [0.6, 0.7, 0.6]
    np.testing.assert_array_equal(observations[2], np.array([0.2, 0, 0, 0], np.float32))
    np.testing.assert_array_equal(observations[:2], first[:2])
    envs.close()


def test_attributes_and_methods_are_those_of_each_environment(server: str) -> None:
    envs = make_vec_env("CartPole", 3, server=server, seed=1)
    assert isinstance(envs, PerturbVecEnv)
    envs.reset()
    assert envs.get_attr("observation_space", [0, 2]) == [envs.observation_space] * 2
    assert envs.get_attr("metadata")[0]["success"]["quantity"] == "steps"
    with pytest.raises(AttributeError, match="length"):
        envs.get_attr("length")
    with pytest.raises(AttributeError, match="set_options"):
        envs.set_attr("length", 1)
    (snapshot,) = envs.env_method("snapshot", indices=1)
    before = envs.step(np.ones(3, int))[0]
    (restored,) = envs.env_method("restore", snapshot, indices=[2])
    assert restored.shape == (4,)
    after = envs.step(np.ones(3, int))[0]
    np.testing.assert_array_equal(after[2], before[1])
    for method in ("step", "close", "render_all"):
        with pytest.raises(AttributeError, match="there are snapshot"):
            envs.env_method(method)
    envs.close()


def test_settings_that_would_break_it_are_refused(server: str) -> None:
    for settings in ({"autoreset_mode": "NextStep"}, {"copy": False}):
        given: dict[str, Any] = {**settings, "server": server}
        with pytest.raises(perturb.InvalidArgumentError, match=f"{next(iter(settings))}= is what"):
            make_vec_env("CartPole", **given)
    with pytest.raises(perturb.InvalidArgumentError, match="'x' is none of"):
        make_vec_env("CartPole", server=server, version="x")


def test_stable_baselines3s_own_evaluation_takes_it(server: str) -> None:
    from stable_baselines3.common.evaluation import evaluate_policy

    model = trained(server, 1024)
    envs = make_vec_env("CartPole", 4, server=server, seed=2)
    returns, lengths = evaluate_policy(model, envs, n_eval_episodes=8, return_episode_rewards=True)
    assert returns == [float(length) for length in lengths], "a step of CartPole pays 1"
    envs.close()


def test_a_model_is_assessed_to_the_same_bytes_again_after_it_was_saved(tmp_path: Path, server: str) -> None:
    models = {"D": trained(server, 4096), "R": trained(server, 4096, "R")}
    before = torch.rand(1), torch.get_rng_state()
    first = perturb.assess(models, "CartPole", episodes=200, seed=3, server=server)
    assert torch.equal(torch.get_rng_state(), before[1]), "the caller's random numbers go on"
    for name, model in models.items():
        model.save(tmp_path / name)
    loaded = {name: stable_baselines3.PPO.load(tmp_path / name, device="cpu") for name in models}
    again = perturb.assess(loaded, "CartPole", episodes=200, seed=3, server=server)
    first.save(tmp_path / "first")
    again.save(tmp_path / "again")
    for name in models:
        file = f"episodes-{name}.parquet"
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()
    assert [result.scenario for result in first.results] == ["DD", "DR", "DE", "RD", "RR", "RE"]
    assert first.metrics["Extrapolation"] is not None
    sampled = first["DD"].mean_return
    mode = perturb.assess(models["D"], "CartPole", episodes=200, seed=3, deterministic=True, server=server)
    assert mode["D"].mean_return > sampled, "what PPO takes for best is better than what it tries"
    assert mode["D"].policy.startswith("PPO ")


def test_a_models_vec_normalize_is_applied_and_left_alone(server: str) -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    envs = VecNormalize(make_vec_env("CartPole", 8, server=server, seed=1))
    model = stable_baselines3.PPO("MlpPolicy", envs, n_steps=128, seed=1, device="cpu").learn(8192)
    mean = envs.obs_rms.mean.copy()
    own = perturb.assess(model, "CartPole", versions=("D",), episodes=100, server=server)
    np.testing.assert_array_equal(envs.obs_rms.mean, mean)
    given = perturb.assess(model, "CartPole", versions=("D",), episodes=100, normalizer=envs, server=server)
    assert given.results == own.results
    envs.obs_rms.mean[:] += 1
    other = perturb.assess(model, "CartPole", versions=("D",), episodes=100, server=server)
    assert other["D"].mean_return != own["D"].mean_return
    assert other["D"].policy != own["D"].policy, "it acts otherwise"
    with pytest.raises(perturb.PolicyError, match="expected stable-baselines3's VecNormalize"):
        perturb.assess(model, "CartPole", normalizer=7, server=server)
    with pytest.raises(perturb.PolicyError, match="the model's observations are"):
        perturb.assess(model, "Pendulum", server=server)
    model.action_space = gymnasium.spaces.Discrete(3)
    with pytest.raises(perturb.PolicyError, match="the model's actions are"):
        perturb.assess(model, "CartPole", server=server)
    envs.close()


def test_a_recurrent_model_remembers(server: str) -> None:
    contrib = pytest.importorskip("sb3_contrib")
    envs = make_vec_env("CartPole", 4, server=server, seed=1)
    model = contrib.RecurrentPPO("MlpLstmPolicy", envs, n_steps=64, seed=1, device="cpu").learn(512)
    envs.close()
    assert "sb3_contrib" in sys.modules
    one = perturb.assess(model, "CartPole", versions=("D",), episodes=20, deterministic=True, server=server)
    seen: list[Any] = []

    def by_hand(observations: Any, memory: Any, starts: Any) -> Any:
        seen.append(starts.copy())
        return model.predict(observations, state=memory, episode_start=starts, deterministic=True)

    two = perturb.assess(by_hand, "CartPole", versions=("D",), episodes=20, server=server)
    np.testing.assert_array_equal(one.columns()["length"], two.columns()["length"])
    assert seen[0].all()
    assert not seen[1].any()
    forgets = perturb.assess(
        lambda observations: model.predict(observations, deterministic=True)[0],
        "CartPole",
        versions=("D",),
        episodes=20,
        server=server,
    )
    assert (forgets.columns()["length"] != one.columns()["length"]).any()


def test_a_torch_module_acts(server: str) -> None:
    torch.manual_seed(1)
    module = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Dropout(), torch.nn.Tanh(), torch.nn.Linear(8, 2))

    def by_hand(observations: Any) -> Any:
        module.eval()
        with torch.no_grad():
            return module(torch.from_numpy(observations)).argmax(1).numpy()

    one = perturb.assess(module, "CartPole", episodes=50, server=server)
    assert module.training, "it is left as it was"
    two = perturb.assess(by_hand, "CartPole", episodes=50, server=server)
    np.testing.assert_array_equal(one.columns()["length"], two.columns()["length"])
    assert one["D"].policy.startswith("Sequential ")
    with pytest.raises(perturb.PolicyError, match=r"gave the shape \(5, 3\); expected \(5, 2\)"):
        perturb.assess(torch.nn.Linear(4, 3), "CartPole", episodes=5, server=server)
    assert perturb.assess(torch.nn.Linear(3, 1), "Pendulum", episodes=5, server=server)["D"].episodes == 5
