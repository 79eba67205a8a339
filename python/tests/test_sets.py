"""Sets of parameters, and environments whose contexts come from a list."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import perturb

from .conftest import identifier
from .test_assess import evaluated, saved
from .test_policy import PENDULUM

TABLES = """
environments = ["CartPole"]
test_versions = ["D", "long", "corners", "measured"]
[sets.long]
version = "R"
length = "0.7..0.8,0.9..1"
mass = 0.1
[sets.corners]
length = "0.1..1.0/4"
mass = "0.1,0.2"
[sets.measured]
file = "measured.csv"
[[algorithm]]
name = "ppo"
architectures = ["ff"]
"""


def test_sets_of_experiment_files_equal_sets_made_in_python(tmp_path: Path) -> None:
    (tmp_path / "measured.csv").write_text("length,mass\n0.3,0.1\n0.5,0.2\n")
    (tmp_path / "plan.toml").write_text(TABLES)
    sets = perturb.sets.read(tmp_path / "plan.toml")
    assert list(sets) == ["corners", "long", "measured"]
    assert sets["long"] == perturb.sets.drawn("long", {"length": [(0.7, 0.8), (0.9, 1)], "mass": 0.1}, base="R")
    assert sets["long"] == perturb.sets.drawn("long", {"length": "0.7..0.8,0.9..1", "mass": "0.1"}, base="R")
    corners = perturb.sets.grid("corners", {"length": "0.1..1.0/4", "mass": [0.1, 0.2]})
    assert sets["corners"] == corners
    assert corners.contexts is not None
    assert [context["length"] for context in corners.contexts[:4]] == pytest.approx([0.1, 0.4, 0.7, 1.0], rel=1e-15)
    assert [context["mass"] for context in corners.contexts] == [0.1] * 4 + [0.2] * 4
    measured = [{"length": 0.3, "mass": 0.1}, {"length": 0.5, "mass": 0.2}]
    assert sets["measured"] == perturb.sets.listed("measured", measured)
    assert sets["measured"] == perturb.sets.read_csv("measured", tmp_path / "measured.csv")
    assert perturb.sets.grid("one", {"length": 0.5}).contexts == ({"length": 0.5},)


def test_python_and_program_record_the_same_episodes_on_a_grid(tmp_path: Path, server: str) -> None:
    own = ["--parameters", "length=0.8..1.2/3", "mass=1"]
    evaluated(PENDULUM, tmp_path / "records", server, "--episodes", "20", *own)
    points = perturb.sets.grid("parameters", {"length": "0.8..1.2/3", "mass": 1})
    assessment = perturb.evaluate(
        perturb.load_policy(PENDULUM), "Pendulum", versions=[points], episodes=20, server=server
    )
    assert saved(assessment, tmp_path / "saved") == (tmp_path / "records").read_bytes()
    assert assessment.results[0].episodes == 21, "rounded up to a multiple of the three contexts"


def test_sampled_contexts_are_prefixes_of_larger_samples() -> None:
    few, many = (perturb.sets.sampled("train", "CartPole", count, version="E", seed=3) for count in (5, 400))
    assert few.contexts is not None
    assert many.contexts is not None
    assert few.contexts == many.contexts[:5]
    assert few != perturb.sets.sampled("train", "CartPole", 5, version="E", seed=4)
    for parameter in perturb.environments()["CartPole"].parameters.values():
        values = np.array([context[parameter.name] for context in many.contexts])
        within = [(values >= low) & (values <= high) for low, high in parameter.extreme]
        assert np.logical_or.reduce(within).all()
        widths = np.array([high - low for low, high in parameter.extreme])
        # A share of 400 draws has a standard error of 0.025. The tolerance is five standard errors.
        assert within[0].mean() == pytest.approx(widths[0] / widths.sum(), abs=0.125)
        for inside, (low, high) in zip(within, parameter.extreme, strict=True):
            # The mean of 100 or more uniform numbers has a standard error of at most 0.03 of the interval's width. The
            # tolerance is five standard errors.
            assert values[inside].mean() == pytest.approx((low + high) / 2, abs=0.15 * (high - low))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: perturb.sets.drawn("D", {"length": 1}), "expected letters"),
        (lambda: perturb.sets.drawn("r", {"length": 1}), "expected letters"),
        (lambda: perturb.sets.drawn("a b", {"length": 1}), "expected letters"),
        (lambda: perturb.sets.drawn("a", {}), "names no parameter"),
        (lambda: perturb.sets.drawn("a", [1]), "expected a dict"),  # type: ignore[arg-type]
        (lambda: perturb.sets.drawn("a", {"length": (2, 1)}), "length"),
        (lambda: perturb.sets.drawn("a", {"length": "1..2/3"}), "perturb.sets.grid"),
        (lambda: perturb.sets.drawn("a", {"length": 1}, base="x"), "base='x'"),  # type: ignore[arg-type]
        (lambda: perturb.sets.grid("a", {"length": "1..2"}), "expected points"),
        (lambda: perturb.sets.grid("a", {"length": []}), "expected a number, several"),
        (lambda: perturb.sets.grid("a", {"length": (0.1, 0.2)}), "which may be an interval or two points"),
        (lambda: perturb.sets.grid("a", {"length": "1,2"}), "may be one number or two"),
        (lambda: perturb.sets.drawn("a", {"length": [0.1, 0.2]}), "may be an interval or two values"),  # type: ignore[list-item]
        (lambda: perturb.sets.drawn("a", {"length": "0,1..0,2"}), "a decimal point in each number"),
        (lambda: perturb.sets.grid("a", {"length": "1..2/200", "mass": "1..2/200"}), "at most 16384"),
        (lambda: perturb.sets.listed("a", []), "at least one"),
        (lambda: perturb.sets.listed("a", [{"length": float("nan")}]), "finite"),
        (lambda: perturb.sets.sampled("a", "CartPole", 3, version="D"), "'R' or 'E'"),
        (lambda: perturb.sets.sampled("a", "CartPole", 3, version="x"), "version='x'"),  # type: ignore[arg-type]
        (lambda: perturb.sets.sampled("a", "CartPole", 0), "count=0"),
        (lambda: perturb.sets.sampled("a", "CartPole", 10**9), "from 1 to 16384"),
        (lambda: perturb.sets.heatmap("CartPole", points=10**9), "from 2 to 100"),
        (lambda: perturb.sets.sampled("a", "CartPol", 3), "did you mean 'CartPole'"),
        (lambda: perturb.sets.read("/nowhere.toml"), "nowhere"),
    ],
)
def test_invalid_sets_are_refused(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(perturb.InvalidArgumentError, match=words):
        make()


def test_several_spellings_of_names_are_accepted() -> None:
    expected = perturb.sets.sampled("a", "CartPole", 3, version="R")
    assert perturb.sets.sampled("a", "cart-pole", 3, version="r") == expected  # type: ignore[arg-type]
    assert perturb.sets.sampled("a", identifier("CartPole"), 3) == expected


LENGTHS = ({"length": 0.3}, {"length": 0.6}, {"length": 0.9})


def lengths(infos: dict[str, Any]) -> list[float]:
    return infos["parameters"]["length"].tolist()  # type: ignore[no-any-return]


def test_each_environment_keeps_its_context(server: str) -> None:
    envs = gymnasium.make_vec(
        identifier("CartPole"), num_envs=7, contexts=LENGTHS, version="R", autoreset_mode="SameStep", server=server
    )
    _, infos = envs.reset(seed=1)
    expected = [0.3, 0.6, 0.9, 0.3, 0.6, 0.9, 0.3]
    assert lengths(infos) == expected
    masses = infos["parameters"]["mass"].tolist()
    assert len(set(masses)) == 7, "the contexts do not contain the mass, so it is drawn from R"
    begun = np.zeros(7, int)
    for _ in range(200):
        *_, infos = envs.step(np.zeros(7, np.int64))
        if "parameters" in infos:
            began = infos["_parameters"]
            begun += began
            assert np.array(lengths(infos))[began].tolist() == np.array(expected)[began].tolist()
    assert (begun > 3).all()
    _, infos = envs.reset()
    assert lengths(infos) == expected
    _, infos = envs.reset(options={"parameters": {"length": 0.5}})
    assert lengths(infos) == [0.5] * 7
    envs.close()


def test_a_context_and_the_same_parameters_give_equal_episodes(server: str) -> None:
    batch = perturb.PerturbVectorEnv("CartPole", 3, contexts=LENGTHS, autoreset_mode="SameStep", server=server)
    for seeds in (5, None):
        rows, _ = batch.reset(seed=seeds)
    rows, _ = batch.reset(seed=5)
    single = perturb.PerturbEnv("CartPole", parameters={"length": 0.6}, environment_index=1, server=server)
    row, _ = single.reset(seed=6)
    ended = False
    while not ended:
        np.testing.assert_array_equal(rows[1], row)
        rows, *_ = batch.step(np.ones(3, np.int64))
        row, _, terminated, truncated, _ = single.step(1)
        ended = terminated or truncated
    batch.close()
    single.close()


def test_a_new_session_keeps_the_contexts(start_server: Any) -> None:
    first = start_server()
    batch = perturb.PerturbVectorEnv("CartPole", 3, contexts=LENGTHS, server=first.address)
    _, infos = batch.reset(seed=1)
    first.process.kill()
    first.process.wait()
    with pytest.raises(perturb.ServerConnectionError):
        batch.step(np.zeros(3, np.int64))
    second = start_server(listen=first.address)
    _, again = batch.reset(seed=1)
    assert lengths(again) == lengths(infos) == [0.3, 0.6, 0.9]
    batch.reset(options={"parameters": {"length": 0.5}})
    second.process.kill()
    second.process.wait()
    with pytest.raises(perturb.ServerConnectionError):
        batch.step(np.zeros(3, np.int64))
    start_server(listen=first.address)
    _, again = batch.reset(seed=1)
    assert lengths(again) == [0.5] * 3, "the parameters of the reset replace the contexts"
    batch.close()


def test_environments_accept_a_set_as_contexts(server: str) -> None:
    grid = perturb.sets.grid("corners", {"length": [0.3, 0.9]}, base="R")
    batch = perturb.PerturbVectorEnv("CartPole", 4, contexts=grid, version="R", server=server)
    _, infos = batch.reset(seed=1)
    assert lengths(infos) == [0.3, 0.9, 0.3, 0.9]
    batch.close()
    perturb.PerturbVectorEnv("CartPole", 4, contexts=grid, version="r", server=server).close()  # type: ignore[arg-type]
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"contexts": grid}, "the environments take them from version='D'"),
        ({"contexts": grid, "version": "R", "parameters": {"mass": 0.1}}, "no parameters"),
        ({"contexts": perturb.sets.drawn("narrow", {"length": (0.3, 0.4)})}, "has no contexts"),
        ({"contexts": LENGTHS, "num_envs": 2}, "3 contexts need at least 3 environments; num_envs is 2"),
        ({"contexts": []}, "at least one"),
        ({"contexts": [{"length": (0.1, 0.2)}]}, "has intervals"),
        ({"contexts": {"length": 0.1}}, "expected a list"),
    ]
    for settings, words in wrong:
        arguments: dict[str, Any] = {"num_envs": 4, "server": server, **settings}
        with pytest.raises(perturb.InvalidArgumentError, match=words):
            perturb.PerturbVectorEnv("CartPole", **arguments)


def test_environments_for_stable_baselines3_accept_contexts(server: str) -> None:
    pytest.importorskip("stable_baselines3")
    import perturb.sb3

    envs = perturb.sb3.make_vec_env("CartPole", 3, contexts=LENGTHS, receipts=True, seed=1, server=server)
    envs.reset()
    assert [info["parameters"]["length"] for info in envs.reset_infos] == [0.3, 0.6, 0.9]
    envs.close()
