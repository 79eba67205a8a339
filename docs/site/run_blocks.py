"""Runs the code blocks of pages, in order, each page in a temporary directory.

    run_blocks.py PROGRAMS [PAGE …]

PROGRAMS is where `perturb` and `perturb-server` are; pages are README.md, the tutorials and others of docs/ that say
how something is done. To be called from the repository's root, with a Python that can import perturb.

Blocks of sh run in bash, which ends at the first error; those of python share one namespace in a page. A block of text
that follows one is what it prints: each of its lines must be there. A comment `<!-- not run: REASON -->` above a block
skips it. A picture that a page shows and that its blocks made must have the same bytes. Ends with 1 if a block fails,
or if a page has none that ran.
"""

import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

PAGES = [
    "README.md",
    "docs/index.md",
    *sorted(map(str, Path("docs/tutorials").glob("*.md"))),
    "docs/checkpoints.md",
    "docs/coming-from.md",
]
BLOCK = re.compile(r"^(?:<!-- not run: (.*?) -->\n)?```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


class Page:
    """The code blocks of a page, and the directory in which they run."""

    def __init__(self, path, folder):
        self.path, self.folder = path, Path(folder)
        self.text = Path(path).read_text()
        self.namespace = {"__name__": "__main__"}
        self.sessions = []

    def run(self):
        """Run all blocks. Return their number, or end the program if one fails."""
        ran, printed = 0, None
        for block in BLOCK.finditer(self.text):
            reason, language, code = block.groups()
            place = f"{self.path}:{self.text[: block.start(3)].count(chr(10))}"
            start = time.monotonic()
            if reason:
                print(f"  {place}: skipped: {reason}")
                printed = None
            elif language == "text" and printed is not None:
                self.compare(place, code, printed)
            elif language in ("sh", "python"):
                printed = (self.shell if language == "sh" else self.python)(code, place)
                ran += 1
                print(f"  {place}: {language}, {time.monotonic() - start:.1f} s", flush=True)
        if not ran:
            sys.exit(f"{self.path}: no block ran")
        self.pictures()
        return ran

    def shell(self, code, place):
        # The output goes to a file, because a server in the background would hold a pipe open.
        with tempfile.TemporaryFile("w+") as output:
            command = ["bash", "-euo", "pipefail", "-c", code]
            process = subprocess.Popen(
                command, cwd=self.folder, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )
            self.sessions.append(process.pid)
            status = process.wait()
            output.seek(0)
            printed = output.read()
        if status:
            sys.exit(f"{printed}\n{place}: bash ended with {status}")
        return printed

    def python(self, code, place):
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed), contextlib.chdir(self.folder):
                exec(compile("\n" * int(place.rpartition(":")[2]) + code, self.path, "exec"), self.namespace)
        except (Exception, SystemExit):  # noqa: BLE001, a block may raise anything
            sys.exit(f"{printed.getvalue()}{traceback.format_exc()}\n{place}: python failed")
        return printed.getvalue()

    def compare(self, place, expected, printed):
        plain = {" ".join(line.split()) for line in printed.splitlines()}
        for line in expected.splitlines():
            if " ".join(line.split()) not in plain:
                sys.exit(f"{printed}\n{place}: not printed: {line}")

    def pictures(self):
        for target in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", self.text):
            made = self.folder / Path(target).name
            if made.exists() and made.read_bytes() != (Path(self.path).parent / target).read_bytes():
                sys.exit(f"{self.path}: {target} is not what the page's blocks make: {made.stat().st_size} bytes")

    def end(self):
        """End the processes that the blocks left in the background."""
        self.namespace.clear()
        for session in self.sessions:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(session, signal.SIGTERM)


def main():
    programs = Path(sys.argv[1]).resolve()
    os.environ["PATH"] = f"{programs}:{os.environ['PATH']}"
    os.environ["PERTURB_SERVER"] = str(programs / "perturb-server")
    for path in sys.argv[2:] or PAGES:
        print(path, flush=True)
        with tempfile.TemporaryDirectory() as folder:
            for part in ("experiments", "proto", "results"):  # as in a clone
                (Path(folder) / part).symlink_to(Path(part).resolve())
            page = Page(path, folder)
            try:
                page.run()
            finally:
                page.end()


if __name__ == "__main__":
    main()
