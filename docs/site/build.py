"""Builds the site.

    build.py PROGRAMS FOLDER

PROGRAMS is the folder of `perturb` and `perturb-server`. FOLDER gets `source`, the pages for the generator, and `site`.
Run it in the repository's root. A broken link in a file or page ends it with status 1.

Pages are the repository's markdown files. Their links are changed to the site's addresses: to pages, to copies of
pictures and reports, and to copies of source files as pages. Folders have no page, so links to them become plain text.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import reference

# Pages from outside of docs/, by their paths in the site.
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
    """Maps files of the repository to the site. Files that are not pages are added when a page links to them."""

    def __init__(self):
        pages = map(str, Path("docs").rglob("*.md"))
        self.places = {**{page: page.removeprefix("docs/") for page in pages}, **ELSEWHERE}
        self.waiting = list(self.places)
        self.broken = []

    def place(self, path):
        """Return the address of a file and add it to the site. Return None for a folder without a page."""
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
        """Return the text with the site's links."""

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
    """Return the text with lists for Python-Markdown, which needs four spaces and an empty line before."""
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
    """Write the repository's pages and everything that they link to."""
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
