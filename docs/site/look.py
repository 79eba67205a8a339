"""Checks the built site in headless Chromium, at the widths of a desktop and of a phone, light and dark.

    look.py CHROMIUM SITE PICTURES

SITE is the built site, PICTURES a folder for pictures of some pages. Every page must ask for nothing of another host,
say nothing on the console, and be no wider than its window; a search must find something. Ends with 1 and a list of
what is wrong.
"""

import base64
import functools
import http.server
import re
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2] / "cli/tests/report_check"))
from check import Browser

WIDTHS = {1280: 900, 400: 800}
# Pages of which pictures are made: one of each kind.
DRAWN = [
    "index.html",
    "tutorials/train-break-mend.html",
    "environments/CartPole.html",
    "environments/Hopper.html",
    "environments.html",
    "algorithms.html",
    "reference/settings.html",
    "reference/commands.html",
    "reference/protocol.html",
    "reference/python.html",
    "checkpoints.html",
    "results.html",
]
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
# A script that returns whether the search is open, and the number of its results. The search is in a shadow tree.
SEARCH_STATE = """
(() => {
  const tree = [...document.querySelectorAll('*')].map(element => element.shadowRoot).find(root => root);
  return [tree?.querySelector('dialog')?.open ?? false, tree?.querySelectorAll('[role=option]').length ?? 0];
})()
"""
OPEN = "document.querySelector('.md-search__button').click()"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


def main():
    program, site, pictures = sys.argv[1], Path(sys.argv[2]).resolve(), Path(sys.argv[3])
    pictures.mkdir(parents=True, exist_ok=True)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    own = f"http://127.0.0.1:{server.server_port}/"
    # Reports among the results are checked by report_check.sh.
    pages = sorted(str(path.relative_to(site)) for path in site.rglob("*.html"))
    pages = [page for page in pages if not re.match(r"results/.*report\.html", page)]
    wrong = []
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(program, profile, reachable="127.0.0.1")
        for domain in ("Page", "Runtime", "Log", "Network"):
            browser.call(f"{domain}.enable")
        for scheme in ("light", "dark"):
            media = [{"name": "prefers-color-scheme", "value": scheme}]
            browser.call("Emulation.setEmulatedMedia", features=media)
            for page in pages if scheme == "light" else DRAWN:
                browser.events.clear()
                browser.call("Page.navigate", url=own + page)
                browser.wait_for("Page.loadEventFired")
                for width, height in WIDTHS.items():
                    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
                    browser.call("Emulation.setDeviceMetricsOverride", **metrics)
                    if page in DRAWN:
                        time.sleep(0.3)
                        shot = browser.call("Page.captureScreenshot")
                        name = f"{page.removesuffix('.html').replace('/', '-')}-{width}-{scheme}.png"
                        (pictures / name).write_bytes(base64.b64decode(shot["data"]))
                    wider = browser.call("Runtime.evaluate", expression=WIDER, returnByValue=True)["result"]["value"]
                    if wider > 0:
                        wrong.append(f"{page}: {wider} pixels wider than {width}")
                wrong += [f"{page}: {complaint}" for complaint in complaints(browser.events, own)]
        browser.call("Emulation.setDeviceMetricsOverride", width=1280, height=900, deviceScaleFactor=1, mobile=False)
        browser.call("Page.navigate", url=own + "index.html")
        browser.wait_for("Page.loadEventFired")
        if not searched(browser, "epsilon"):
            wrong.append("the search for epsilon found nothing")
        browser.end()
    server.shutdown()
    if wrong:
        sys.exit("\n".join(["The site is not as it should be:", *wrong]))
    print(f"{len(pages)} pages at {', '.join(map(str, WIDTHS))} pixels; pictures of {len(DRAWN)} in {pictures}")


def searched(browser, words):
    """Return the number of a search's results. Wait some seconds, because its script may not be loaded yet."""

    def until(wanted, attempt):
        for _ in range(60):
            shown = browser.call("Runtime.evaluate", expression=SEARCH_STATE, returnByValue=True)["result"]["value"]
            if shown[wanted]:
                break
            attempt()
            time.sleep(0.5)
        return shown[wanted]

    if until(0, lambda: browser.call("Runtime.evaluate", expression=OPEN)):
        browser.call("Input.insertText", text=words)
    return until(1, lambda: None)


def complaints(events, own):
    """Requests to other hosts, and messages on the console."""
    for event in events:
        method, said = event["method"], event["params"]
        if method == "Network.requestWillBeSent":
            if not said["request"]["url"].startswith((own, "data:", "blob:")):
                yield f"asks for {said['request']['url']}"
        elif method in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
            yield f"says {said}"


if __name__ == "__main__":
    main()
