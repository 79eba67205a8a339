"""The numbers of docs/findings/paper-items.md, from the results table."""

from collections import Counter, defaultdict
from statistics import fmean

from results_numbers import ENVIRONMENTS, std
from results_words import CLEAN, FF, NAMES, spread

# The studies that repeat the paper's methods with seeds that did not select a configuration.
STUDIES = ("classic-ff", "classic-rc", "questions/findings", "beyond/confirm-2", "locomotion")
SELECTION_SEED = 1
KINDS = ("five", "three", "fewer", "none")
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")


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
    texts.append(
        f"Of the {len(known)} numbers in its tables of environments, {total['five']} are repeated here with five"
    )
    return texts + stability(studies)


def stability(studies):
    """Return the rows and counts of the section on training with random physics."""
    texts = []
    steadier = better = pairs = 0
    for task in ENVIRONMENTS:
        for name in FF:
            runs = {}
            for version in "DR":
                cells = studies.finished("questions/findings", environment=task, algorithm=name, trained_on=version)
                runs[version] = sorted((cell for cell in cells if cell.seed in CLEAN), key=lambda cell: cell.seed)
                assert len(runs[version]) == len(CLEAN), f"{task}, {name}, {version}: {len(runs[version])} seeds"
            own = {version: [cell.success(version) for cell in cells] for version, cells in runs.items()}
            on_d = {version: [cell.success("D") for cell in cells] for version, cells in runs.items()}
            if not any(own["D"]):
                continue  # never learns the fixed environment
            pairs += 1
            steadier += std(own["R"]) < std(own["D"])
            better += fmean(on_d["R"]) > fmean(on_d["D"])
            row = [spread(own["D"]), spread(own["R"]), spread(on_d["R"])]
            texts.append(f"| {task} | {NAMES[name]} | " + " | ".join(row) + " |")
    return [
        *texts,
        f"in {COUNTS[steadier]} of {COUNTS[pairs]} pairs the results on R vary less than those on D",
        f"In {COUNTS[better]} of the {COUNTS[pairs]} pairs",
    ]
