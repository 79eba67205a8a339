"""Models of stable-baselines3 train on the VecEnv of `perturb.sb3` without wrappers, and `perturb.evaluate` tests them.

The tests are skipped if stable-baselines3 or torch is not installed. `make python-acceptance` installs them.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import pytest

import perturb

from .conftest import ROOT

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
    """PPO with default settings, except for the rollout's length, learns CartPole without a Monitor wrapper."""
    model = trained(server, 40_000)
    returns = [episode["r"] for episode in model.ep_info_buffer]
    assert len(returns) == 100
    assert np.mean(returns) > 100


def test_a_step_returns_what_stable_baselines3_expects(server: str) -> None:
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
        observations, rewards, dones, slot_infos = envs.step(actions)
        expected, expected_rewards, terminated, truncated, infos = plain.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(dones, terminated | truncated)
        assert observations.flags.writeable
        returns, lengths = returns + rewards, lengths + 1
        for slot in range(4):
            if not dones[slot]:
                assert slot_infos[slot] == {}
                continue
            ends += 1
            info = slot_infos[slot]
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


def test_infos_have_reward_terms_on_request(server: str) -> None:
    envs = make_vec_env("Pendulum", 2, server=server, reward_terms=True, seed=1)
    envs.reset()
    _, rewards, _, infos = envs.step(np.zeros((2, 1), np.float32))
    for reward, info in zip(rewards, infos, strict=True):
        assert sum(info["reward_terms"].values()) == pytest.approx(reward, rel=1e-5)  # rewards are float32
    envs.close()


def test_seeds_and_options_are_passed_to_the_next_reset(server: str) -> None:
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


def test_get_attr_and_env_method_select_environments_by_index(server: str) -> None:
    envs = make_vec_env("CartPole", 3, server=server, seed=1)
    assert isinstance(envs, PerturbVecEnv)
    envs.reset()
    assert envs.get_attr("observation_space", [0, 2]) == [envs.observation_space] * 2
    assert envs.get_attr("metadata")[0]["success"]["quantity"] == "steps"
    assert envs.metadata["render_fps"] == 50, "VecVideoRecorder asks for it"
    with pytest.raises(AttributeError, match="length"):
        envs.get_attr("length")
    with pytest.raises(perturb.AssignmentError, match=r"'length' cannot be assigned.* call set_parameters"):
        envs.set_attr("length", 1)
    with pytest.raises(perturb.AssignmentError, match="'length' cannot be assigned"):
        envs.length = 1
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


def test_settings_that_stable_baselines3_needs_cannot_be_changed(server: str) -> None:
    for settings in ({"autoreset_mode": "NextStep"}, {"copy": False}):
        given: dict[str, Any] = {**settings, "server": server}
        with pytest.raises(perturb.InvalidArgumentError, match=f"{next(iter(settings))}= cannot be set here"):
            make_vec_env("CartPole", **given)
    with pytest.raises(perturb.InvalidArgumentError, match="'x' is none of"):
        make_vec_env("CartPole", server=server, version="x")


def test_sb3_evaluate_policy_accepts_the_environments(server: str) -> None:
    from stable_baselines3.common.evaluation import evaluate_policy

    model = trained(server, 1024)
    envs = make_vec_env("CartPole", 4, server=server, seed=2)
    returns, lengths = evaluate_policy(model, envs, n_eval_episodes=8, return_episode_rewards=True)
    assert returns == [float(length) for length in lengths], "the reward of each step of CartPole is 1"
    envs.close()


def test_evaluating_a_saved_model_gives_the_same_bytes(tmp_path: Path, server: str) -> None:
    models = {"D": trained(server, 4096), "R": trained(server, 4096, "R")}
    before = torch.rand(1), torch.get_rng_state()
    first = perturb.evaluate(models, "CartPole", episodes=200, seed=3, server=server)
    assert torch.equal(torch.get_rng_state(), before[1]), "evaluations do not change torch's random state"
    for name, model in models.items():
        model.save(tmp_path / name)
    loaded = {name: stable_baselines3.PPO.load(tmp_path / name, device="cpu") for name in models}
    again = perturb.evaluate(loaded, "CartPole", episodes=200, seed=3, server=server)
    first.save(tmp_path / "first")
    again.save(tmp_path / "again")
    for name in models:
        file = f"episodes-{name}.parquet"
        assert (tmp_path / "first" / file).read_bytes() == (tmp_path / "again" / file).read_bytes()
    assert [result.scenario for result in first.results] == ["DD", "DR", "DE", "RD", "RR", "RE"]
    assert first.metrics["Extrapolation"] is not None
    mode = first["DD"]
    assert mode.deterministic, "as in stable-baselines3's own evaluate_policy"
    assert "actions are the mode" in str(first)
    sampled = perturb.evaluate(models["D"], "CartPole", episodes=200, seed=3, deterministic=False, server=server)
    assert mode.mean_return > sampled["D"].mean_return, "the most probable actions are better than sampled ones"
    assert sampled["D"].policy.startswith("PPO ")
    assert "actions are sampled" in str(sampled)
    assert perturb.Assessment.load(tmp_path / "first")["DD"].deterministic


def test_evaluation_applies_vec_normalize_and_does_not_change_it(server: str) -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    envs = VecNormalize(make_vec_env("CartPole", 8, server=server, seed=1))
    model = stable_baselines3.PPO("MlpPolicy", envs, n_steps=128, seed=1, device="cpu").learn(8192)
    mean = envs.obs_rms.mean.copy()
    own = perturb.evaluate(model, "CartPole", versions=("D",), episodes=100, server=server)
    np.testing.assert_array_equal(envs.obs_rms.mean, mean)
    given = perturb.evaluate(model, "CartPole", versions=("D",), episodes=100, normalizer=envs, server=server)
    assert given.results == own.results
    envs.obs_rms.mean[:] += 1
    other = perturb.evaluate(model, "CartPole", versions=("D",), episodes=100, server=server)
    assert other["D"].mean_return != own["D"].mean_return
    assert other["D"].policy != own["D"].policy, "the name of a policy has a hash of its normaliser"
    with pytest.raises(perturb.PolicyError, match="expected stable-baselines3's VecNormalize"):
        perturb.evaluate(model, "CartPole", normalizer=7, server=server)
    with pytest.raises(perturb.PolicyError, match="the model's observations are"):
        perturb.evaluate(model, "Pendulum", server=server)
    model.action_space = gymnasium.spaces.Discrete(3)
    with pytest.raises(perturb.PolicyError, match="the model's actions are"):
        perturb.evaluate(model, "CartPole", server=server)
    envs.close()


def off_policy(kind: str, normalised: bool, server: str, num_envs: int = 4) -> Any:
    from stable_baselines3.common.vec_env import VecNormalize

    envs = make_vec_env("Pendulum" if kind == "SAC" else "CartPole", num_envs, version="R", server=server, seed=1)
    under: Any = VecNormalize(envs) if normalised else envs
    settings: dict[str, Any] = {"learning_starts": 10, "buffer_size": 1000, "seed": 1, "device": "cpu"}
    return getattr(stable_baselines3, kind)("MlpPolicy", under, **settings).learn(300)


@pytest.mark.parametrize("kind", ["PPO", "DQN", "SAC"])
def test_a_model_loaded_without_its_vec_normalize_is_refused(kind: str, server: str, tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    if kind == "PPO":
        envs = VecNormalize(make_vec_env("CartPole", 4, server=server, seed=1))
        model = stable_baselines3.PPO("MlpPolicy", envs, n_steps=64, seed=1, device="cpu").learn(512)
    else:
        model = off_policy(kind, True, server)
    name = "Pendulum" if kind == "SAC" else "CartPole"
    settings: dict[str, Any] = {"versions": ("D",), "episodes": 20, "server": server}
    own = perturb.evaluate(model, name, **settings)
    model.save(tmp_path / "model")
    model.get_vec_normalize_env().save(tmp_path / "normalize.pkl")
    loaded = getattr(stable_baselines3, kind).load(tmp_path / "model", device="cpu")
    with pytest.raises(perturb.PolicyError, match=r"was trained under a VecNormalize.*: give normalizer="):
        perturb.evaluate(loaded, name, **settings)
    for path in (tmp_path / "normalize.pkl", str(tmp_path / "normalize.pkl")):
        assert perturb.evaluate(loaded, name, normalizer=path, **settings).results == own.results
    assert perturb.evaluate(loaded, name, normalizer=False, **settings)["D"].policy != own["D"].policy
    for wrong, says in [
        (tmp_path / "nowhere.pkl", "cannot be read: No such file"),
        (tmp_path / "model.zip", "is not a saved VecNormalize"),
        (VecNormalize(make_vec_env("Acrobot", 2, server=server)), r"observations of the shape \(6,\)"),
    ]:
        with pytest.raises(perturb.PolicyError, match=says):
            perturb.evaluate(loaded, name, normalizer=wrong, **settings)


@pytest.mark.parametrize("kind", ["PPO", "DQN", "SAC"])
def test_a_loaded_model_without_vec_normalize_is_accepted(kind: str, server: str, tmp_path: Path) -> None:
    model = trained(server, 1024) if kind == "PPO" else off_policy(kind, False, server)
    name = "Pendulum" if kind == "SAC" else "CartPole"
    model.save(tmp_path / "model")
    loaded = getattr(stable_baselines3, kind).load(tmp_path / "model", device="cpu")
    settings: dict[str, Any] = {"versions": ("D",), "episodes": 10, "server": server}
    assert perturb.evaluate(loaded, name, **settings).results == perturb.evaluate(model, name, **settings).results


def test_model_is_refused_if_use_of_vec_normalize_is_unknown(server: str, tmp_path: Path) -> None:
    off_policy("SAC", False, server, 1).save(tmp_path / "model")
    loaded = stable_baselines3.SAC.load(tmp_path / "model", device="cpu")
    settings: dict[str, Any] = {"versions": ("D",), "episodes": 5, "server": server}
    with pytest.raises(perturb.PolicyError, match="it is not known whether it was trained under a VecNormalize"):
        perturb.evaluate(loaded, "Pendulum", **settings)
    assert perturb.evaluate(loaded, "Pendulum", normalizer=False, **settings)["D"].episodes == 5


def test_parameters_change_while_a_model_learns(server: str) -> None:
    from stable_baselines3.common.callbacks import ConvertCallback
    from stable_baselines3.common.vec_env import VecNormalize

    from perturb.sb3 import CurriculumCallback

    envs = make_vec_env("CartPole", 4, server=server, seed=1, receipts=True)
    seen: list[tuple[int, float]] = []

    def note(local: dict[str, Any], _: dict[str, Any]) -> bool:
        for info in local["infos"]:
            if "parameters" in info:
                seen.append((local["self"].num_timesteps, info["parameters"]["length"]))
        return True

    model = stable_baselines3.PPO("MlpPolicy", VecNormalize(envs), n_steps=64, seed=1, device="cpu")
    schedule: Any = {0: {"length": 0.3}, 1024: {"length": "0.8..0.9"}}
    model.learn(3072, callback=[CurriculumCallback(schedule), ConvertCallback(note)])
    assert {length for steps, length in seen if 500 < steps <= 1024} == {0.3}
    late = [length for steps, length in seen if steps > 2500]
    assert len(late) > 3
    assert all(0.8 <= length <= 0.9 for length in late)
    seen.clear()
    model.learn(
        512, callback=[CurriculumCallback(lambda steps: {"length": 0.5} if steps else None), ConvertCallback(note)]
    )
    assert 0.5 not in {length for steps, length in seen if steps < 256}
    with pytest.raises(perturb.UnknownNameError, match="lenght"):
        model.learn(64, callback=CurriculumCallback({0: {"lenght": 1.0}}))
    with pytest.raises(perturb.InvalidArgumentError, match="expected numbers of steps"):
        CurriculumCallback({-1: {"length": 1.0}})
    envs.close()


def test_env_method_changes_parameters_of_selected_environments(server: str) -> None:
    envs = make_vec_env("CartPole", 3, version="R", server=server, receipts=True, seed=1)
    envs.reset()
    assert envs.env_method("set_parameters", {"length": 0.7}, indices=[0, 2]) == [None, None]
    ended: dict[int, list[float]] = {slot: [] for slot in range(3)}
    for _ in range(60):
        for slot, info in enumerate(envs.step(np.zeros(3, int))[3]):
            if "parameters" in info:
                ended[slot].append(info["parameters"]["length"])
    for slot in range(3):
        assert ended[slot][0] != 0.7, "the running episode keeps its parameters"
        assert all((length == 0.7) == (slot != 1) for length in ended[slot][1:])
        assert len(ended[slot]) > 2
    envs.close()


def test_monitor_finds_achieved_at_the_end_of_an_episode(server: str) -> None:
    from stable_baselines3.common.monitor import Monitor

    env = Monitor(perturb.PerturbEnv("MountainCar", server=server), info_keywords=("achieved", "is_success"))
    env.reset(seed=1)
    ended = False
    while not ended:
        *_, terminated, truncated, info = env.step(1)
        ended = terminated or truncated
    assert np.isnan(info["episode"]["achieved"])


def test_a_recurrent_model_keeps_its_memory_in_evaluations(server: str) -> None:
    contrib = pytest.importorskip("sb3_contrib")
    envs = make_vec_env("CartPole", 4, server=server, seed=1)
    model = contrib.RecurrentPPO("MlpLstmPolicy", envs, n_steps=64, seed=1, device="cpu").learn(512)
    envs.close()
    assert "sb3_contrib" in sys.modules
    one = perturb.evaluate(model, "CartPole", versions=("D",), episodes=20, deterministic=True, server=server)
    seen: list[Any] = []

    def by_hand(observations: Any, memory: Any, starts: Any) -> Any:
        seen.append(starts.copy())
        return model.predict(observations, state=memory, episode_start=starts, deterministic=True)

    two = perturb.evaluate(by_hand, "CartPole", versions=("D",), episodes=20, server=server)
    np.testing.assert_array_equal(one.columns()["length"], two.columns()["length"])
    assert seen[0].all()
    assert not seen[1].any()
    forgets = perturb.evaluate(
        lambda observations: model.predict(observations, deterministic=True)[0],
        "CartPole",
        versions=("D",),
        episodes=20,
        server=server,
    )
    assert (forgets.columns()["length"] != one.columns()["length"]).any()


def test_a_torch_module_is_accepted_as_a_policy(server: str) -> None:
    torch.manual_seed(1)
    module = torch.nn.Sequential(torch.nn.Linear(4, 8), torch.nn.Dropout(), torch.nn.Tanh(), torch.nn.Linear(8, 2))

    def by_hand(observations: Any) -> Any:
        module.eval()
        with torch.no_grad():
            return module(torch.from_numpy(observations)).argmax(1).numpy()

    one = perturb.evaluate(module, "CartPole", episodes=50, server=server)
    assert module.training, "evaluations restore the module's training mode"
    two = perturb.evaluate(by_hand, "CartPole", episodes=50, server=server)
    np.testing.assert_array_equal(one.columns()["length"], two.columns()["length"])
    assert one["D"].policy.startswith("Sequential ")
    with pytest.raises(perturb.PolicyError, match=r"gave the shape \(5, 3\); expected \(5, 2\)"):
        perturb.evaluate(torch.nn.Linear(4, 3), "CartPole", episodes=5, server=server)
    assert perturb.evaluate(torch.nn.Linear(3, 1), "Pendulum", episodes=5, server=server)["D"].episodes == 5


def test_a_model_is_trained_and_tested_on_a_task_folder() -> None:
    arm = ROOT / "examples/tasks/my_arm"
    envs = make_vec_env(task=arm, num_envs=4, version="R", seed=1)
    model = stable_baselines3.PPO("MlpPolicy", envs, n_steps=64, seed=1, device="cpu").learn(1024)
    envs.close()
    tested = perturb.evaluate(model, task=arm, trained_on="R", episodes=20)
    assert (tested.environment, tested.results[0].episodes) == ("MyArm", 20)
    assert tested.audit(model, task=arm).different == ()
