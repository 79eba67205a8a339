"""Checks the pages of `perturb serve` in headless Chromium while a training and an experiment run.

    watch.py CHROMIUM PROGRAMS DIR

PROGRAMS is the folder of `perturb` and `perturb-server`. DIR is deleted and made again. Its folder runs/ is served, and
its folder pictures/ gets screenshots of the pages at widths of 1280 and 400 pixels, light and dark. The check fails if
curves, cells or the report do not grow without a reload, if a page prints to the console or requests something from
another host, or if a page is wider than its window. At the end, Ctrl-C must end the server although pages are open.
After a failure, the exit status is 1 and a list of the faults is printed.
"""

import base64
import contextlib
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "report_check"))
from check import Browser

WIDTHS = {1280: 900, 400: 800}
LIMIT = 300  # upper bound of every wait, s; it is long because the machine may be busy
WIDER = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
LIVE = "document.getElementById('live').dataset.state === 'live'"
# JavaScript that returns the last x value of the learning curve, an episode or a step.
REACH = "Number(document.querySelector('[data-chart=return]').dataset.reach ?? 0)"
DONE = "document.querySelectorAll('.map li.done').length"
REPORTED = "document.querySelector('iframe.report').contentDocument?.body.innerText.includes('WORDS') ?? false"
# The possible colours of the lines in each plot. A plot of several runs has the colours of `cells`, one for each kind.
LINES = {"return": ["#0072b2"], "success": ["#009e73"], "length": ["#cc79a7"], "speed": ["#d55e00"]}
LINES["cells"] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d00", "#7f7f7f"]
# JavaScript that returns the name of each drawn plot, with its number of pixels in a colour of its lines.
PAINTED = """[...document.querySelectorAll('figure.chart canvas')].map(canvas => {
  const name = canvas.closest('figure').dataset.chart;
  const several = canvas.closest('figure').querySelector('.legend') !== null;
  const lines = LINES[several ? 'cells' : name].map(colour => [1, 3, 5].map(place => parseInt(colour.slice(place, place + 2), 16)));
  const copy = document.createElement('canvas');
  [copy.width, copy.height] = [canvas.width, canvas.height];
  const context = copy.getContext('2d', {willReadFrequently: true});
  context.drawImage(canvas, 0, 0);
  const {data} = context.getImageData(0, 0, copy.width, copy.height);
  let count = 0;
  for (let place = 0; place < data.length; place += 4)
    count += data[place + 3] > 200 && lines.some(line => line.every((value, i) => Math.abs(value - data[place + i]) < 12));
  return [name, count];
})""".replace("LINES", json.dumps(LINES))
CURVES = list(LINES)[:4]
# Minimum number of coloured pixels by which a plot counts as having a line.
LEAST_LINE = 100
UNNAMED = """
[...document.querySelectorAll('img:not([alt]), [role=img]:not([aria-label]), iframe:not([title]), progress:not([aria-label])')]
  .length
"""
BROKEN = "[...document.images].filter(image => image.complete && image.naturalWidth === 0).map(image => image.src)"


class Pages:
    """The pages of a server in a browser, and the faults that were found in them."""

    def __init__(self, browser, own, pictures):
        self.browser, self.own, self.pictures, self.wrong = browser, own, pictures, []

    def evaluate(self, expression):
        reply = self.browser.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return reply["result"].get("value")

    def check(self, what, got, expected):
        if got != expected:
            self.wrong.append(f"{what}: {got}, expected {expected}")

    def until(self, what, expression):
        """Waits until the JavaScript expression is true. Returns its value, or False after the limit."""
        start = time.monotonic()
        while not (seen := self.evaluate(expression)):
            if time.monotonic() - start > LIMIT:
                self.wrong.append(f"{what} did not happen")
                return False
            time.sleep(0.2)
        return seen

    def open(self, path):
        self.browser.events[:] = [event for event in self.browser.events if event["method"] != "Page.loadEventFired"]
        self.browser.call("Page.navigate", url=self.own + path)
        self.browser.wait_for("Page.loadEventFired")
        self.evaluate("window.since = 'the beginning'")
        self.until(f"{path or 'the list'}: live", LIVE)

    def stayed(self, what):
        self.check(f"{what}: the page was not loaded again", self.evaluate("window.since"), "the beginning")

    def draw(self, name, plots=(), schemes=("light", "dark")):
        """Takes screenshots at all widths and colour schemes, and checks the layout of each.

        The page must have exactly the plots in `plots`, unless `plots` is None. Each plot must have a line.
        """
        for scheme in schemes:
            self.browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
            for width, height in WIDTHS.items():
                metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
                self.browser.call("Emulation.setDeviceMetricsOverride", **metrics)
                time.sleep(0.7)
                tall = min(2800, self.evaluate("document.documentElement.scrollHeight"))
                clip = {"x": 0, "y": 0, "width": width, "height": tall, "scale": 1}
                shot = self.browser.call("Page.captureScreenshot", clip=clip, captureBeyondViewport=True)
                (self.pictures / f"{name}-{width}-{scheme}.png").write_bytes(base64.b64decode(shot["data"]))
                self.check(f"{name}: pixels wider than {width}", max(0, self.evaluate(WIDER)), 0)
                painted = self.evaluate(PAINTED)
                if plots is not None:
                    self.check(f"{name}: plots at {width}", [plot for plot, _ in painted], list(plots))
                bare = [(plot, count) for plot, count in painted if count < LEAST_LINE]
                self.check(f"{name}: plots without a line at {width}, with the pixels that have its colour", bare, [])
        self.check(f"{name}: elements without an accessible name", self.evaluate(UNNAMED), 0)
        self.check(f"{name}: pictures that do not load", self.evaluate(BROKEN), [])
        first, last = schemes[0], next(iter(WIDTHS))
        self.browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": first}])
        metrics = {"width": last, "height": WIDTHS[last], "deviceScaleFactor": 1, "mobile": False}
        self.browser.call("Emulation.setDeviceMetricsOverride", **metrics)

    def complaints(self):
        """Yields a sentence for each request to another host, and for each message on the console."""
        for event in self.browser.events:
            method, said = event["method"], event["params"]
            if method == "Network.requestWillBeSent" and not said["request"]["url"].startswith((self.own, "data:", "about:")):
                yield f"a page asks for {said['request']['url']}"
            elif method in ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"):
                yield f"a page says {said}"


def main():
    chromium, programs, directory = sys.argv[1], Path(sys.argv[2]).resolve(), Path(sys.argv[3]).resolve()
    shutil.rmtree(directory, ignore_errors=True)
    runs, pictures = directory / "runs", directory / "pictures"
    runs.mkdir(parents=True)
    pictures.mkdir()
    with contextlib.ExitStack() as ending:

        def start(program, *arguments, log):
            output = ending.enter_context(open(directory / log, "w"))
            command = [programs / program, *map(str, arguments)]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=output, text=True, cwd=directory)
            ending.callback(end, process)
            return process

        def perturb(*arguments):
            subprocess.run([programs / "perturb", "-q", *map(str, arguments)], cwd=directory, check=True, stdout=subprocess.DEVNULL)

        worker = start("perturb-server", "--listen", "tcp://127.0.0.1:0", "--workers", "2", log="server.log")
        address = worker.stdout.readline().split()[-1]
        server = start("perturb", "serve", "runs", "--address", "0", "--server", address, log="serve.log")
        own = server.stdout.readline().strip() + "/"

        mine = runs / "finished"
        perturb("train", "--env", "CartPole", "--episodes", "300", "--out", mine, "--server", address)
        perturb("heatmap", "--checkpoint", mine, "--grid", "8", "--episodes", "2", "--out", mine / "heatmap", "--server", address)
        perturb("video", "--checkpoint", mine, "--out", mine / "film.gif", "--server", address)
        training = ["--env", "CartPole", "--version", "R", "--episodes", "1000000", "--out", "runs/cart-pole-on-R"]
        training = start("perturb", "train", *training, "--server", address, log="train.log")

        browser = Browser(chromium, ending.enter_context(tempfile.TemporaryDirectory()), reachable="127.0.0.1")
        ending.callback(browser.end)
        for domain in ("Page", "Runtime", "Log", "Network"):
            browser.call(f"{domain}.enable")
        pages = Pages(browser, own, pictures)
        watch_training(pages)
        plan = Path(__file__).with_name("plan.toml")
        experiment = start("perturb", "run", plan, "--out", "runs/study", "--group", "2", "--server", address, log="run.log")
        watch_experiment(pages, experiment)
        pages.open("")
        pages.check("rows of the list", pages.evaluate("document.querySelectorAll('.runs tbody tr').length"), 3)
        pages.until("the server's answer", "document.getElementById('server').innerText.includes('takes sessions')")
        pages.draw("list")
        watch_curves(pages)
        pages.open("run/finished")
        loaded = "[...document.images].every(image => image.complete && image.naturalWidth > 0) && document.images.length >= 2"
        pages.evaluate("document.images[0].scrollIntoView()")
        pages.until("pictures of a run", loaded)
        pages.evaluate("scrollTo(0, 0)")
        pages.draw("finished", CURVES, schemes=("light",))

        wrong = pages.wrong + list(pages.complaints())
        pages.open("run/cart-pole-on-R")
        begun = time.monotonic()
        server.send_signal(signal.SIGINT)
        if (status := server.wait(timeout=LIMIT)) != 130 or time.monotonic() - begun > 5:
            wrong.append(f"Ctrl-C ended the server with {status} after {time.monotonic() - begun:.1f} s, expected 130 at once")
        if not pages.until("a notice that it is lost", "document.getElementById('live').innerText.includes('lost')"):
            wrong.append(pages.wrong[-1])
        if training.poll() is not None:
            wrong.append("the training ended before the pages were looked at")
    if wrong:
        sys.exit("\n".join(["The pages are not as they should be:", *wrong]))
    print(f"trainings, an experiment and their list at {', '.join(map(str, WIDTHS))} pixels; pictures in {pictures}")


def watch_training(pages):
    """Checks the page of a training: its learning curve must grow."""
    wait_for_page(pages, "run/cart-pole-on-R")
    pages.open("run/cart-pole-on-R")
    pages.until("a curve", f"{REACH} > 0")
    reach = pages.evaluate(REACH)
    pages.until("a curve that grows", f"{REACH} > {reach}")
    pages.until("a title that says how far it is", "document.title.includes('%')")
    pages.draw("training", CURVES)
    pages.evaluate("document.querySelector('input[value=steps]').click()")
    pages.check("over steps it reaches further", pages.evaluate(f"{REACH} > {reach}"), True)
    pages.stayed("a curve that grows")


def watch_curves(pages):
    """Selects two trainings in the list, and checks the page that draws both in the same charts."""
    link = "document.getElementById('charted')"
    pages.check("a link before a choice", pages.evaluate(f"{link}.parentElement.hidden"), True)
    pages.evaluate("document.querySelectorAll('input[name=charted]').forEach(input => input.click())")
    pages.check("a link to the chosen", pages.evaluate(f"{link}.parentElement.hidden"), False)
    path = pages.evaluate(f"{link}.getAttribute('href')").removeprefix("./")
    pages.open(path)
    pages.until("both curves", "document.querySelectorAll('[data-chart=return] .legend li').length === 2")
    points = "Number(document.querySelector('[data-chart=return]').dataset.points)"
    before = pages.evaluate(points)
    pages.draw("curves", ["return", "success", "length"])
    pages.evaluate("document.querySelector('input[value=steps]').click()")
    pages.check("points over steps", pages.evaluate(f"{points} >= {before}"), True)
    pages.draw("curves-over-steps", ["return", "success", "length"], schemes=("light",))


def watch_experiment(pages, experiment):
    """Checks the page of an experiment: cells must begin and finish, and the report must contain them."""
    wait_for_page(pages, "run/study")
    pages.open("run/study")
    pages.until("a cell in work", "document.querySelectorAll('.working tbody tr').length > 0")
    pages.until("its curve", "document.querySelector('[data-chart=cells]').dataset.points > 1")
    # The plot has no line for a moment between the end of a cell and the start of the next, so wait for a line.
    pages.until("its line", f"{PAINTED}.some(([plot, count]) => plot === 'cells' && count >= {LEAST_LINE})")
    pages.draw("experiment", None, schemes=("light",))
    pages.until("a link to its training", "document.querySelector('.map li.in-work a') !== null")
    pages.evaluate("window.kept = document.querySelector('.map a'); window.kept.focus()")
    done = pages.evaluate(DONE)
    pages.until("a cell that is done", f"{DONE} > {done}")
    pages.check("the focused element keeps the focus", pages.evaluate("document.activeElement === window.kept"), True)
    pages.draw("experiment-later", None)
    if status := experiment.wait(timeout=LIMIT):
        pages.wrong.append(f"perturb run ended with {status}")
    pages.until("all cells", f"{DONE} === 16")
    pages.evaluate("document.querySelector('iframe.report').scrollIntoView()")
    pages.until("the report of all cells", REPORTED.replace("WORDS", "16 of 16 cells are done"))
    pages.stayed("cells that are done")
    pages.draw("experiment-done")


def wait_for_page(pages, path):
    """Waits until the page exists. Otherwise the browser would print an error to the console."""
    start = time.monotonic()
    while time.monotonic() - start < LIMIT:
        try:
            urllib.request.urlopen(pages.own + path).close()
        except urllib.error.HTTPError:
            time.sleep(0.2)
        else:
            return
    pages.wrong.append(f"there is no {path}")


def end(process):
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()


if __name__ == "__main__":
    main()
