"""Compares the training speed of perturb and other libraries (peers), in alternating rounds with new weights.

compare.py [--rounds N] [--perturb PROGRAM] [--purejaxrl CLONE] [PART OF A CONTEST'S NAME]

Prints environment steps per second, the medians over the rounds, and the ratio of perturb's median to each peer's.
README.md describes what is equal in all libraries and what is not.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import with_perturb
from contests import CONTESTS, Peer, Training

HERE = Path(__file__).parent


@contextmanager
def started(peer: Peer, index: int, purejaxrl: Path) -> Iterator[subprocess.Popen[str]]:
    """Start a peer as a process. After its imports and compilation, it waits for a seed on its standard input."""
    command = [sys.executable, str(HERE / peer.script), str(index), str(purejaxrl)]
    environ = os.environ | peer.environ
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environ)
    try:
        yield process
    finally:
        process.stdin.close()
        process.wait()


def answer(process: subprocess.Popen[str]) -> str:
    """Return the next output line of a peer."""
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f"{' '.join(process.args)} ended early; its error is above")
    return line.strip()


def compare(index: int, rounds: int, program: Path, purejaxrl: Path) -> None:
    """Measure one contest and print the result."""
    contest = CONTESTS[index]
    print(f"{contest.name}: {contest.steps} steps, {contest.updates} updates", flush=True)
    rates: dict[str, list[float]] = {"perturb": []}
    with ExitStack() as stack:
        processes = {}
        for peer in contest.peers:
            process = stack.enter_context(started(peer, index, purejaxrl))
            name = f"{peer.name} ({answer(process)})"
            processes[name], rates[name] = process, []
        for seed in range(1, rounds + 1):
            rates["perturb"].append(with_perturb.train(program, contest, seed).rate(contest))
            for name, process in processes.items():
                print(seed, file=process.stdin, flush=True)
                rates[name].append(Training(**json.loads(answer(process))).rate(contest))
            print(f"  round {seed}: " + ", ".join(f"{measured[-1]:,.0f}" for measured in rates.values()), flush=True)
    report(rates)


def report(rates: dict[str, list[float]]) -> None:
    """Print the medians, the ratio of perturb's median to each peer's median, and the range of the rounds' ratios."""
    ours = rates["perturb"]
    for name, measured in rates.items():
        line = f"  {name}: median {statistics.median(measured):,.0f} steps/s"
        if measured is not ours:
            rounds = [own / other for own, other in zip(ours, measured, strict=True)]
            ratio = statistics.median(ours) / statistics.median(measured)
            line += f"; perturb has {ratio:.2f} of it, in single rounds {min(rounds):.2f} to {max(rounds):.2f}"
        print(line, flush=True)


def main() -> None:
    """Measure and print every contest that the command line selects."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("contest", nargs="?", default="", help="a part of the contest's name")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--perturb", type=Path, default=Path("target/release/perturb"))
    parser.add_argument("--purejaxrl", type=Path, default=Path("target/peers/purejaxrl"))
    arguments = parser.parse_args()
    wanted = [index for index, contest in enumerate(CONTESTS) if arguments.contest in contest.name]
    if not wanted:
        raise SystemExit(f"no contest has {arguments.contest!r} in its name: {[each.name for each in CONTESTS]}")
    for index in wanted:
        compare(index, arguments.rounds, arguments.perturb, arguments.purejaxrl)


if __name__ == "__main__":
    main()
