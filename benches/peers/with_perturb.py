"""Trains with perturb as users do, with its own server process, logs and checkpoints."""

import csv
import io
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from contests import Contest, Training

# Budget in episodes. No contest reaches it, because contests count steps.
EPISODES = 1_000_000_000
# Time after which a training counts as failed, in seconds.
TRAINING_TIMEOUT = 300.0


def train(program: Path, contest: Contest, seed: int) -> Training:
    """Train until progress.csv reaches the contest's number of steps, then stop the program."""
    settings = {"num_envs": contest.num_envs, "n_steps": contest.n_steps, **contest.settings}
    settings["learning_rate_schedule"] = '"constant"'
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "run"
        command = [str(program), "train", "--out", str(out), "--env", contest.environment]
        command += ["--algorithm", contest.algorithm, "--architecture", "ff"]
        command += ["--episodes", str(EPISODES), "--seed", str(seed)]
        for key, value in settings.items():
            command += ["--set", f"{key}={value}"]
        with (Path(directory) / "log").open("w+") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log)
            try:
                line = wait_for(process, out / "progress.csv", contest.steps)
            except RuntimeError as error:
                log.seek(0)
                raise RuntimeError(f"{error}: {' '.join(command)}\n{log.read()}") from None
            finally:
                process.send_signal(signal.SIGTERM)
                process.wait()
    return Training(
        steps=int(line["time/total_timesteps"]),
        updates=int(line["train/n_updates"]),
        episode_length=float(line["rollout/ep_len_mean"]),
        seconds=float(line["time/time_elapsed"]),
    )


def wait_for(process: subprocess.Popen[bytes], path: Path, steps: int) -> dict[str, str]:
    """Wait until progress.csv reaches `steps` steps, and return this line."""
    deadline = time.monotonic() + TRAINING_TIMEOUT
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RuntimeError("perturb ended before the contest did")
        # Polls only ten times a second, so that the training is not slowed down. The result does not depend on this
        # interval, because the training measures its own time.
        time.sleep(0.1)
        if not path.exists():
            continue
        complete = path.read_text().rpartition("\n")[0]
        for line in csv.DictReader(io.StringIO(complete)):
            if int(line["time/total_timesteps"]) >= steps:
                return line
    raise RuntimeError(f"perturb took more than {TRAINING_TIMEOUT:.0f} s")
