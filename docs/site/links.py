"""Checks the relative links of the repository's documents, by GitHub's rules, and of the built site.

    links.py SITE

A link to a line of a source file must show the code that it names, see code_links.py. Call this program from the
repository's root. It ends with status 1 and a list of the links that lead nowhere.
"""

import html.parser
import os
import re
import sys
from pathlib import Path
from urllib.parse import unquote

import code_links

DOCUMENTS = [*Path().glob("*.md"), *Path("docs").rglob("*.md")]
DOCUMENTS += [Path(folder) / "README.md" for folder in ("python", "docker", "results")]


class HtmlPage(html.parser.HTMLParser):
    """Anchors and links of an HTML page."""

    def __init__(self, text):
        super().__init__()
        self.names, self.links = {""}, []
        self.feed(text)

    def handle_starttag(self, _, attributes):
        attributes = dict(attributes)
        self.names |= {attributes.get("id"), attributes.get("name")}
        self.links += [attributes[key] for key in ("href", "src") if attributes.get(key)]


class Document:
    """Anchors and links of a markdown file, by GitHub's rules."""

    def __init__(self, text):
        prose = re.sub(r"^ *(```|~~~).*?^ *\1$", "", text, flags=re.MULTILINE | re.DOTALL)
        self.links = re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose))
        self.names, counts = {""}, {}
        for heading in re.findall(r"^#+ (.*)", prose, re.MULTILINE):
            plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
            name = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
            counts[name] = counts.get(name, -1) + 1
            self.names.add(f"{name}-{counts[name]}" if counts[name] else name)


def broken(paths, parse):
    """Return the number of links in these files, and the broken ones."""
    parsed = {}

    def parsed_file(path):
        if path not in parsed:
            parsed[path] = parse(path.read_text())
        return parsed[path]

    count, found = 0, []
    for path in paths:
        for link in parsed_file(path).links:
            if re.match(r"[a-z]+:|//", link):
                continue
            count += 1
            target, _, name = link.partition("#")
            target = path.parent / unquote(target) if target else path
            target = Path(os.path.normpath(target))
            if not target.exists():
                found.append(f"{path}: {link}")
            elif name and target.suffix == path.suffix and unquote(name) not in parsed_file(target).names:
                found.append(f"{path}: {link}: no such heading")
    return count, found


def main():
    site = Path(sys.argv[1])
    # The error page is shown at any address, so its links begin at the root. Reports are not pages of the site.
    pages = [page for page in site.rglob("*.html") if page.name not in ("404.html", "report.html")]
    wrong = []
    for what, paths, parse in (("documents", DOCUMENTS, Document), ("pages", pages, HtmlPage)):
        count, found = broken(paths, parse)
        wrong += found
        print(f"{count} links of {len(paths)} {what}")
    count, found = code_links.broken(DOCUMENTS)
    wrong += found
    print(f"{count} links to lines")
    if wrong:
        sys.exit("\n".join(["Links to nowhere:", *wrong]))


if __name__ == "__main__":
    main()
