"""Checks links to lines of source files.

    code_links.py [--write] FILE...

A link [`CODE`](PATH#L12) must point to a line that contains CODE. --write corrects the numbers: each link then points
to the nearest line that contains its CODE. Call this program from the repository's root. It ends with status 1 and a
list of the links that show something else.
"""

import os
import re
import sys
from pathlib import Path

LINK = re.compile(r"\[`([^`]+)`\]\(([^)#\s]+)#L(\d+)\)")


def line_of(code, lines, number):
    """Return the number of the line with `code` nearest to `number`, counted from 1. Return None if there is none."""
    found = [i for i, line in enumerate(lines, 1) if code in line]
    return min(found, key=lambda i: abs(i - number), default=None)


def corrected(document, text, lines_of):
    """Return the text with corrected line numbers, the number of links, and their faults."""
    count, wrong = 0, []

    def check(link):
        nonlocal count
        count += 1
        code, target, number = link[1], link[2], int(link[3])
        path = os.path.normpath(document.parent / target)
        lines = lines_of(path)
        if lines is None:
            wrong.append(f"{document}: {target} does not exist")
            return link[0]
        now = line_of(code, lines, number)
        if now is None:
            wrong.append(f"{document}: {target}#L{number}: no line contains `{code}`; describe the present code")
            return link[0]
        if now != number:
            wrong.append(
                f"{document}: {target}#L{number}: `{code}` is in line {now}; correct it with code_links.py --write"
            )
        return f"[`{code}`]({target}#L{now})"

    return LINK.sub(check, text), count, wrong


def read_lines(path):
    """Return the lines of a file, or None if it does not exist."""
    path = Path(path)
    return path.read_text().splitlines() if path.is_file() else None


def broken(documents):
    """Return the number of links to lines in these documents, and their faults."""
    checked = [corrected(document, document.read_text(), read_lines) for document in documents]
    return sum(count for _, count, _ in checked), [sentence for *_, wrong in checked for sentence in wrong]


def main():
    write = "--write" in sys.argv
    documents = [Path(name) for name in sys.argv[1:] if name != "--write"]
    if write:
        for document in documents:
            document.write_text(corrected(document, document.read_text(), read_lines)[0])
    count, wrong = broken(documents)
    print(f"{count} links to lines")
    if wrong:
        sys.exit("\n".join(wrong))


if __name__ == "__main__":
    main()
