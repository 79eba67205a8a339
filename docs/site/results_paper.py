"""The numbers of docs/findings/paper-items.md, from the results table."""

from collections import Counter, defaultdict

from results_numbers import ENVIRONMENTS

# The studies that repeat the paper's methods with seeds that did not select a configuration.
STUDIES = ("classic-ff", "classic-rc", "questions/findings", "beyond/confirm-2", "locomotion")
SELECTION_SEED = 1
KINDS = ("five", "three", "fewer", "none")


def seeds(studies):
    """Return how many seeds the study with the most seeds has for each number of the paper's tables of environments.

    The keys are environment, method and metric.
    """
    trained = defaultdict(set)
    for cell in studies.cells:
        if cell.study in STUDIES and not cell.failed and cell.seed != SELECTION_SEED:
            trained[cell.study, cell.environment, cell.method, cell.trained_on].add(cell.seed)
    found = {}
    for row in studies.paper_rows:
        if row["environment"] == "Average":
            continue
        trials = row["episodes_per_trial"]
        method = (row["algorithm"].lower(), row["architecture"].lower(), int(trials) if trials else None)
        counts = []
        for study in STUDIES:
            on_d, on_r = (trained[study, row["environment"], method, version] for version in "DR")
            needed = {"default": on_d, "interpolation": on_r, "extrapolation": on_d & on_r}[row["metric"]]
            counts.append(len(needed))
        found[row["environment"], method, row["metric"]] = max(counts)
    return found


def kind(count):
    return "five" if count >= 5 else "three" if count >= 3 else "fewer" if count else "none"


def paper_items(studies):
    """Return the texts with numbers that the page must contain."""
    known = seeds(studies)
    texts, total = [], Counter()
    for environment in (*ENVIRONMENTS, "Hopper", "HalfCheetah"):
        counts = Counter(kind(count) for key, count in known.items() if key[0] == environment)
        total += counts
        texts.append(f"| {environment} | " + " | ".join(str(counts[name]) for name in KINDS) + " |")
    texts.append("| all | " + " | ".join(str(total[name]) for name in KINDS) + " |")
    five, none = total["five"], total["none"]
    answer = [
        f"The paper has {len(known)} numbers for single environments",
        f"For {five} of them, studies of this project have at least five seeds, and for {none} of them no seed",
    ]
    return [*texts, *answer]
