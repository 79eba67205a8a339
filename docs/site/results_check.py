"""Compare README.md, results/README.md and docs/findings with the results table, and run the commands of these pages.

Usage: results_check.py PROGRAMS [PAGE...]. Fails for a number that the table does not give, a number that no rule
explains, a policy that is missing, a command that does not work, and a folder that has grown too large.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import perturb
import results_changes
import results_contexts
import results_factors
import results_given
import results_intervals
import results_lines
import results_pages
import results_paper
import results_stability
from results_numbers import read_studies
from results_words import Near, Pattern

POLICIES = Path("results/policies")
MAX_FILES = 120
MAX_BYTES = 15_000_000
MAX_README_LINES = 150
PAGES = {
    "README.md": results_pages.readme,
    "results/README.md": results_pages.results,
    "docs/findings/classic-ff.md": results_pages.classic_ff,
    "docs/findings/changing-physics.md": results_changes.changing_physics,
    "docs/findings/acrobot-steps.md": results_pages.acrobot,
    "docs/findings/beyond.md": results_pages.beyond,
    "docs/findings/cart-pole-ties.md": results_pages.cart_pole,
    "docs/findings/intervals.md": results_intervals.intervals,
    "docs/findings/locomotion.md": results_pages.locomotion,
    "docs/findings/one-factor.md": results_factors.one_factor,
    "docs/findings/paper-claims.md": results_pages.claims,
    "docs/findings/paper-items.md": results_paper.paper_items,
    "docs/findings/pendulum-ppo.md": results_pages.pendulum,
    "docs/findings/recurrent.md": results_pages.recurrent,
    "docs/findings/reference-lines.md": results_lines.reference_lines,
    "docs/findings/rl2-trials.md": results_pages.rl2,
    "docs/findings/stability.md": results_stability.stability,
    "docs/findings/training-contexts.md": results_contexts.training_contexts,
}
# The part of README.md that has results: its first heading, and the first heading after it.
SECTIONS = {"README.md": ("## The benchmark", "## Install")}
NUMBER = r"[-−]?\d[\d ]*(?:\.\d+)?(?:e-?\d+)?"


def plain(text):
    """Return text on one line, without bold type."""
    return re.sub(r"\s+", " ", text.replace("**", ""))


def prose(page):
    """Return a page's text without blocks of code, comments and targets of links."""
    text = Path(page).read_text()
    if page in SECTIONS:
        first, last = SECTIONS[page]
        text = text[text.index(first) : text.index(last)]
    text = re.sub(r"```.*?```|<!--.*?-->", " ", text, flags=re.DOTALL)
    return plain(re.sub(r"\]\([^)]*\)", "]", text))


def pattern(text):
    """Return a regular expression for a computed text. ⟨a|b⟩ matches a or b, and `@` matches any number."""
    parts = re.split(r"(⟨[^⟩]*⟩|@)", text)
    number = rf"({NUMBER})"

    def part(piece):
        if piece == "@":
            return number
        if piece.startswith("⟨"):
            return "(?:" + "|".join(map(re.escape, piece[1:-1].split("|"))) + ")"
        return re.escape(piece)

    return "".join(map(part, parts))


def check_page(page, studies):
    """Return the faults of a page."""
    text = prose(page)
    covered = [False] * len(text)
    faults = []
    for claim in PAGES[page](studies) + results_intervals.sentences(page, studies):
        near = claim if isinstance(claim, Near) else Near(getattr(claim, "expression", claim), [], 0)
        expected = re.sub(r"\]\([^)]*\)", "]", plain(near.text))
        found = list(re.finditer(claim.expression if isinstance(claim, Pattern) else pattern(expected), text))
        if not found:
            faults.append(f"{page}: the table gives `{near.text}`, which the page does not have")
        for match in found:
            covered[match.start() : match.end()] = [True] * (match.end() - match.start())
            for written, value in zip(match.groups(), near.values, strict=True):
                if value is not None and abs(float(written) - value) > near.tolerance:
                    faults.append(f"{page}: `{near.text}` has {written}, the table gives {value:.4f}")
    for expression in results_given.EVERYWHERE + results_given.GIVEN.get(page, []):
        for match in re.finditer(expression, text):
            covered[match.start() : match.end()] = [True] * (match.end() - match.start())
    for match in re.finditer(rf"(?<![\w.]){NUMBER}", text):
        if not all(covered[match.start() : match.start() + len(match.group().strip())]):
            around = text[max(0, match.start() - 40) : match.end() + 30]
            faults.append(f"{page}: nothing computes the number {match.group().strip()} in `…{around}…`")
    return faults


def check_policies(frame):
    """Return the faults of the policy files: missing files, files without a test, and files that do not load."""
    final = frame.groupby(["study", "cell"]).after_episodes.transform("max") == frame.after_episodes
    tested = set(frame[final & frame.checksum.notna()].cell)
    stored = {path.stem: path for path in POLICIES.glob("*.safetensors")}
    faults = [f"results/policies has no policy of {cell}" for cell in sorted(tested - set(stored))]
    faults += [f"{stored[cell]}: the table has no checksums of its tests" for cell in sorted(set(stored) - tested)]
    for path in stored.values():
        try:
            perturb.load_policy(path)
        except perturb.PerturbError as error:
            faults.append(str(error))
    return faults


def check_files():
    """Return a fault for each size of results/ that is above its limit."""
    files = [path for path in Path("results").rglob("*") if path.is_file()]
    lines = len(Path("results/README.md").read_text().splitlines())
    sizes = [
        ("files in results/", len(files), MAX_FILES),
        ("bytes in results/", sum(path.stat().st_size for path in files), MAX_BYTES),
        ("lines in results/README.md", lines, MAX_README_LINES),
    ]
    return [f"{what}: {got}, expected {most} at most" for what, got, most in sizes if got > most]


def commands(page):
    """Return the commands in a page, without comments. `make docs-test` runs the blocks in README.md's other parts."""
    text = Path(page).read_text()
    if page in SECTIONS:
        first, last = SECTIONS[page]
        text = text[text.index(first) : text.index(last)]
    blocks = re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL)
    lines = [
        re.sub(r"\s+#.*", "", line).strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()
    ]
    inline = re.findall(r"`(perturb [a-z]+ (?:experiments|results)[^`]*)`", re.sub(r"\s+", " ", text))
    return [line for line in lines + inline if line]


def check_commands(pages, programs):
    """Run the commands on the smallest input that shows that they work."""
    faults = []
    with tempfile.TemporaryDirectory(prefix="perturb-") as scratch:
        for page in pages:
            for command in commands(page):
                small = next(
                    (re.sub(*pair, command) for pair in results_given.SMALL if re.search(pair[0], command)), None
                )
                if small is None:
                    faults.append(f"{page}: no rule says how to run `{command}` on a small input")
                    continue
                small = small.replace("SCRATCH", scratch)
                path = f"{Path(programs).absolute()}:/usr/bin:/bin"
                run = subprocess.run(small, shell=True, check=False, capture_output=True, text=True, env={"PATH": path})
                print(f"{page}: {small}: {run.returncode}", flush=True)
                if run.returncode != 0:
                    faults.append(f"{page}: `{small}` ended with {run.returncode}: {run.stderr.strip()[-500:]}")
    return faults


def main():
    programs, *pages = sys.argv[1:]
    if shutil.which("perturb", path=programs) is None:
        sys.exit(f"{programs} has no program perturb: run make build")
    pages = pages or list(PAGES)
    frame, studies = read_studies()
    faults = [fault for page in pages for fault in check_page(page, studies)]
    faults += check_policies(frame) + check_files() + check_commands(pages, programs)
    for fault in faults:
        print(fault, file=sys.stderr)
    print(f"{len(pages)} pages, {len(frame)} rows, {len(faults)} faults")
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
