"""`perturb.evaluate` tests policies of all kinds on the same episodes as the command `perturb evaluate`."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import perturb
from perturb import _native

from .conftest import ROOT
from .test_policy import CART_POLE, PENDULUM, POLICIES

# Environment variable with the path of the program perturb.
VARIABLE = "PERTURB_PROGRAM"


def evaluated(checkpoint: Path, records: Path, server: str, *arguments: str) -> None:
    """Run `perturb evaluate`. Skip the test if the program is missing."""
    run("evaluate", "--checkpoint", str(checkpoint), "--records", str(records), "--server", server, *arguments)


def run(*arguments: str, status: int = 0) -> str:
    program = os.environ.get(VARIABLE) or shutil.which(ROOT / "target/release/perturb") or shutil.which("perturb")
    if program is None:
        pytest.skip(f"the program perturb is neither built nor on PATH, and {VARIABLE} is not set")
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run([program, *arguments], capture_output=True, text=True, check=False, env=environment)
    assert ended.returncode == status, ended.stderr
    return ended.stdout + ended.stderr


def saved(assessment: perturb.Assessment, folder: Path) -> bytes:
    assessment.save(folder)
    files = list(folder.glob("episodes*.parquet"))
    assert len(files) == 1
    return files[0].read_bytes()


def test_saved_assessments_are_listed(server: str, tmp_path: Path) -> None:
    def push_left(observations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.zeros(len(observations), np.int64)

    assessment = perturb.evaluate(push_left, "CartPole", episodes=10, seed=1, name="left", server=server)
    assessment.save(tmp_path / "study" / "saved")
    (listed,) = json.loads(run("ls", "--json", "-", str(tmp_path)))
    assert listed["path"].endswith("study/saved")
    assert (listed["what"], listed["done"], listed["unit"]) == ("CartPole left", 30, "episodes")
    assert (listed["success_percent"], listed["state"]) == (0.0, "assessed")


@pytest.mark.parametrize("cell", ["CartPole-ppo-ff-D-9bd6546b-s7", "Pendulum-ppo-ff-R-9bd6546b-s8"])
def test_shipped_policies_reproduce_the_published_episodes(cell: str, server: str) -> None:
    """The 3000 test episodes of a shipped policy have the checksums in the results table."""
    pytest.importorskip("pandas")
    policy = perturb.load_policy(POLICIES / f"{cell}.safetensors")
    assessment = perturb.evaluate(policy, policy.environment, success="code", server=server)
    rows = perturb.read_results(ROOT / "results/results.parquet")
    rows = rows[(rows.cell == cell) & (rows.study == "beyond/confirm-2")]
    assert dict(zip(rows.tested_on, rows.checksum, strict=True)) == checksums(assessment.columns())


def checksums(columns: dict[str, Any]) -> dict[str, str]:
    """Return the checksum of each test's episodes, computed as docs/results-table.md describes."""
    hashes: dict[str, Any] = {}
    parameters = [name for name in columns if name.startswith(("requested_", "applied_"))]
    for row in range(len(columns["seed"])):
        digest = hashes.setdefault(columns["set"][row], hashlib.sha256())
        address = (columns[name][row] for name in ("seed", "environment_index", "episode_index"))
        digest.update(struct.pack("<QIQ", *map(int, address)))
        digest.update(struct.pack(f"<{len(parameters)}d", *(columns[name][row] for name in parameters)))
        digest.update(columns["model_hash"][row].encode())
        ending = ["terminated", "truncated", "diverged"].index(columns["ending"][row])
        digest.update(
            struct.pack("<dI?B", columns["return"][row], columns["length"][row], columns["success"][row], ending)
        )
        for name in ("achieved", "also_achieved"):
            value = columns.get(name, {row: math.nan})[row]
            digest.update(b"\0" if math.isnan(value) else struct.pack("<?d", True, value))
    return {name: digest.hexdigest() for name, digest in hashes.items()}


@pytest.mark.parametrize("checkpoint", [CART_POLE, PENDULUM])
def test_python_and_the_program_give_the_same_records(checkpoint: Path, tmp_path: Path, server: str) -> None:
    evaluated(checkpoint, tmp_path / "records", server, "--episodes", "250", "--seed", "77", "--versions", "D,E,R+E")
    policy = perturb.load_policy(checkpoint)
    assessment = perturb.evaluate(
        policy, policy.environment, versions=("R+E", "D", "E"), episodes=250, seed=77, server=server
    )
    assert saved(assessment, tmp_path / "saved") == (tmp_path / "records").read_bytes()


@pytest.mark.parametrize(
    ("environment", "settings"),
    [
        ("CartPole", ["--algorithm", "a2c", "--architecture", "rc"]),
        ("Pendulum", ["--algorithm", "ppo", "--architecture", "rc", "--observe", "parameters"]),
        ("CartPole", ["--algorithm", "rl2-ppo", "--episodes-per-trial", "2"]),
        ("Pendulum", ["--algorithm", "random"]),
    ],
    ids=["rc", "rc-continuous-sees-parameters", "rl2", "random"],
)
def test_python_and_program_agree_on_recurrent_and_random_policy(
    environment: str, settings: list[str], tmp_path: Path, server: str
) -> None:
    out = tmp_path / "run"
    run("train", "--env", environment, *settings, "--episodes", "20", "--server", server, "--out", str(out))
    evaluated(out, tmp_path / "records", server, "--episodes", "30", "--seed", "5")
    assessment = perturb.evaluate(perturb.load_policy(out), environment, episodes=30, seed=5, server=server)
    assert saved(assessment, tmp_path / "saved") == (tmp_path / "records").read_bytes()


def test_python_and_the_program_agree_on_custom_sets_and_rules(tmp_path: Path, server: str) -> None:
    own = ["--parameters", "length=0.3..0.4,0.8..0.9", "mass=0.1", "--base-version", "E", "--success", "steps=90"]
    evaluated(CART_POLE, tmp_path / "records", server, "--episodes", "20", *own)
    policy = perturb.load_policy(CART_POLE)
    assessment = perturb.evaluate(
        policy,
        "CartPole",
        parameters={"length": [(0.3, 0.4), (0.8, 0.9)], "mass": 0.1},
        base="E",
        episodes=20,
        success="steps=90",
        server=server,
    )
    assert saved(assessment, tmp_path / "saved") == (tmp_path / "records").read_bytes()
    assert assessment["D on parameters"].episodes == 20

    (tmp_path / "contexts.csv").write_text("length,mass\n0.3,0.1\n0.5,0.2\n0.9,0.3\n")
    evaluated(CART_POLE, tmp_path / "records", server, "--episodes", "30", "--contexts", str(tmp_path / "contexts.csv"))
    contexts = [{"length": 0.3, "mass": 0.1}, {"length": 0.5, "mass": 0.2}, {"length": 0.9, "mass": 0.3}]
    assessment = perturb.evaluate(policy, "CartPole", contexts=contexts, episodes=30, server=server)
    assert saved(assessment, tmp_path / "listed") == (tmp_path / "records").read_bytes()


def upright(observations: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Push in the direction in which the pole falls. This policy is good on D, and worse on E."""
    pushed: np.ndarray[Any, Any] = (observations[:, 2] + observations[:, 3] > 0).astype(np.int64)
    observations[:] = np.nan  # a policy may overwrite its observations
    return pushed


def same_episodes(a: perturb.Assessment, b: perturb.Assessment) -> None:
    ours, theirs = a.columns(), b.columns()
    assert list(ours) == list(theirs)
    for name, column in ours.items():
        np.testing.assert_array_equal(column, theirs[name], err_msg=name)


def test_function_plays_same_episodes_as_checkpoint(server: str) -> None:
    policy = perturb.load_policy(CART_POLE)
    of_policy = perturb.evaluate(policy, "CartPole", episodes=120, seed=3, server=server).columns()
    assessment = perturb.evaluate(upright, "CartPole", episodes=120, seed=3, server=server)
    of_function = assessment.columns()
    assert list(of_function) == list(of_policy)
    for name in ("set", "seed", "environment_index", "episode_index", "requested_length", "applied_mass"):
        np.testing.assert_array_equal(of_function[name], of_policy[name])
    assert (of_function["length"] != of_policy["length"]).any()
    assert [result.tested_on for result in assessment.results] == ["D", "R", "E"]
    assert assessment["R"].policy == "function upright"


def test_a_function_with_memory_is_told_where_episodes_begin(server: str) -> None:
    """The function counts the steps of each episode, and all recorded lengths are among its counts."""
    lengths: list[int] = []

    def counts(observations: Any, memory: Any, starts: Any) -> tuple[Any, Any]:
        if memory is None:
            memory = np.zeros(len(observations), np.int64)
            assert starts.all()
        lengths.extend(memory[starts].tolist())
        return np.zeros(len(observations), np.int64), np.where(starts, 1, memory + 1)

    assessment = perturb.evaluate(counts, "CartPole", versions=("R",), episodes=300, seed=3, server=server)
    recorded = assessment.columns()["length"].tolist()
    assert set(recorded) <= set(lengths)
    assert len(set(recorded)) > 2
    again = perturb.evaluate(
        lambda observations: np.zeros(len(observations), np.int64),
        "CartPole",
        versions=("R",),
        episodes=300,
        seed=3,
        server=server,
    )
    same_episodes(assessment, again)


def test_random_functions_are_seeded_and_numpy_state_is_restored(server: str) -> None:
    def guesses(observations: Any) -> Any:
        return np.random.randint(2, size=len(observations))

    np.random.seed(1)
    expected = np.random.random(2)
    np.random.seed(1)
    first = np.random.random()
    one = perturb.evaluate(guesses, "CartPole", versions=("D",), episodes=50, server=server)
    assert [first, np.random.random()] == expected.tolist()
    same_episodes(one, perturb.evaluate(guesses, "CartPole", versions=("D",), episodes=50, server=server))
    other = perturb.evaluate(guesses, "CartPole", versions=("D",), episodes=50, seed=2, server=server)
    assert (one.columns()["length"] != other.columns()["length"]).any()


def test_policies_trained_on_three_versions_give_nine_scenarios(server: str) -> None:
    trained = {
        "R": perturb.load_policy(POLICIES / "CartPole-ppo-ff-R-9bd6546b-s7.safetensors"),
        "D": perturb.load_policy(CART_POLE),
        "E": upright,
    }
    assessment = perturb.evaluate(trained, "CartPole", episodes=100, seed=1, server=server)
    names = [result.scenario for result in assessment.results]
    assert names == ["DD", "DR", "DE", "RD", "RR", "RE", "ED", "ER", "EE"]
    rate = {name: assessment[name].success_percent for name in names}
    extrapolation = (rate["DR"] * rate["DE"] * rate["RE"]) ** (1 / 3)
    metrics = assessment.metrics
    assert (metrics["Default"], metrics["Interpolation"]) == (rate["DD"], rate["RR"])
    assert metrics["Extrapolation"] == pytest.approx(extrapolation, rel=1e-12)  # the root is computed with exp and log
    assert set(assessment.columns()["trained_on"]) == {"D", "R", "E"}
    text = str(assessment)
    assert "paper: ppo ff" in text
    assert "86.2 ± 12.6" in text, "the paper's Extrapolation of PPO FF"
    assert assessment._repr_html_().count("<tr>") == 10 + 2 + 14


def test_one_policy_has_the_metrics_of_its_training_version(server: str) -> None:
    assessment = perturb.evaluate(perturb.load_policy(CART_POLE), "CartPole", episodes=50, server=server)
    default = assessment["DD"].success_percent
    assert assessment.metrics == {"Default": default, "Interpolation": None, "Extrapolation": None}
    unknown = perturb.evaluate(upright, "CartPole", episodes=10, server=server)
    assert set(unknown.metrics.values()) == {None}
    assert "paper" not in str(unknown)
    named = perturb.evaluate(upright, "CartPole", episodes=10, trained_on="R", server=server)
    assert named.metrics["Interpolation"] == named["RR"].success_percent


def test_results_are_computed_from_the_recorded_episodes(server: str) -> None:
    assessment = perturb.evaluate(upright, "CartPole", versions=("E",), episodes=1000, server=server)
    result, columns = assessment["E"], assessment.columns()
    n, successes = result.episodes, int(columns["success"].sum())
    assert (n, result.success_percent) == (1000, 100 * successes / 1000)
    assert 0 < successes < n, "a policy that sometimes fails"
    z, share = 1.959963984540054, successes / n
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    # The tolerance allows for another order of the same operations.
    assert result.success_interval == pytest.approx((100 * (middle - half), 100 * (middle + half)), rel=1e-9)
    returns = np.sort(columns["return"])
    assert result.cvar_return == pytest.approx(returns[:100].mean(), rel=1e-12)
    assert result.mean_length == columns["length"].mean()
    assert result.worst_contexts_percent is not None
    assert result.worst_contexts_percent < result.success_percent

    parts = assessment.success_by_parameter("E", "length")
    assert sum(part.episodes for part in parts) == n
    assert sum(part.successes for part in parts) == successes
    lengths = columns["requested_length"]
    for part in parts:
        last = part.high == max(it.high for it in parts)
        within = (lengths >= part.low) & ((lengths <= part.high) if last else (lengths < part.high))
        if part.high not in {it.low for it in parts}:  # without an adjacent bin, the upper edge belongs to this bin
            within |= lengths == part.high
        assert part.episodes == within.sum()
        assert part.successes == columns["success"][within].sum()
    assert (
        perturb.evaluate(upright, "CartPole", versions=("D",), episodes=5, server=server).success_by_parameter(
            "D", "length"
        )
        == ()
    )
    with pytest.raises(perturb.InvalidArgumentError, match="no parameter 'size'; expected one of force, length, mass"):
        assessment.success_by_parameter("E", "size")
    with pytest.raises(perturb.UnknownNameError, match="no scenario 'DE'; there are E"):
        assessment["DE"]


def test_a_loaded_assessment_equals_the_saved_one(tmp_path: Path, server: str) -> None:
    trained = {"D": perturb.load_policy(CART_POLE), "E": upright}
    assessment = perturb.evaluate(trained, "CartPole", episodes=20, server=server)
    assessment.save(tmp_path / "saved")
    loaded = perturb.Assessment.load(tmp_path / "saved")
    assert loaded.agent == assessment.agent == "ppo ff, function upright"
    assert loaded.results == assessment.results
    assert str(loaded) == str(assessment)
    same_episodes(loaded, assessment)
    with pytest.raises(perturb.InvalidArgumentError, match="overwrite=True replaces it"):
        assessment.save(tmp_path / "saved")
    one = perturb.evaluate(upright, "CartPole", episodes=10, server=server)
    one.save(tmp_path / "saved", overwrite=True)
    assert sorted(path.name for path in (tmp_path / "saved").iterdir()) == ["assessment.json", "episodes.parquet"]
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").touch()
    for overwrite in (False, True):
        with pytest.raises(perturb.InvalidArgumentError, match="is not empty; name another folder"):
            one.save(tmp_path / "other", overwrite=overwrite)


def test_folders_without_a_readable_assessment_are_refused(tmp_path: Path, server: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match="holds no assessment"):
        perturb.Assessment.load(tmp_path)
    perturb.evaluate(upright, "CartPole", episodes=10, server=server).save(tmp_path)
    (tmp_path / "episodes.parquet").write_bytes(b"PAR1")
    with pytest.raises(perturb.InvalidArgumentError, match="does not contain recorded episodes"):
        perturb.Assessment.load(tmp_path)
    (tmp_path / "episodes.parquet").unlink()
    with pytest.raises(perturb.InvalidArgumentError, match="no recorded episodes in"):
        perturb.Assessment.load(tmp_path)
    for document, words in [
        ("{", "is damaged"),
        ('{"format_version": 2, "policies": []}', "has format 2; this program reads 1"),
        ('{"format_version": 1, "environment": "CartPole", "agent": "PPO", "policies": []}', "there is none"),
        ('{"format_version": 1, "policies": []}', "is damaged: missing field"),
    ]:
        (tmp_path / "assessment.json").write_text(document)
        with pytest.raises(perturb.InvalidArgumentError, match=words):
            perturb.Assessment.load(tmp_path)


def test_to_pandas_has_every_episode_and_needs_pandas(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assessment = perturb.evaluate(upright, "CartPole", episodes=10, server=server)
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "pandas", None)
        with pytest.raises(ImportError, match="pip install pandas"):
            assessment.to_pandas()
    pytest.importorskip("pandas")
    frame = assessment.to_pandas()
    assert frame.shape[0] == 30
    assert frame.groupby("set")["success"].mean()["D"] * 100 == assessment["D"].success_percent


class NoPolicy:
    pass


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"policy": NoPolicy()}, perturb.PolicyError, "expected a policy of load_policy"),
        ({"policy": lambda: 0}, perturb.PolicyError, "requires no arguments; expected actions = f"),
        ({"policy": lambda _a, _b: 0}, perturb.PolicyError, "requires the arguments _a, _b; expected actions = f"),
        ({"policy": lambda _a, _b, _c: 0}, perturb.PolicyError, "gave int; expected a pair"),
        ({"policy": lambda _: np.zeros(3, int)}, perturb.InvalidArgumentError, r"shape \(3,\); expected \(5,\)"),
        ({"policy": lambda _: np.zeros(5)}, perturb.InvalidArgumentError, "expected integers"),
        ({"policy": lambda _: np.full(5, 9)}, perturb.InvalidArgumentError, "9"),
        ({"policy": {}}, perturb.InvalidArgumentError, "empty mapping"),
        ({"policy": {"x": upright}}, perturb.InvalidArgumentError, "'x' is none of"),
        ({"policy": {"D": upright}, "trained_on": "D"}, perturb.InvalidArgumentError, "leave trained_on= out"),
        ({"environment": "Cart"}, perturb.InvalidArgumentError, "'Cart' is none of"),
        ({"versions": "DRE"}, perturb.InvalidArgumentError, "expected a list"),
        ({"versions": ["x"]}, perturb.InvalidArgumentError, "'x' is none of"),
        ({"versions": []}, perturb.InvalidArgumentError, "nothing to test on"),
        (
            {"versions": ["D", perturb.sets.listed("D_", [{"size": 1}])]},
            perturb.InvalidArgumentError,
            "`size`, but must",
        ),
        ({"episodes": 0}, perturb.InvalidArgumentError, "episodes=0"),
        ({"seed": -1}, perturb.InvalidArgumentError, "seed=-1"),
        ({"success": "soon"}, perturb.InvalidArgumentError, "QUANTITY=NUMBER"),
        ({"success": "distance=1"}, perturb.InvalidArgumentError, "a threshold for steps"),
        ({"parameters": {"size": 1}}, perturb.UnknownNameError, "no parameter .size."),
        ({"versions": ["D"], "parameters": {"size": 1}}, perturb.InvalidArgumentError, "`size`, but must be one of"),
        ({"parameters": {"length": 1e9}}, perturb.InvalidArgumentError, "within"),
        ({"parameters": {"length": (2, 1)}}, perturb.InvalidArgumentError, "length"),
        ({"contexts": []}, perturb.InvalidArgumentError, "no contexts"),
        ({"contexts": [{"length": (1, 2)}]}, perturb.InvalidArgumentError, "has intervals"),
        ({"deterministic": True}, perturb.PolicyError, "stable-baselines3's models"),
        ({"normalizer": 1}, perturb.PolicyError, "stable-baselines3's models"),
        ({"observe": "all"}, perturb.InvalidArgumentError, "observe='all'"),
    ],
)
def test_wrong_arguments_of_evaluate_are_refused(
    change: dict[str, Any], error: type[Exception], words: str, server: str
) -> None:
    settings = {"policy": upright, "environment": "CartPole", "episodes": 5, "server": server, **change}
    with pytest.raises(error, match=words):
        perturb.evaluate(**settings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"environment": "Pendulum"}, "trained in CartPole, not in Pendulum"),
        ({"trained_on": "R"}, "trained on D, not on R"),
        ({"observe": "parameters"}, "observes 'state', not 'parameters'"),
        ({"deterministic": True}, "samples its actions"),
        ({"name": "mine"}, "has its id for a name"),
    ],
)
def test_settings_that_contradict_a_loaded_policy_are_refused(change: dict[str, Any], words: str, server: str) -> None:
    settings = {"environment": "CartPole", "episodes": 1, "server": server, **change}
    with pytest.raises(perturb.PolicyError, match=words):
        perturb.evaluate(perturb.load_policy(CART_POLE), **settings)


def test_a_function_can_observe_parameters(server: str) -> None:
    seen: list[tuple[int, ...]] = []

    def looks(observations: Any) -> Any:
        seen.append(observations.shape)
        return np.zeros(len(observations), np.int64)

    perturb.evaluate(looks, "CartPole", versions=("R",), episodes=3, observe="parameters", server=server)
    assert set(seen) == {(3, 7)}


def test_without_an_address_a_private_server_is_used() -> None:
    assert perturb.evaluate(upright, "CartPole", versions=("D",), episodes=2)["D"].episodes == 2


def test_the_papers_results_are_available_for_all_environments() -> None:
    for name in perturb.environments():
        methods = _native.published(name)
        assert len(methods) == 14
        assert all(number is not None for _, numbers in methods for number in numbers)
