"""Draw results/figures/pendulum-parameters.svg: success on Pendulum over each parameter.

Usage: python experiments/references/parameters_figure.py, with matplotlib, pandas and pyarrow, in the project's folder.

The episodes are those of the stored policies: PPO of the study beyond/confirm-2 trained on D, and the heuristic policy.
Episodes on R fill the middle of each panel, and episodes on E both sides.
"""

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

matplotlib.rcParams.update({"svg.hashsalt": "perturb", "svg.fonttype": "none"})  # the same bytes at each run

POLICIES = {
    "PPO": ("beyond-confirm-2", "Pendulum-ppo-ff-D-", "C0"),
    "heuristic policy": ("heuristic", "Pendulum-heuristic-ff-D-", "0.35"),
}
# The number of bins of each interval.
BINS = {"R": 10, "E": 2}
INTERVALS = (("E", 0.5, 0.75), ("R", 0.75, 1.25), ("E", 1.25, 1.5))


def main():
    figure, panels = plt.subplots(1, 2, figsize=(8, 3), sharey=True, layout="constrained")
    for name, (study, cell, color) in POLICIES.items():
        episodes = pd.read_parquet(f"results/episodes/{study}.parquet")
        episodes = episodes[episodes.cell.str.startswith(cell)]
        assert len(episodes), f"{study} has no episodes of {cell}"
        for panel, parameter in zip(panels, ("length", "mass"), strict=True):
            for version, low, high in INTERVALS:
                tests = episodes[episodes.set == version]
                values = tests[f"requested_{parameter}"]
                tests = tests[values.between(low, high)]
                edges = np.linspace(low, high, BINS[version] + 1)
                bins = pd.cut(tests[f"requested_{parameter}"], edges, labels=(edges[:-1] + edges[1:]) / 2)
                rates = 100 * tests.groupby(bins, observed=True).success.mean()
                style = "-" if name == "PPO" else "--"
                label = name if version == "R" else None
                panel.plot(rates.index.astype(float), rates, style, color=color, marker=".", label=label)
    for panel, label in zip(panels, ("length, m", "mass, kg"), strict=True):
        panel.set_xlabel(label)
        panel.set_ylim(-3, 103)
        panel.grid(alpha=0.3)
        for end in (0.75, 1.25):
            panel.axvline(end, color="0.8", linewidth=1)
    panels[0].set_ylabel("success, %")
    panels[1].legend(frameon=False, loc="lower left")
    figure.savefig("results/figures/pendulum-parameters.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
