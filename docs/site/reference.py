"""Makes the site's pages from the sources.

Environments, leaderboard, commands, settings, experiment files, protocol, Python.

Each function gives pages by their places in the site, as markdown.
"""

import csv
import io
import json
import re
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path

PAIRS = [(a, r) for a in ("a2c", "ppo", "epopt-a2c", "epopt-ppo") for r in ("ff", "rc")]
PAIRS += [("rl2-a2c", "rc"), ("rl2-ppo", "rc")]
# Arguments of the training whose defaults are shown.
GIVEN = {"environment", "architecture"}
# The policies in films: for each page about an experiment, the paths of policies that were trained with PPO on D. {}
# stands for the environment. A step of MountainCar simulates a second.
FILMED = {
    "beyond": "results/policies/{}-ppo-ff-D-9bd6546b-s7.safetensors",
    "locomotion": "results/policies/{}-ppo-ff-D-348d15d9-s2.safetensors",
}
FASTER = {"MountainCar": ["--fps", "30"]}


def cell(text):
    """Return text escaped for a table's cell."""
    return str(text).replace("|", "\\|").replace("\n", " ")


def table(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(cell(entry) for entry in line) + " |\n" for line in lines)


def told(*command, **options):
    return subprocess.run(command, check=True, capture_output=True, text=True, **options).stdout


def number(value):
    return "unbounded" if value is None else f"{value:.6g}"


def between(low, high):
    return "unbounded" if low is None and high is None else f"[{number(low)}, {number(high)}]"


def union(intervals):
    return " ∪ ".join(between(*interval) for interval in intervals)


# Environments.


def environments(programs, folder):
    """Return a page for each environment of the catalogue. Films are written to `folder`."""
    catalogue = json.loads(told(programs / "perturb-server", "--catalogue"))["environments"]
    pages = {}
    for entry in catalogue:
        name = entry["name"]
        studies = [study for study, path in FILMED.items() if Path(path.format(name)).exists()]
        filmed = [(study, film(programs, name, FILMED[study].format(name), folder)) for study in studies]
        pages[f"environments/{name}.md"] = environment(entry, filmed)
    return pages


def film(programs, name, checkpoint, folder):
    """Film two episodes on E of a policy that was trained on D. Return the program's output."""
    target = folder / f"environments/{name}.mp4"
    target.parent.mkdir(parents=True, exist_ok=True)
    command = [programs / "perturb", "video", "--checkpoint", checkpoint, "--version", "E", "--episodes", "2"]
    printed = told(*command, *FASTER.get(name, []), "--out", target)
    return [line.split(maxsplit=4) for line in printed.splitlines() if re.match(r" +\d", line)]


def environment(entry, filmed):
    name, action, success = entry["name"], entry["action"], entry["success"]
    anchor = f"../environments.md#{name.lower()}"
    page = f"# {name}\n\n{entry['description']} Dynamics, start, endings and the exact state: [{name}]({anchor}).\n\n"
    for study, episodes in filmed:
        ends = ["a success" if episode[3] == "yes" else "no success" for episode in episodes]
        page += f'<video controls muted loop preload="metadata" src="{name}.mp4"></video>\n\n'
        page += "PPO, trained on D, in two episodes with parameters of E: " + ", then ".join(ends) + ". "
        page += f"The policy is one of the study [{study}](../findings/{study}.md); the film shows its parameters.\n\n"
    if not filmed:
        page += f"![{name}](../pictures/{name}.png)\n\n"
    page += "## Facts\n\n"
    facts = [
        ("Gymnasium", f"`perturb/{name}-v{entry['revision']}`"),
        ("step", f"{number(entry['control_timestep'])} s, at most {entry['step_limit']} in an episode"),
        ("success", success["description"]),
    ]
    if entry.get("code_success") and entry["code_success"]["description"] != success["description"]:
        facts.append(("success by the paper's code", entry["code_success"]["description"]))
    if entry["model_hash"]:
        facts.append(("model", f"SHA-256 `{entry['model_hash'][:16]}…`"))
    page += "".join(f"- **{fact}**: {value}\n" for fact, value in facts)
    page += "\n## Parameters\n\n" + table(
        ["parameter", "unit", "D", "R", "E", "bounds"],
        [
            (
                f"**{p['name']}**: {p['description']}",
                *(p["unit"], number(p["D"]), union(p["R"]), union(p["E"]), between(p["low"], p["high"])),
            )
            for p in entry["parameters"]
        ],
    )
    receipts = ", ".join(f"{q['name']} ({q['unit']})" for q in entry["applied"])
    page += f"\nA receipt reads back from the physics: {receipts}.\n"
    page += "\n## Observation\n\n" + table(["entry", "unit", "range"], channels(entry["observation"]))
    page += "\n## Action\n\n"
    if "discrete" in action:
        page += "".join(f"- {i}: `{choice}`\n" for i, choice in enumerate(action["discrete"]))
    else:
        page += table(["entry", "unit", "range"], channels(action["continuous"]))
    terms = [(f"`{term['name']}`", term["description"]) for term in entry["reward_terms"]]
    return page + "\n## Reward\n\nThe sum of\n\n" + table(["term", "value"], terms)


def channels(entries):
    return [(f"{i} `{c['name']}`", c["unit"], between(c["low"], c["high"])) for i, c in enumerate(entries)]


# Leaderboard.


def leaderboard(programs):
    """Return the trained policies of results/ by environment, with the highest mean over D, R and E first."""
    printed = told(programs / "perturb", "export", "--into", "results/results.parquet", "--csv", "-")
    stored = {path.stem for path in Path("results/policies").glob("*.safetensors")}
    results = {}
    for line in csv.DictReader(io.StringIO(printed)):
        # Rows of the final policy follow those of intermediate ones.
        if line["cell"] in stored and line["checksum"] and line["tested_on"] in ("D", "R", "E"):
            results.setdefault(line["cell"], {})[line["tested_on"]] = line
    results = {cell: tests for cell, tests in sorted(results.items()) if set("DRE") <= set(tests)}
    page = (
        "# Leaderboard\n\nTrained policies that come with the repository: success in % on D, R and E, and the mean of"
        " the three, by which they stand. Their names, which say learner, network, training version and seed, are what"
        " `perturb video`, `evaluate`, `heatmap` and `perturb.load_policy` take, in a clone or with `PERTURB_RESULTS`"
        " set to its `results`:\n\n"
        f"```sh\nperturb video --checkpoint {next(iter(results))} --version D,E --out sheet.png\n```\n\n"
        "Each row is one seed, trained for so many episodes and tested on so many of each version: differences of few"
        " points between neighbours mean nothing. What was compared with how many seeds, and the paper's numbers, are"
        " in [results](results.md); by which rule an episode is a success stands in the files there. Policies that were"
        " trained elsewhere stand in tables of their own:"
        " [assess your own agent](tutorials/assess-your-agent.md).\n"
    )
    for name in sorted({tests["D"]["environment"] for tests in results.values()}):
        rows = [row(cell, tests) for cell, tests in results.items() if tests["D"]["environment"] == name]
        head = ["policy", "D", "R", "E", "mean", "episodes", "tests"]
        page += f"\n## {name}\n\n" + table(head, sorted(rows, key=lambda entries: (-float(entries[4]), entries)))
    return {"leaderboard.md": page}


def row(cell, tests):
    rates = [100 * int(tests[version]["successes"]) / int(tests[version]["episodes"]) for version in "DRE"]
    shown = [f"{rate:.1f}" for rate in [*rates, sum(rates) / 3]]
    return [f"`{cell}`", *shown, tests["D"]["after_episodes"], tests["D"]["episodes"]]


# Commands.


def commands(programs):
    """Return the page of the programs' --help."""
    page = "# Commands\n\nWhat `perturb --help` and `perturb-server --help` say.\n\n"
    overview = told(programs / "perturb", "--help")
    names = re.findall(r"^  ([a-z-]+) ", overview.split("Commands:")[1].split("\n\n")[0], re.MULTILINE)
    for name in names:
        if name != "help":
            page += f"## perturb {name}\n\n" + help_of(told(programs / "perturb", name, "--help"))
    page += "## perturb-server\n\n" + help_of(told(programs / "perturb-server", "--help"))
    return {"reference/commands.md": page}


def help_of(text):
    """Return a program's help as markdown: options and arguments as tables, other sections as printed."""
    page = ""
    for part in re.split(r"\n(?=[A-Z][\w ]*:(?:\n| ))", "\n" + text.strip() + "\n"):
        title, _, body = part.strip().partition(":")
        if title == "Usage":
            page += f"```text\n{body.strip()}\n```\n\n"
        elif title in ("Options", "Arguments") or title.endswith("options"):
            page += table([title[:-1].lower(), ""], entries(body)) + "\n"
        elif body.startswith("\n") and re.fullmatch(r"[A-Z][\w ]*", title):
            page += f"{title}:\n\n```text\n{body.strip(chr(10))}\n```\n\n"
        else:
            page += prose(part.strip()) + "\n\n"
    return page


def entries(body):
    """Return a table of options with their descriptions."""
    found = []
    for line in body.splitlines():
        start = re.match(r" {2,6}(-|<|\[)", line)
        if start:
            flag, _, words = line.strip().partition("  ")
            found.append((f"`{flag}`", words.strip()))
        elif line.strip() and found:
            found[-1] = (found[-1][0], f"{found[-1][1]} {line.strip()}".strip())
    return [(flag, prose(words)) for flag, words in found]


def prose(text):
    """Return text in which only code is marked up. Characters of HTML and emphasis are escaped."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(p if p.startswith("`") else re.sub(r"([][<*_])", r"\\\1", p) for p in parts)


# Settings and experiment files.


def documented(source, struct):
    """Return the fields of a Rust struct with their comments."""
    body = re.search(rf"struct {struct} \{{\n(.*?)\n\}}", source, re.DOTALL).group(1)
    fields, words = [], []
    for line in map(str.strip, body.splitlines()):
        if line.startswith("///"):
            words.append(line[3:].strip())
        elif field := re.match(r"(?:pub(?:\([a-z]+\))? )?(\w+): ", line):
            if not words:
                raise SystemExit(f"{struct}.{field.group(1)} has no comment")
            fields.append((field.group(1), re.sub(r"\[(`[^`]*`)\](\([^)]*\))?", r"\1", " ".join(words))))
            words = []
    return fields


def settings(programs):
    """Return every setting with its comment in crates/settings/src/settings and with the program's defaults."""
    sources = "".join(path.read_text() for path in sorted(Path("crates/settings/src/settings").glob("*.rs")))
    defaults = {preset: resolved(programs, preset) for preset in ("perturb", "paper")}
    page = (
        "# Settings\n\nOf `perturb train --set KEY=VALUE`, of `--config FILE.toml`, and of the tables `settings` and"
        " `grid` of an [experiment file](experiment-files.md). Defaults are those that the program resolves for each of"
        " the paper's ten pairs of algorithm and architecture, with each"
        " [preset](../algorithms.md#the-papers-preset).\n\n"
    )
    for title, struct, has in (
        ("Every training", "Common", lambda _: True),
        ("A2C", "A2cConfig", lambda pair: "a2c" in pair[0]),
        ("PPO", "PpoConfig", lambda pair: "ppo" in pair[0]),
        ("EPOpt", "EpoptConfig", lambda pair: pair[0].startswith("epopt")),
        ("RL²", "Rl2Config", lambda pair: pair[0].startswith("rl2")),
    ):
        rows = []
        for key, words in documented(sources, struct):
            # A comment may state a default. It is shown only if config.toml has no value.
            said = re.search(r" \(default: ([^()]*(?:\([^()]*\)[^()]*)*)\)", words)
            words = words.replace(said[0], "") if said else words
            ours, theirs = (
                spread({pair: given for pair, given in of_key(defaults[preset], key) if has(pair)})
                for preset in ("perturb", "paper")
            )
            default = said[1] if ours == "–" and said else ours
            rows.append((f"`{key}`", default, "the same" if theirs == ours else theirs, words))
        page += f"## {title}\n\n" + table(["setting", "default", "with `paper`", "what it is"], rows) + "\n"
    return {"reference/settings.md": page}


def of_key(defaults, key):
    return [(pair, None if key in GIVEN else found.get(key)) for pair, found in defaults.items()]


def resolved(programs, preset):
    """Begin a training with each pair of algorithm and architecture. Return the settings in its config.toml."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        trainings = {pair: begin(programs, preset, pair, Path(folder) / "-".join(pair)) for pair in PAIRS}
        for pair, training in trainings.items():
            file = Path(folder) / "-".join(pair) / "config.toml"
            while not file.exists():
                if training.poll() is not None:
                    raise SystemExit(f"perturb train with {preset} {' '.join(pair)} ended with {training.returncode}")
                time.sleep(0.02)
            training.kill()  # SIGTERM would let the training finish its iteration
            training.wait()
            found[pair] = dict(line.split(" = ", 1) for line in file.read_text().splitlines() if " = " in line)
    return found


def begin(programs, preset, pair, out):
    command = [programs / "perturb", "train", "--env", "CartPole", "--preset", preset, "--out", out]
    command += ["--algorithm", pair[0], "--architecture", pair[1]]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def spread(values):
    """Return a text with the most frequent default, and the other defaults with their algorithms and architectures."""
    commonest, _ = Counter(values.values()).most_common(1)[0]
    others = {}
    for pair, value in values.items():
        if value != commonest:
            others.setdefault(value, []).append(" ".join(pair))
    names = {value: "–" if value is None else f"`{value}`" for value in values.values()}
    return "; ".join([names[commonest], *(f"{names[value]}: {', '.join(who)}" for value, who in others.items())])


def experiment_files():
    """Return the keys of an experiment file with their comments in crates/experiment/src/plan/file.rs."""
    source = Path("crates/experiment/src/plan/file.rs").read_text()
    page = "# Experiment files\n\nEvery key of the TOML files that `perturb plan` and `perturb run` read."
    page += " What they are for, with examples: [experiments](../experiments.md#the-file).\n\n"
    page += "## Of the file\n\n" + keys(documented(source, "File"))
    page += "\n## Of a table `[[algorithm]]`\n\n" + keys(documented(source, "Block"))
    page += "\nKeys of `settings` and `grid` are the [settings](settings.md).\n\n## Those that come with perturb\n\n"
    for path in sorted(Path("experiments").glob("*.toml")):
        page += f"### {path.name}\n\n```toml\n{path.read_text().strip()}\n```\n\n"
    return {"reference/experiment-files.md": page}


def keys(found):
    return table(["key", "what it is"], [(f"`{key}`", words) for key, words in found])


# Protocol.


def protocol():
    """Return proto/perturb/v1/perturb.proto as a page: its comments, and tables of fields."""
    blocks, words = parse_proto(Path("proto/perturb/v1/perturb.proto").read_text())
    names = {name for _, name, _, _ in blocks}
    page = "# Protocol, field by field\n\n" + words + "\n\nHow the parts work together: [protocol](../protocol.md).\n\n"
    for kind, name, words, members in blocks:
        page += f"## {name}\n\n*{kind}*\n\n{words}\n\n"
        head = {"service": ["call", ""], "enum": ["value", ""], "message": ["field", "type", ""]}[kind]
        rows = []
        for number, label, types, said in members:
            linked = re.sub(r"\w+", lambda w: f"[{w[0]}](#{w[0].lower()})" if w[0] in names else w[0], types)
            row = {"service": [f"`{label}`: {linked}", said], "message": [f"`{label}` {number}", linked, said]}
            rows.append(row.get(kind, [f"`{label}` {number}", said]))
        page += table(head, rows) + "\n" if rows else ""
    return {"reference/protocol.md": page}


def parse_proto(text):
    """Return services, messages and enums in order, as (kind, name, comment, members), and the file's comment."""
    blocks, words, one_of, whole = [], [], None, ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("//"):
            words.append(line[2:].removeprefix(" "))
            continue
        said, opened = joined(words), re.match(r"(service|message|enum) (\w+) \{", line)
        if line.startswith("package"):
            whole = said
        elif opened:
            blocks.append((opened[1], opened[2], said, []))
        elif one := re.match(r"oneof (\w+) \{", line):
            one_of = (one[1], said)
        elif line == "}":
            one_of = None
        elif call := re.match(r"rpc (\w+)\((.*?)\) returns \((.*?)\)", line):
            blocks[-1][3].append(("", call[1], f"{call[2]} → {call[3]}", said))
        elif field := re.match(r"(?:(.+?) )?(\w+) = (\d+);", line):
            if one_of:
                said = f"One of `{one_of[0]}`. {one_of[1]} {said}".replace("  ", " ")
            blocks[-1][3].append((field[3], field[2], field[1] or "", said))
        words = []
    return blocks, whole


def joined(lines):
    """Return a comment as markdown: paragraphs, lists, and indented lines as code."""
    text = [""]
    for line in lines:
        if line.startswith("  ") and text[-1].startswith("- "):
            text[-1] += " " + prose(line.strip())
        elif line.startswith("  "):
            text += ["", f"`{line.strip()}`", ""]
        elif line.startswith("- "):
            text += [prose(line)] if text[-1].startswith("- ") else ["", prose(line)]
        elif not line or not text[-1] or text[-1].startswith("- "):
            text += ["", prose(line)]
        else:
            text[-1] += " " + prose(line)
    return re.sub("\n{3,}", "\n\n", "\n".join(text)).strip()


# Python.


def python():
    """Return the page of the Python package, from its docstrings."""
    source = Path("python/src/perturb/__init__.py").read_text()
    names = re.findall(r'"(\w+)"', source.split("__all__ = [")[1].split("]")[0])
    # A link needs the module that defines the name, because a function and its module may have the same name, for
    # example perturb.environments.environments.
    imported = re.findall(r"from \.(\w+) import (?:\((.*?)\)|(.*?)\n)", source, re.DOTALL)
    modules = {name: module for module, several, one in imported for name in re.findall(r"\w+", several or one)}
    inner = re.findall(r"from \. import (\w+)\n", source)
    functions = sorted(name for name in names if name[0].islower() and name not in inner)
    errors = sorted(name for name in names if name.endswith("Error"))
    page = "# Python\n\nFrom the docstrings of the package; how to use it: [Python package](../python.md).\n\n"
    others = sorted(set(names) - set(functions) - set(errors) - set(inner))
    for title, group in (("Functions", functions), ("Classes", others), ("Errors", errors)):
        page += f"## {title}\n\n" + "".join(f"::: perturb.{modules[name]}.{name}\n\n" for name in group)
    page += "".join(f"## perturb.{name}\n\n::: perturb.{name}\n\n" for name in inner)
    return {"reference/python.md": page + "## stable-baselines3\n\n::: perturb.sb3.make_vec_env\n"}


def pages(programs, folder):
    return {
        **environments(programs, folder),
        **leaderboard(programs),
        **commands(programs),
        **settings(programs),
        **experiment_files(),
        **protocol(),
        **python(),
    }
