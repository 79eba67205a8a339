"""The numbers of comparisons equal those that pandas computes from the recorded episodes."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import perturb

from .conftest import ROOT
from .test_assess import run, upright
from .test_policy import CART_POLE, POLICIES

if TYPE_CHECKING:
    from collections.abc import Callable

# The 97.5 % quantiles of Student's t with 2, 4 and 59 degrees of freedom (from tables, to 6 decimals).
T_2, T_4, T_59 = 4.302653, 2.776445, 2.000995


def noisy(share: float, seed: int) -> Callable[[Any], Any]:
    """Make a policy that pushes in the direction in which the pole falls, and in a share of the steps at random."""

    def act(observations: Any) -> Any:
        generator = np.random.default_rng([seed, int(abs(observations[:, 2].sum()) * 1e6)])
        random = generator.random(len(observations)) < share
        guess = generator.integers(2, size=len(observations))
        return np.where(random, guess, observations[:, 2] + observations[:, 3] > 0)

    act.__qualname__ = f"noisy_{share}_{seed}"
    return act


@pytest.fixture(scope="module")
def comparison(server: str) -> perturb.Comparison:
    """Return a comparison of two conditions with three seeds each."""
    conditions = {"plain": [noisy(0.55, s) for s in (1, 2, 3)], "careful": [noisy(0.3, s) for s in (4, 5, 6)]}
    return perturb.compare(conditions, "CartPole", versions=("R", "E"), episodes=60, seed=4, server=server)


def test_numbers_are_those_of_a_pandas_script(comparison: perturb.Comparison) -> None:
    pytest.importorskip("pandas")
    episodes = comparison.to_pandas("episodes")
    assert len(episodes) == 2 * 3 * 2 * 60
    episodes["percent"] = 100.0 * episodes["success"]
    address = ["environment_index", "episode_index"]
    for tested_on in ("R", "E"):
        frame = episodes[episodes["set"] == tested_on]
        by_seed = frame.groupby(["condition", "key"])["percent"].mean()
        for condition in ("plain", "careful"):
            it = comparison.mean(condition, tested_on)
            seeds = by_seed[condition]
            assert it.by_seed == pytest.approx(seeds.tolist(), rel=1e-12)
            assert it.mean == pytest.approx(seeds.mean(), rel=1e-12)
            half = T_2 * seeds.sem()
            ends = (max(0.0, it.mean - half), min(100.0, it.mean + half))
            assert it.seeds_interval == pytest.approx(ends, rel=1e-5)
            # Wilson's interval with the effective number of episodes.
            by_episode = frame[frame["condition"] == condition].groupby(address)["percent"].mean() / 100
            p, z = by_episode.mean(), 1.959963984540054
            n = p * (1 - p) / (by_episode.var(ddof=0) / len(by_episode))
            middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
            half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
            assert it.episodes_interval == pytest.approx((100 * (middle - half), 100 * (middle + half)), rel=1e-9)
            assert (it.seeds, it.episodes) == (3, 60)
        (difference,) = [it for it in comparison.differences if it.tested_on == tested_on]
        pairs = by_seed["careful"].to_numpy() - by_seed["plain"].to_numpy()
        assert difference.by_seed == pytest.approx(pairs.tolist(), rel=1e-12)
        half = T_2 * pairs.std(ddof=1) / math.sqrt(3)
        assert difference.seeds_interval == pytest.approx((pairs.mean() - half, pairs.mean() + half), rel=1e-5)
        t = pairs.mean() / (pairs.std(ddof=1) / math.sqrt(3))
        assert difference.p == pytest.approx(1 - abs(t) / math.sqrt(2 + t * t), rel=1e-9)  # for 2 degrees of freedom
        wide = frame.groupby([*address, "condition"])["percent"].mean().unstack()
        by_episode = wide["careful"] - wide["plain"]
        half = T_59 * by_episode.sem()
        expected = (by_episode.mean() - half, by_episode.mean() + half)
        assert difference.same_episodes
        assert difference.episodes_interval == pytest.approx(expected, rel=1e-5)
        wins = [float(x > y) + 0.5 * (x == y) for x in by_seed["careful"] for y in by_seed["plain"]]
        assert difference.improvement == pytest.approx(sum(wins) / 9, rel=1e-12)
    p = [it.p for it in comparison.differences]
    assert all(it is not None for it in p)
    small, large = sorted(it for it in p if it is not None)
    holm = {small: min(1.0, 2 * small), large: min(1.0, max(2 * small, large))}
    for found in comparison.differences:
        assert found.p is not None
        assert found.p_holm == pytest.approx(holm[found.p], rel=1e-12)


def test_all_conditions_play_the_same_episodes(comparison: perturb.Comparison) -> None:
    columns = comparison.columns()
    first = None
    for condition in ("plain", "careful"):
        for key in ("1", "2", "3"):
            own = (columns["condition"] == condition) & (columns["key"] == key)
            played = [columns[name][own].tolist() for name in ("set", "seed", "environment_index", "requested_length")]
            first = first or played
            assert played == first


def test_comparisons_are_shown_as_text_html_latex_and_csv(comparison: perturb.Comparison, tmp_path: Path) -> None:
    text = str(comparison)
    assert "careful − plain" in text
    assert f"{comparison.mean('careful', 'E').mean:.1f}" in text
    assert comparison.verdict in text
    assert "t intervals" in text
    page = comparison.to_html(tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text("utf-8") == page
    assert page.count("<tr>") == 1 + 4 + 1 + 2
    latex = comparison.to_latex()
    assert latex.startswith("\\begin{tabular}{llrrrrr}\n\\toprule\n")
    assert "95 \\% over seeds" in latex
    assert "careful $-$ plain" in comparison.to_latex("differences")
    written = comparison.to_csv(tmp_path / "means.csv")
    assert (tmp_path / "means.csv").read_text("utf-8") == written
    assert written.splitlines()[0].startswith("condition,tested_on,seeds,mean,seeds_low_95")
    assert len(comparison.to_csv(table="differences").splitlines()) == 3
    with pytest.raises(perturb.InvalidArgumentError, match="expected 'means', 'differences' or 'episodes'"):
        comparison.rows("others")  # type: ignore[arg-type]
    with pytest.raises(perturb.UnknownNameError, match="there are 'plain' on R"):
        comparison.mean("plain", "D")


def test_saved_assessments_are_compared_without_another_test(
    comparison: perturb.Comparison, tmp_path: Path, server: str
) -> None:
    saved: dict[str, list[Any]] = {"plain": [], "careful": []}
    for condition, policies in comparison.evaluations.items():
        for key, assessment in policies.items():
            assessment.save(tmp_path / condition / key)
            saved[condition].append(tmp_path / condition / key)
    again = perturb.compare(saved)
    assert (again.means, again.differences) == (comparison.means, comparison.differences)
    only = perturb.compare(saved, versions=("E",), score="return", baseline="plain")
    assert [it.tested_on for it in only.means] == ["E", "E"]
    # A policy without an assessment is tested in the episodes of the saved assessments.
    mixed = perturb.compare({"plain": saved["plain"][0], "upright": upright}, server=server)
    assert mixed.differences[0].same_episodes
    assert mixed.mean("plain", "E").by_seed == comparison.mean("plain", "E").by_seed[:1]
    output = run("compare", str(tmp_path / "plain"), str(tmp_path / "careful"))
    assert comparison.verdict in output, "the program prints the same verdict"


def test_rows_of_results_tables_are_compared_by_successes() -> None:
    pd = pytest.importorskip("pandas")
    results = perturb.read_results(ROOT / "results/results.parquet")
    rows = results[(results.study == "classic-ff") & (results.environment == "CartPole") & (results.seed > 1)]
    rows = rows[(rows.trained_on == "R") & rows.algorithm.isin(["a2c", "ppo"]) & (rows.run <= 5)]
    final = rows[rows.tested_on.isin(["D", "R", "E"])]
    assert set(final.groupby(["algorithm", "tested_on"]).seed.nunique()) == {5}
    compared = perturb.compare(dict(list(rows.groupby("algorithm"))), baseline="a2c")
    assert (compared.environment, compared.success, compared.evaluations) == ("CartPole", None, {})
    z = 1.959963984540054
    for tested_on in ("D", "R", "E"):
        frame = final[final.tested_on == tested_on]
        by_seed = frame.pivot_table(index="seed", columns="algorithm", values="success_percent")
        for algorithm in ("a2c", "ppo"):
            it, seeds = compared.mean(algorithm, tested_on), by_seed[algorithm]
            assert it.by_seed == pytest.approx(seeds.tolist(), rel=1e-12)
            half = T_4 * seeds.sem()
            ends = (max(0.0, seeds.mean() - half), min(100.0, seeds.mean() + half))
            assert it.seeds_interval == pytest.approx(ends, rel=1e-5)
            assert (it.seeds, it.episodes) == (5, 1000)
            own = frame[frame.algorithm == algorithm]
            shares = (own.successes / own.episodes).astype(float)
            p, variance = shares.mean(), (shares * (1 - shares) / own.episodes.astype(float)).sum() / 25
            n = p * (1 - p) / variance if variance else 5000
            middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
            half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
            assert it.episodes_interval == pytest.approx((100 * (middle - half), 100 * (middle + half)), rel=1e-9)
        pairs = by_seed["ppo"] - by_seed["a2c"]
        (difference,) = [it for it in compared.differences if it.tested_on == tested_on]
        assert (difference.paired, difference.same_episodes) == (True, False)
        assert difference.by_seed == pytest.approx(pairs.tolist(), rel=1e-12)
        half = T_4 * pairs.sem()
        assert difference.seeds_interval == pytest.approx((pairs.mean() - half, pairs.mean() + half), rel=1e-5)
    assert "as if all policies had played different episodes" in str(compared)
    output = run(
        *("compare", str(ROOT / "results/results.parquet/classic-ff"), "--by", "algorithm", "--baseline", "a2c"),
        *("--where", "environment=cart-pole", "trained_on=R", "algorithm=a2c,ppo", "seed=2..6"),
    )
    assert f"{compared.verdict}." in output, "the program prints the same verdict"
    by_return = perturb.compare({"all": rows[rows.algorithm == "ppo"]}, versions=["E"], score="return")
    assert by_return.means[0].mean == pytest.approx(
        final[(final.algorithm == "ppo") & (final.tested_on == "E")].mean_return.mean(), rel=1e-12
    )
    assert by_return.means[0].episodes_interval is None
    with pytest.raises(perturb.InvalidArgumentError, match="have no episodes"):
        compared.columns()
    for conditions, words in [
        ({"a": results[results.study == "classic-ff"]}, "one environment; choose its rows"),
        ({"a": rows}, "several policies of seed 2, which differ by .*algorithm"),
        ({"a": rows, "b": upright}, "expected rows for all or for none"),
        ({"a": pd.DataFrame({"study": ["s"]})}, "have no column cell"),
    ]:
        with pytest.raises(perturb.InvalidArgumentError, match=words):
            perturb.compare(conditions)
    with pytest.raises(perturb.InvalidArgumentError, match="are not tested again"):
        perturb.compare({"a": rows}, episodes=5)


def test_few_or_unequal_seeds_limit_the_verdict(server: str) -> None:
    conditions: dict[str, Any] = {
        "one": noisy(0.5, 1),
        "two": [noisy(0.3, 2), noisy(0.2, 3)],
        "four": {s: noisy(0.1, s) for s in range(4)},
        "three": [upright, noisy(0.05, 1), noisy(0.1, 2)],
    }
    comparison = perturb.compare(conditions, "CartPole", versions=("E",), episodes=30, server=server)
    by_pair = {(it.x, it.y): it for it in comparison.differences}
    assert len(by_pair) == 6
    assert comparison.mean("one", "E").seeds_interval is None
    assert comparison.mean("one", "E").episodes_interval is not None
    it = by_pair["two", "one"]
    assert (it.paired, it.by_seed, it.p, it.seeds_interval) == (False, (), None, None)
    assert "1 seeds decide nothing" in it.verdict
    it = by_pair["three", "four"]
    assert (it.paired, it.seeds, it.p is None) == (False, (3, 4), False)
    one = perturb.compare({"a": noisy(0.5, 1), "b": upright}, "CartPole", versions=("E",), episodes=30, server=server)
    assert one.verdict.endswith("one seed each supports no conclusion about other seeds")
    two = perturb.compare(
        {"a": [noisy(0.5, 1), noisy(0.5, 2)], "b": [upright, upright]},
        "CartPole",
        versions=("E",),
        episodes=9,
        server=server,
    )
    assert two.verdict.endswith("two seeds decide nothing")


def test_checkpoints_are_named_by_their_seeds(server: str) -> None:
    other = perturb.load_policy(POLICIES / "CartPole-ppo-ff-R-9bd6546b-s7.safetensors")
    conditions: dict[str, Any] = {"D": str(CART_POLE), "R": [other]}
    comparison = perturb.compare(conditions, "CartPole", versions=("D",), episodes=20, server=server)
    assert list(comparison.evaluations["R"]) == [str(other.seed)]
    assert [it.condition for it in comparison.means] == ["D", "R"]


def test_pictures_have_one_scale_for_all_conditions(comparison: perturb.Comparison, server: str) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    axes = comparison.plot("E", "length", "mass", title="mine", cbar=True)
    assert [one.get_title() for one in axes] == ["plain", "careful"]
    assert axes[0].figure.get_suptitle() == "mine"
    assert len(axes[0].figure.axes) == 3, "two panels and a colour bar"
    assert len(comparison.plot("E", cbar=False)[0].figure.axes) == 2
    grid = perturb.sets.grid("lengths", {"length": "0.2..1.0/5"})
    conditions = {"a": [upright, noisy(0.5, 1)], "b": noisy(0.9, 2)}
    curves = perturb.compare(conditions, "CartPole", versions=["D", grid], episodes=30, server=server)
    axes = curves.plot()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["a", "b"]
    with pytest.raises(perturb.InvalidArgumentError, match="no parameter varies in the test on D"):
        curves.plot("D")
    with pytest.raises(perturb.UnknownNameError, match="there are D, lengths"):
        curves.plot("E")


@pytest.mark.parametrize(
    ("conditions", "settings", "words"),
    [
        ({}, {}, "expected a dict of policies by names"),
        ({"a": []}, {}, "has no policy"),
        ({1: upright}, {}, "expected a name"),
        ({"a": upright}, {"environment": None}, "environment is missing"),
        ({"a": upright}, {"score": "speed"}, "speed"),
        ({"a": upright, "b": upright}, {"baseline": "c"}, "one of a, b"),
    ],
)
def test_compare_refuses_wrong_arguments(conditions: Any, settings: dict[str, Any], words: str, server: str) -> None:
    arguments = {"environment": "CartPole", "versions": ("D",), "episodes": 2, "server": server, **settings}
    with pytest.raises(perturb.InvalidArgumentError, match=words):
        perturb.compare(conditions, **arguments)


def test_assessments_that_cannot_be_compared_are_refused(server: str) -> None:
    both = perturb.evaluate({"D": upright, "R": upright}, "CartPole", versions=("D",), episodes=2, server=server)
    with pytest.raises(perturb.InvalidArgumentError, match="2 policies, trained on D, R; expected one policy for each"):
        perturb.compare({"a": both})
    one = perturb.evaluate(upright, "CartPole", versions=("D",), episodes=2, server=server)
    other = perturb.evaluate(upright, "CartPole", versions=("E",), episodes=2, server=server)
    with pytest.raises(perturb.InvalidArgumentError, match="no test in common"):
        perturb.compare({"a": one, "b": other})
    judged = one.judged_by("steps=100")
    with pytest.raises(perturb.InvalidArgumentError, match="the rule of success of b is steps at least 100"):
        perturb.compare({"a": one, "b": judged})


def test_success_is_a_threshold_or_a_function_of_the_columns(server: str, tmp_path: Path) -> None:
    def long(columns: Any) -> Any:
        return (columns["length"] >= 100) & (columns["requested_length"] > 0)

    settings: dict[str, Any] = {"versions": ("E",), "episodes": 200, "seed": 5, "server": server}
    by_return = perturb.evaluate(upright, "CartPole", success="return>=100", **settings)
    by_length = perturb.evaluate(upright, "CartPole", success="length<=99", **settings)
    by_function = perturb.evaluate(upright, "CartPole", success=long, **settings)
    steps = perturb.evaluate(upright, "CartPole", success="steps=100", **settings)
    expected = (steps.columns()["length"] >= 100).tolist()
    assert 0 < sum(expected) < 200
    assert by_return.columns()["success"].tolist() == expected
    assert by_function.columns()["success"].tolist() == expected
    assert by_length.columns()["success"].tolist() == [not it for it in expected]
    assert by_return["E"].success_percent == steps["E"].success_percent
    assert (by_return.success, by_length.success) == ("return at least 100", "length at most 99")
    assert by_function.success == "long() at least 1"
    for assessment in (by_return, by_function):
        assessment.save(tmp_path / "saved", overwrite=True)
        assert perturb.Assessment.load(tmp_path / "saved").results == assessment.results
        assert assessment.audit(upright, server=server).different == ()
    assert steps.judged_by(long).results == by_function.results
    assert steps.judged_by("steps=195")["E"].success_percent <= steps["E"].success_percent
    with pytest.raises(perturb.InvalidArgumentError, match="gave int64 of the shape"):
        steps.judged_by(lambda columns: columns["seed"].astype("int64")[:3])
    for rule in ("length=5", "return>=high"):
        with pytest.raises(perturb.InvalidArgumentError, match="expected a number after a sign"):
            steps.judged_by(rule)


def test_progress_is_shown_on_request(server: str, capfd: pytest.CaptureFixture[str]) -> None:
    perturb.evaluate(upright, "CartPole", versions=("D",), episodes=3, server=server)
    assert capfd.readouterr().err == "", "standard error is no terminal"
    perturb.evaluate(upright, "CartPole", versions=("D",), episodes=3, server=server, progress=True)
    assert "CartPole, function upright: testing on D: 3 of 3 episodes" in capfd.readouterr().err


def test_a_result_is_found_by_the_name_of_its_set(server: str) -> None:
    corners = perturb.sets.grid("corners", {"length": [0.3, 0.9]})
    policies = {"D": upright}
    assessment = perturb.evaluate(policies, "CartPole", versions=["E", corners], episodes=8, server=server)
    assert assessment["corners"] is assessment["D on corners"]
    assert assessment["E"] is assessment["DE"]
    assert assessment.varying_parameters("corners") == ("length",)
    both = perturb.evaluate({"D": upright, "R": upright}, "CartPole", versions=["E"], episodes=8, server=server)
    with pytest.raises(perturb.UnknownNameError, match="there are DE, RE"):
        both["E"]


def test_error_names_missing_pandas(comparison: perturb.Comparison, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        comparison.to_pandas()
