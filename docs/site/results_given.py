"""Rules for pages about results.

`EVERYWHERE` and `GIVEN` match numbers that cannot be computed from results. `SMALL` has the replacements by which the
commands of the pages run on small inputs.
"""

RATE = r"\d+e-\d"

# Names, seeds, budgets, levels and settings, on any page.
EVERYWHERE = [
    r"\b[Ss]eeds? \(?\d+(?:,? (?:to|and) \d+)?",
    r"(?:seed \d \| )+",
    r"95 % (?:t|bootstrap) interval",
    r"\b(?:[Aa]fter|of|By) 1?\d 000(?: episodes)?(?:: D)?",
    rf"\b(?:rates?|[Aa]t|entropy|weight|with) (?:of )?{RATE}",
    rf"\| {RATE} \|",
    r"\d+ (?:environments|minibatches)\b",
    r"(?:80|90) steps|(?:code's|by) (?:80|90)\b|80 or 90",
    r"confirm-2|search-\w+",
    r"γ of 0\.\d+(?: or 0\.\d+)?",
]
# Each comment says where the numbers below it come from.
GIVEN = {
    "README.md": [],
    "results/README.md": [
        r"trials of 1, 2 and 5 episodes",
        r"\| 2e-3 had the highest mean return",
        r"revision 0",
        r"our 95 % intervals",
        # Asserted by the script of the page on contexts.
        r"4 to 16 give most of the gain, and on Pendulum PPO needs 64",
        r"Each training has 15 000 episodes",
    ],
    "docs/findings/classic-ff.md": [
        # From the plan.
        r"60 configurations: 36 of A2C, 9 of PPO, 12 of EPOpt-A2C and 3 of EPOpt-PPO",
        r"All 960 cells",
        r"over (?:the same )?20 pairs",
        r"a rate of 7e-5",
    ],
    "docs/findings/acrobot-steps.md": [
        # From the plan.
        r"40 trainings",
        r"Every training has 15 000 episodes",
        r"[DRE], [89]0 \|",
        # From episodes that are not stored: the columns of 80 steps.
        r"22 to 28 points on D, 20 to 21 on R and 9 to 10 on E",
        r"and 15 steps",
        r"end at 0 %",
    ],
    "docs/findings/beyond.md": [
        # From the plans.
        r"seeds \(7 to 11\), with 1 000 test episodes",
        r"in 500 episodes",
        r"an entropy weight of 0\.01",
        r"the last 100 episodes",
        r"a Default below 90",
    ],
    "docs/findings/cart-pole-ties.md": [
        # From the plan.
        r"five seeds \(2 to 6\)",
        r"25 configurations",
        r"only 5 steps for A2C and 128 steps for PPO",
    ],
    "docs/findings/locomotion.md": [
        r"1 000 episodes each",
        r"--group 1\b",
    ],
    "docs/findings/paper-claims.md": [
        r"stayed at 0 %",
    ],
    "docs/findings/pendulum-ppo.md": [
        r"PPO has 0 % on Pendulum",
        r"within 2 000",
    ],
    "docs/findings/recurrent.md": [
        r"--group 1\b",
        # From a repeated training whose policy is not stored.
        r"42\.1 % on D, the other of 0\.0 %",
    ],
    "docs/findings/changing-physics.md": [
        # From the experiment file.
        r"after 100 of at most 200 steps",
        r"changes? after (?:100|50) steps",
        r"last 100 episodes",
        r"three seeds \(2 to 4\) and 1 000 episodes in each test",
        r"95 % Wilson intervals over the 3 000 episodes",
        r"after 100 and 50 steps",
    ],
    "docs/findings/one-factor.md": [
        # From the script.
        r"five seeds \(7 to 11\)",
        r"200 episodes for each combination",
        r"a 95 % t interval of",
    ],
    "docs/findings/paper-items.md": [
        r"Packer et al\., 2018",
        # From the paper's tables.
        r"Each environment has 42 numbers in the paper: 14 methods",
    ],
    "docs/findings/stability.md": [
        # From the experiment file, and from `perturb curves`.
        r"with five seeds \(2 to 6\)",
        r"EPOpt-PPO generates 60 000 episodes",
        r"Each training has 15 000 episodes, which are divided into 100 parts",
        r"over the 100 parts",
        # Asserted by the script.
        r"standard deviation above 30 means that the lowest and the highest seed differ by more than 50 points",
        r"success near 100 %",
        r"success exceeds 5 % in some part",
        r"stays at 0 % on D",
    ],
    "docs/findings/intervals.md": [
        r"[Oo]ur 95 % intervals|in 95 % of the cases|A 95 % t interval of the mean",
        r"Nearer to 0 or 100 %|the control has 95 % or slightly more",
        # From the experiment files and from the script.
        r"have 56 kinds of training, each with ten seeds: 16 in references and 40 in contexts",
        r"from 20 000 random samples",
        r"256 contexts",
        r"3 seeds \| 5 seeds \| 10 seeds",
        r"dashed line is 95 %",
        r"a coverage of 95 %",
        r"200, 1 000 and 3 000 episodes",
        # From docs/reports.md.
        r"\[73 % with three results and 84 % with five\]",
    ],
    "docs/findings/reference-lines.md": [
        # From the plan, and from the binomial distribution.
        r"1 000 on each of D, R and E with each of the seeds 7 to 11",
        r"Of these 5 000 episodes on E",
        r"95 % interval of a rate from 5 000 episodes is at most ±1\.4 points, and ±0\.6 points at a rate of 95 %",
        # From the experiment file.
        r"ten seeds \(31 to 40\)",
        r"with 1 000 episodes in each test",
        r"95 % t interval over the ten seeds",
        r"standard deviations of up to 31 points",
        r"corrected p below 0\.05",
        # From the rules of success.
        r"in the last 100 steps|in 110 steps",
        # From the errors that upper_bound.py prints, and its column smallest_miss.
        r"nearest miss is 0\.16 m",
        r"nearest misses by up to 0\.015 m",
        r"by less than 0\.02 m",
    ],
    "docs/findings/training-contexts.md": [
        r"Cobbe et al\., 2020",
        # From the experiment file.
        r"draws 256 contexts",
        r"first 1, 4, 16, 64 or 256",
        r"A training has 15 000 episodes",
        r"last 100 episodes",
        r"ten seeds \(31 to 40\), with about 1 000 episodes",
        r"about as much as 256 contexts|256 contexts instead of one|with 256 contexts",
        r"with its 95 % t interval over the seeds",
    ],
    "docs/findings/rl2-trials.md": [
        r"rate of 2e-3",
    ],
}
# Pairs of a regular expression and the replacement of its match. The first pair that matches a command is used.
# SCRATCH stands for an empty folder.
SMALL = [
    # The paths of files that the command writes stay relative to the working directory.
    (
        r"^(perturb heatmap .*) --out (\S+)",
        r"PERTURB_RESULTS=$PWD/results; export PERTURB_RESULTS; cd SCRATCH && \1 --grid 3 --episodes 2 --out \2",
    ),
    (r"^perturb audit results$", "perturb audit results/policies/CartPole-ppo-ff-R-9bd6546b-s7.safetensors"),
    (r"^(perturb report results\S*(?: --selection paper)?) --out \S+", r"\1 --out SCRATCH/report"),
    (r"^(perturb evaluate .*)", r"\1 --episodes 20"),
    (r"^(perturb video .*) --episodes 3 --out (\S+)", r"\1 --episodes 1 --out SCRATCH/\2"),
    # Cells that the table has are skipped, so nothing is trained.
    (
        r"^perturb run experiments/classic-rc.toml --out \S+(.*)",
        r"perturb run experiments/classic-rc.toml --out SCRATCH/rc\1 --cell CartPole-a2c-ff-D-05751545-s2",
    ),
    (
        r"^perturb run experiments/locomotion.toml --out \S+(.*)",
        r"perturb run experiments/locomotion.toml --out SCRATCH/locomotion\1 --cell Hopper-ppo-ff-D-348d15d9-s2",
    ),
    (
        r"^perturb run experiments/beyond/confirm-2.toml --out DIR",
        "perturb run experiments/beyond/confirm-2.toml --out SCRATCH/confirm --done results/results.parquet",
    ),
]
