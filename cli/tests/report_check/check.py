"""Opens a report in headless Chromium, without network, and compares what it shows with the report's files.

    check.py CHROMIUM DIR PAGE SCREENSHOTS

DIR is an experiment with its folder report/, PAGE its HTML page, SCREENSHOTS a folder for pictures of the whole page. The
browser is driven over a pipe (the DevTools protocol), so that Python's own library is enough. Ends with 1 and a list of
what is wrong.
"""

import base64
import csv
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

# CSS pixels: a desktop, and a window as narrow as half of one.
WIDTHS = (1280, 700)
HEIGHT = 1600

# What the page shows, by its own account.
LOOK = """
(() => {
  const seen = element => { const box = element.getBoundingClientRect(); return box.width > 0 && box.height > 0; };
  const rows = id => document.querySelectorAll(`#${id} tbody tr`).length;
  return {
    rows: Object.fromEntries(['metrics', 'iqm', 'scenarios', 'cells'].map(id => [id, rows(id)])),
    uneven: [...document.querySelectorAll('table')].filter(table => {
      const width = table.querySelector('thead tr:last-child').cells.length;
      return [...table.querySelectorAll('tbody tr')].some(row => row.cells.length !== width);
    }).length,
    tables: [...document.querySelectorAll('table')].filter(seen).length,
    curves: [...document.querySelectorAll('#curves svg')].filter(seen).length,
    pictures: [...document.querySelectorAll('#profiles svg, #parameters svg, #thresholds svg')].filter(seen).length,
    heatmaps: [...document.querySelectorAll('#heatmaps svg')].filter(seen).length,
    without_heatmap: [...document.querySelectorAll('#heatmaps figure.missing')].filter(seen).length,
    without_curves: document.querySelectorAll('#curves li').length,
    unnamed: [...document.querySelectorAll('svg')].filter(picture => !picture.closest('[aria-label]')).length,
    dangling: [...document.querySelectorAll('nav a')].map(link => link.getAttribute('href'))
      .filter(link => !document.querySelector(link)),
    links: document.querySelectorAll('nav a').length,
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    height: document.documentElement.scrollHeight,
  };
})()
"""


class Browser:
    """Chromium with one page."""

    def __init__(self, program, profile):
        to_browser, self.requests = os.pipe()
        self.replies, from_browser = os.pipe()

        def pipes():  # the browser reads from 3 and writes to 4
            reading, writing = os.dup(to_browser), os.dup(from_browser)
            os.dup2(reading, 3)
            os.dup2(writing, 4)

        command = [program, "--headless", "--remote-debugging-pipe", f"--user-data-dir={profile}", "--disable-gpu"]
        command += ["--no-first-run", "--disable-background-networking", "--host-resolver-rules=MAP * ~NOTFOUND"]
        if os.geteuid() == 0:
            command.append("--no-sandbox")  # which root cannot have
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

    def look(self):
        return self.call("Runtime.evaluate", expression=LOOK, returnByValue=True)["result"]["value"]

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
    """What the page must have, by the report's tables and the folder's pictures."""
    report = directory / "report"
    metrics, iqm, scenarios, selected = (
        lines(report / f"{name}.csv") for name in ("metrics", "iqm", "scenarios", "selected")
    )
    several = len({line["environment"] for line in scenarios}) > 1
    shown = [line for line in metrics if several or line["environment"] != "Average"]
    failures = [path for path in directory.glob("cells/*/failure.json") if not (path.parent / "result.json").exists()]
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
    environments = len({line["environment"] for line in scenarios})
    compared = (report / "comparisons.csv").exists()
    settings = (report / "settings.csv").exists()
    files = [path for path in (report / "worst.csv", report / "footing.csv") if path.exists()]
    detailed = sum(len({line["environment"] for line in lines(path)}) for path in files)
    return {
        "rows": {
            "metrics": len(shown) // 3,  # three metrics in a row
            "iqm": len(iqm) // 3,
            "scenarios": len(scenarios) // 3,  # three tests in a row
            "cells": len(selected) + len(failures),
        },
        # Metrics, two over all environments, comparisons, Extrapolation and scenarios, worst and footing, settings, cells.
        "tables": environments + several + 2 + compared + 2 * environments + detailed + settings + 1 + bool(failures),
        "curves": 4 * len(with_curves),
        "pictures": sum(len(list(report.glob(f"*{name}.svg"))) for name in ("profiles", "-parameters", "-thresholds")),
        "without_curves": environments - len(with_curves),
        "heatmaps": len(tested),
        "without_heatmap": len(scenarios) // 9 - len(tested),
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
            for number, top in enumerate(range(0, seen["height"], HEIGHT)):
                clip = {"x": 0, "y": top, "width": width, "height": min(HEIGHT, seen["height"] - top), "scale": 1}
                shot = browser.call("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
                (screenshots / f"{width}-{number:02}.png").write_bytes(base64.b64decode(shot["data"]))
        pdf = browser.call("Page.printToPDF", preferCSSPageSize=True, printBackground=False)
        (screenshots / "print.pdf").write_bytes(base64.b64decode(pdf["data"]))
        said = {"Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"}
        check("said on the console", [event for event in browser.events if event["method"] in said], [])
        asked = {
            event["params"]["request"]["url"]
            for event in browser.events
            if event["method"] == "Network.requestWillBeSent"
        }
        check("asked for", {address for address in asked if not address.startswith("data:")}, {url})
        browser.end()

    if wrong:
        sys.exit("\n".join([f"{page} is not as it should be:", *wrong]))
    figures = ", ".join(f"{number} {name}" for name, number in expected["rows"].items())
    print(
        f"{page}: rows of {figures}; {expected['tables']} tables, {expected['curves']} curves,"
        f" {expected['pictures']} other pictures and {expected['heatmaps']} heatmaps; pictures of it in {screenshots}"
    )


if __name__ == "__main__":
    main()
