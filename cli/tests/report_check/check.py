"""Opens a report in headless Chromium, without network, and compares its content with the report's files.

    check.py CHROMIUM DIR PAGE SCREENSHOTS

DIR is an experiment with its folder report/, and PAGE is its HTML page. The folder SCREENSHOTS gets pictures of the
whole page: light at three widths, dark, and printed. The script controls the browser with the DevTools protocol over a
pipe, so that it needs only Python's standard library. After a failure, the exit status is 1 and a list of the faults is
printed.
"""

import base64
import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

# Widths of the window in CSS pixels: a desktop, half a desktop, and a telephone.
WIDTHS = (1280, 700, 400)
HEIGHT = 1600
# Width of A4 paper without its margins, in CSS pixels.
PAPER = 703

# JavaScript that counts the elements of the page and measures its layout.
LOOK = """
(() => {
  const seen = element => { const box = element.getBoundingClientRect(); return box.width > 0 && box.height > 0; };
  const rows = id => document.querySelectorAll(`#${id} tbody tr`).length;
  return {
    rows: Object.fromEntries(['metrics', 'scenarios'].map(id => [id, rows(id)])),
    uneven: [...document.querySelectorAll('table')].filter(table => {
      const width = table.querySelector('thead tr:last-child').cells.length;
      return [...table.querySelectorAll('tbody tr')].some(row => row.cells.length !== width);
    }).length,
    tables: [...document.querySelectorAll('table')].filter(seen).length,
    curves: [...document.querySelectorAll('#curves svg')].filter(seen).length,
    findings: [...document.querySelectorAll('#finding svg, #metrics svg')].filter(seen).length,
    first: document.querySelector('main svg').closest('section').id,
    pictures: [...document.querySelectorAll('#statistics svg')].filter(seen).length,
    heatmaps: [...document.querySelectorAll('#heatmaps svg')].filter(seen).length,
    without_curves: [...document.querySelectorAll('#provenance li')].filter(li => li.textContent.includes('monitor.csv')).length,
    unnamed: [...document.querySelectorAll('svg')].filter(picture => !picture.closest('[aria-label]')).length,
    dangling: [...document.querySelectorAll('nav a')].map(link => link.getAttribute('href'))
      .filter(link => !document.querySelector(link)),
    links: document.querySelectorAll('nav a').length,
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    height: document.documentElement.scrollHeight,
    // Maximum number of pictures side by side.
    abreast: (() => {
      const boxes = [...document.querySelectorAll('main svg')].map(svg => svg.getBoundingClientRect());
      return Math.max(...boxes.map(a => boxes.filter(b => b.top < a.top + 1 && a.top + 1 < b.bottom).length));
    })(),
    // Position of the table of contents in the window when the middle of the page is in view.
    contents: (() => {
      scrollTo(0, document.documentElement.scrollHeight / 2);
      const top = document.querySelector('nav').getBoundingClientRect().top;
      scrollTo(0, 0);
      return top;
    })(),
  };
})()
"""

# JavaScript that returns the names of figures whose links do not lead to the shown picture and to its numbers.
FILES = """
[...document.querySelectorAll('figure:not(.missing)')].filter(figure => {
  const content = kind => {
    const link = figure.querySelector(`a[download$=".${kind}"]`);
    return link && link.href.startsWith('data:') ? decodeURIComponent(link.href.slice(link.href.indexOf(',') + 1)) : '';
  };
  const drawn = new DOMParser().parseFromString(content('svg'), 'image/svg+xml').documentElement;
  const same = drawn.tagName === 'svg' && drawn.textContent === figure.querySelector('svg').textContent;
  return !same || content('csv').trim().split('\\n').length < 2;
}).map(figure => figure.querySelector('[aria-label]').getAttribute('aria-label'))
"""

# JavaScript that counts faulty texts: smaller than 9 pt if the picture is 85 mm wide, or with less contrast than WCAG
# requires.
TEXTS = """
(() => {
  const linear = c => c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
  const luminance = colour => {
    const [r, g, b] = colour.match(/[0-9.]+/g).slice(0, 3).map(c => linear(c / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const paper = luminance(getComputedStyle(document.body).backgroundColor);
  const contrast = colour => (Math.max(luminance(colour), paper) + 0.05) / (Math.min(luminance(colour), paper) + 0.05);
  const texts = [...document.querySelectorAll('main svg text')];
  const points = text => text.getAttribute('font-size') / text.ownerSVGElement.viewBox.baseVal.width * 85 / 25.4 * 72;
  const words = [...document.querySelectorAll('h1, h2, h3, p, th, dt, dd, figcaption, a, td:not([style])')];
  return {
    texts: texts.length,
    paper,
    small: texts.filter(text => points(text) < 9).length,
    faint: texts.filter(text => contrast(getComputedStyle(text).fill) < 4.5).length
      + words.filter(word => contrast(getComputedStyle(word).color) < 4.5).length,
    // Pictures whose background differs from the background of the page.
    sheets: [...document.querySelectorAll('main svg')].filter(svg =>
      Math.abs(luminance(getComputedStyle(svg.querySelector('[fill="#FFFFFF"]')).fill) - paper) > 0.001).length,
  };
})()
"""

# JavaScript that measures the printed layout.
PRINTED = """
(() => {
  const millimetres = pixels => pixels / 96 * 25.4;
  const figures = [...document.querySelectorAll('figure:not(.missing)')];
  return {
    contents: getComputedStyle(document.querySelector('nav')).display,
    paper: getComputedStyle(document.body).backgroundColor,
    widths: [...new Set([...document.querySelectorAll('main svg')].map(svg =>
      Math.round(millimetres(svg.getBoundingClientRect().width))))],
    // If an element is wider than the paper, the browser scales the whole page down.
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    // The height of A4 paper without its margins is 269 mm.
    cut: figures.filter(figure => millimetres(figure.getBoundingClientRect().height) > 269
      || getComputedStyle(figure).breakInside !== 'avoid').length,
  };
})()
"""


class Browser:
    """Chromium with one page. It can reach only the host `reachable`, or no host if that is empty."""

    def __init__(self, program, profile, reachable=""):
        to_browser, self.requests = os.pipe()
        self.replies, from_browser = os.pipe()

        def pipes():  # the browser reads from file descriptor 3 and writes to 4
            reading, writing = os.dup(to_browser), os.dup(from_browser)
            os.dup2(reading, 3)
            os.dup2(writing, 4)

        command = [program, "--headless", "--remote-debugging-pipe", f"--user-data-dir={profile}", "--disable-gpu"]
        rules = f"MAP * ~NOTFOUND, EXCLUDE {reachable}" if reachable else "MAP * ~NOTFOUND"
        command += ["--no-first-run", "--disable-background-networking", f"--host-resolver-rules={rules}"]
        if os.geteuid() == 0:
            command.append("--no-sandbox")  # the sandbox does not work for root
        self.process = subprocess.Popen(
            command, preexec_fn=pipes, close_fds=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(to_browser)
        os.close(from_browser)
        self.count, self.rest, self.events, self.session = 0, b"", [], None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def call(self, method, **parameters):
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self.requests, json.dumps(message).encode() + b"\0")
        while True:
            reply = self.read()
            if reply.get("id") == self.count:
                if "error" in reply:
                    raise RuntimeError(f"{method}: {reply['error']['message']}")
                return reply["result"]
            self.events.append(reply)

    def wait_for(self, name):
        while not any(event.get("method") == name for event in self.events):
            self.events.append(self.read())

    def read(self):
        while b"\0" not in self.rest:
            more = os.read(self.replies, 1 << 20)
            if not more:
                raise RuntimeError("the browser ended")
            self.rest += more
        message, self.rest = self.rest.split(b"\0", 1)
        return json.loads(message)

    def look(self, expression=LOOK):
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"]["value"]

    def show(self, media="", scheme="light"):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", media=media, features=features)

    def shoot(self, folder, name, width, height):
        """Takes screenshots of the whole page, from top to bottom."""
        for number, top in enumerate(range(0, height, HEIGHT)):
            clip = {"x": 0, "y": top, "width": width, "height": min(HEIGHT, height - top), "scale": 1}
            shot = self.call("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
            (folder / f"{name}-{number:02}.png").write_bytes(base64.b64decode(shot["data"]))

    def resize(self, width):
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=HEIGHT, deviceScaleFactor=1, mobile=False
        )

    def end(self):
        self.session = None
        try:
            self.call("Browser.close")
        except (RuntimeError, OSError):
            pass
        self.process.wait(timeout=60)


def lines(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def expectations(directory):
    """Returns the numbers of elements that the page must have, according to the files of the report."""
    report = directory / "report"
    metrics, scenarios, selected = (lines(report / f"{name}.csv") for name in ("metrics", "scenarios", "selected"))
    environments = {line["environment"] for line in scenarios}
    several = len(environments) > 1
    shown = [line for line in metrics if several or line["environment"] != "Average"]
    with_curves = {
        line["environment"]
        for line in selected
        if (directory / "cells" / line["cell"] / "training" / "monitor.csv").exists()
    }
    tested = {
        (line["environment"], line["algorithm"], line["architecture"])
        for line in selected
        if any((directory / "heatmaps").glob(f"{line['cell']}-*.csv"))
    }
    pairs = (report / "comparisons.csv").exists()
    return {
        "rows": {
            "metrics": len(shown) // 3,  # a row has three metrics
            "scenarios": len(scenarios) // 3,  # a row has three tests
        },
        # Tables of metrics, scenarios, interquartile means and pairs.
        "tables": 2 * len(environments) + several + 1 + pairs,
        "findings": len(list(report.glob("*finding.svg"))),
        "first": "finding",
        "curves": 4 * len(with_curves),
        "pictures": len(list(report.glob("profiles.svg"))),
        "without_curves": len(environments - with_curves),
        "heatmaps": len(tested) + len(list(report.glob("*-parameters.svg"))),
    }


def main():
    program, directory, page, screenshots = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), Path(sys.argv[4])
    screenshots.mkdir(parents=True, exist_ok=True)
    wrong = []

    def check(what, got, expected):
        if got != expected:
            wrong.append(f"{what}: {got}, expected {expected}")

    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(program, profile)
        for domain in ("Page", "Runtime", "Log", "Network"):
            browser.call(f"{domain}.enable")
        browser.call(
            "Network.emulateNetworkConditions", offline=True, latency=0, downloadThroughput=0, uploadThroughput=0
        )
        url = page.resolve().as_uri()
        browser.resize(WIDTHS[0])
        browser.call("Page.navigate", url=url)
        browser.wait_for("Page.loadEventFired")
        expected = expectations(directory)
        for width in WIDTHS:
            browser.resize(width)
            seen = browser.look()
            for what, number in expected.items():
                check(f"{what} at {width}", seen[what], number)
            check(f"rows as long as their table's head at {width}", seen["uneven"], 0)
            check(f"pictures without a name at {width}", seen["unnamed"], 0)
            check(f"links to nowhere at {width}", seen["dangling"], [])
            check(f"pixels wider than the window of {width}", seen["overflow"], 0)
            check(f"pictures abreast at {width}", seen["abreast"], 2 if width > 800 else 1)
            check(f"contents in sight at {width}", 0 <= seen["contents"] < HEIGHT, True)
            browser.shoot(screenshots, width, width, seen["height"])
        check("figures whose links do not lead to their files", browser.look(FILES), [])
        for scheme in ("light", "dark"):
            browser.show(scheme=scheme)
            texts = browser.look(TEXTS)
            check(f"there are texts in pictures, {scheme}", texts["texts"] > 100, True)
            check(f"the page is {scheme}", texts["paper"] > 0.5, scheme == "light")
            for what in ("small", "faint", "sheets"):
                check(f"{what}, {scheme}", texts[what], 0)
        browser.resize(WIDTHS[0])
        browser.shoot(screenshots, "dark", WIDTHS[0], browser.look()["height"])
        browser.resize(PAPER)
        browser.show(media="print", scheme="dark")  # the printed page must be light in dark mode, too
        printed = browser.look(PRINTED)
        expected_print = {
            "contents": "none",
            "paper": "rgb(255, 255, 255)",
            "widths": [85],
            "overflow": 0,
            "cut": 0,
        }
        check("printed", printed, expected_print)
        browser.show()
        browser.resize(WIDTHS[0])
        pdf = browser.call("Page.printToPDF", preferCSSPageSize=True, printBackground=False)
        (screenshots / "print.pdf").write_bytes(base64.b64decode(pdf["data"]))
        said = {"Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"}
        check("console messages", [event for event in browser.events if event["method"] in said], [])
        asked = {
            event["params"]["request"]["url"]
            for event in browser.events
            if event["method"] == "Network.requestWillBeSent"
        }
        check("requested URLs", {address for address in asked if not address.startswith("data:")}, {url})
        browser.end()

    if wrong:
        sys.exit("\n".join([f"{page} is not as it should be:", *wrong]))
    figures = ", ".join(f"{number} {name}" for name, number in expected["rows"].items())
    print(
        f"{page}: rows of {figures}; {expected['tables']} tables, {expected['curves']} curves,"
        f" {expected['findings']} of the finding, {expected['pictures']} other pictures and {expected['heatmaps']} heatmaps; pictures of it in {screenshots}"
    )


if __name__ == "__main__":
    main()
