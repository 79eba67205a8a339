"""Builds the site.

    build.py PROGRAMS FOLDER

PROGRAMS is where `perturb` and `perturb-server` are, FOLDER gets `source`, the pages as the generator reads them, and
`site`. To be called from the repository's root. A link to nowhere, in a file or a page, ends it with status 1.

Pages are the repository's own markdown, whose links work where the files are. Here they get other places, and links
follow: to pages, to copies of pictures and reports, and to copies of source files as pages; folders have none and are
left as words.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import reference

# Pages that are not in docs/ by their places in the site.
ELSEWHERE = {
    "python/README.md": "python.md",
    "docker/README.md": "docker.md",
    "results/README.md": "results.md",
    "CHANGELOG.md": "changelog.md",
}
COPIED = {".png", ".svg", ".html", ".csv"}
LANGUAGES = {".rs": "rust", ".py": "python", ".proto": "protobuf", ".toml": "toml"}
LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


class Links:
    """Where files of the repository are in the site; those that are not its pages by themselves come in when linked."""

    def __init__(self):
        pages = map(str, Path("docs").rglob("*.md"))
        self.places = {**{page: page.removeprefix("docs/") for page in pages}, **ELSEWHERE}
        self.waiting = list(self.places)
        self.broken = []

    def place(self, path):
        """That of a file, which comes in if it is not there yet; None for a folder without a page."""
        if Path(path).is_dir():
            path = f"{path}/README.md"
            if not Path(path).exists():
                return None
        if path not in self.places:
            whole = Path(path).suffix in COPIED | {".md"}
            self.places[path] = path if whole else f"source/{path}.md"
            self.waiting.append(path)
        return self.places[path]

    def follow(self, text, page):
        """The same text with links as the site has them."""

        def link(found):
            image, words, target = found.groups()
            path, _, anchor = target.partition("#")
            if not path or re.match(r"[a-z]+:", path):
                return found[0]
            linked = os.path.normpath(Path(page).parent / path)
            if not Path(linked).exists() or linked.startswith(".."):
                self.broken.append(f"{page}: {target}")
                return found[0]
            place = self.place(linked)
            if place is None:
                return words
            target = os.path.relpath(place, Path(self.places[page]).parent)
            if re.fullmatch(r"L\d+", anchor):
                anchor = ""  # lines have addresses on GitHub, but not on the site
            return f"{image}[{words}]({target}{'#' if anchor else ''}{anchor})"

        parts = re.split(r"(^ *```.*?^ *```$)", text, flags=re.MULTILINE | re.DOTALL)
        return "".join(part if i % 2 else LINK.sub(link, part) for i, part in enumerate(parts))


def indented(text):
    """The same lists for Python-Markdown, which wants four spaces where GitHub wants two, and an empty line before."""
    lines, in_list, in_code = [], False, False
    for line in text.splitlines():
        starts = re.match(r"(- |\d+\. )", line)
        if not in_code and line and not line.startswith(" "):
            if starts and not in_list and lines and lines[-1]:
                lines.append("")
            in_list = bool(starts)
        if line.strip().startswith("```"):
            in_code = not in_code
        lines.append(f"  {line}" if in_list and line.startswith("  ") else line)
    return "\n".join(lines) + "\n"


def stage(folder):
    """Writes the repository's pages, and everything that they link to."""
    links = Links()
    while links.waiting:
        path = links.waiting.pop()
        target = folder / links.places[path]
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.endswith(".md"):
            target.write_text(indented(links.follow(Path(path).read_text(), path)))
        elif Path(path).suffix in COPIED:
            shutil.copyfile(path, target)
        else:
            code = f"~~~~{LANGUAGES.get(Path(path).suffix, 'text')}\n{Path(path).read_text()}~~~~\n"
            target.write_text(f"---\nsearch:\n  exclude: true\n---\n\n# {path}\n\n{code}")
    if links.broken:
        sys.exit("\n".join(["Links to nowhere:", *links.broken]))


def main():
    programs, folder = Path(sys.argv[1]).resolve(), Path(sys.argv[2])
    source = folder / "source"
    shutil.rmtree(source, ignore_errors=True)
    shutil.rmtree(folder / "site", ignore_errors=True)
    stage(source)
    shutil.copytree("docs/pictures", source / "pictures", dirs_exist_ok=True)
    shutil.copytree("docs/site/assets", source / "assets")
    for place, text in reference.pages(programs, source).items():
        (source / place).parent.mkdir(parents=True, exist_ok=True)
        (source / place).write_text(text)
    shutil.copyfile("docs/site/mkdocs.yml", folder / "mkdocs.yml")
    command = [Path(sys.executable).with_name("zensical"), "build", "--clean", "--strict", "-f", folder / "mkdocs.yml"]
    environment = {**os.environ, "PYTHONPATH": str(Path("python/src").resolve())}
    if subprocess.run(command, env=environment, check=False).returncode:
        sys.exit(1)
    print(f"{folder / 'site' / 'index.html'}")


if __name__ == "__main__":
    main()
