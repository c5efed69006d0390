"""Drives the page of the live service in headless Chromium through ChromeDriver, with Python's own library alone."""

import base64
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

BINARY, PICTURES = Path(sys.argv[1]).resolve(), Path(sys.argv[2])
LONG = 60
# axe-core, which checks accessibility; without it these checks are left out, and the test says so
AXE = os.environ.get("AXE")
# width, height, and whether it is a phone
PHONE, DESK = (390, 844, True), (1280, 900, False)
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"


class Browser:
    """A session of the WebDriver protocol."""

    def __init__(self, folder):
        self.driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, text=True)
        port = None
        for line in self.driver.stdout:
            if found := re.search(r"successfully on port (\d+)", line):
                port = found[1]
                break
        self.base = f"http://127.0.0.1:{port}"
        arguments = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
                     "--disable-background-networking", "--disable-component-update", "--disable-sync", f"--user-data-dir={folder}"]
        options = {"goog:chromeOptions": {"args": arguments}, "goog:loggingPrefs": {"browser": "ALL"}}
        found = self.call("POST", "/session", {"capabilities": {"alwaysMatch": options}})
        self.base += f"/session/{found['sessionId']}"

    def call(self, method, path, body=None):
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base + path, data, {"Content-Type": "application/json"}, method=method)
        try:
            with urllib.request.urlopen(request, timeout=LONG) as answer:
                return json.load(answer)["value"]
        except urllib.error.HTTPError as e:
            raise AssertionError(json.load(e)["value"]["message"]) from None

    def open(self, address):
        self.call("POST", "/url", {"url": address})

    def run(self, script, *arguments):
        return self.call("POST", "/execute/sync", {"script": script, "args": list(arguments)})

    def axe(self, name):
        """Checks the page against WCAG 2.2 AA."""
        if not AXE:
            return print(f"left out: {name} is not checked with axe, which is not installed")
        script = Path(AXE).read_text() + """; const done = arguments[0];
          axe.run(document, { runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa"] }).then(
            r => done(r.violations.map(v => `${v.id}: ${v.nodes.map(n => `${n.target} ${n.failureSummary}`)}`)), e => done([String(e)]));"""
        found = self.call("POST", "/execute/async", {"script": script, "args": []})
        check(f"{name} has no fault that axe finds", not found, found)

    def size(self, width, height, mobile=False):
        device = {"width": width, "height": height, "deviceScaleFactor": 2 if mobile else 1, "mobile": mobile}
        self.call("POST", "/goog/cdp/execute", {"cmd": "Emulation.setDeviceMetricsOverride", "params": device})

    def picture(self, name, full=False):
        cdp = {"cmd": "Page.captureScreenshot", "params": {"format": "png", "captureBeyondViewport": full}}
        shot = self.call("POST", "/goog/cdp/execute", cdp)
        (PICTURES / f"{name}.png").write_bytes(base64.b64decode(shot["data"]))

    def pointer(self, *steps):
        """Moves a mouse: (x, y) moves, "down" and "up" press."""
        kinds = {"down": {"type": "pointerDown", "button": 0}, "up": {"type": "pointerUp", "button": 0}}
        actions = [kinds[s] if isinstance(s, str) else {"type": "pointerMove", "x": int(s[0]), "y": int(s[1]), "duration": 30} for s in steps]
        mouse = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": actions}
        self.call("POST", "/actions", {"actions": [mouse]})

    def press(self, key):
        keys = [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]
        self.call("POST", "/actions", {"actions": [{"type": "key", "id": "keys", "actions": keys}]})

    def click(self, selector):
        found = self.call("POST", "/element", {"using": "css selector", "value": selector})
        self.call("POST", f"/element/{found[ELEMENT]}/click", {})

    def close(self):
        self.call("DELETE", "")
        self.driver.terminate()
        self.driver.wait()


class Service:
    """A running service on a free port."""

    def __init__(self, folder, *arguments, frame_rate=10, size=250, scene="wedges", calibration=None):
        board = Path(__file__).parents[2].joinpath("boards/x86-sim.toml").read_text()
        board = board.replace("wedges,size=250", f"{scene},size={size}").replace("frame_rate = 10.0", f"frame_rate = {frame_rate}.0")
        if calibration:
            board = board.replace('calibration = "simulated"', f'calibration = "{calibration}"')
        self.token = os.environ.get("STOKESCOPE_TOKEN")
        path = Path(folder, "bench.toml")
        path.write_text(board)
        command = [BINARY, "run", "--board", path, "--out", Path(folder, "out"), "--listen", "127.0.0.1:0", *arguments]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        for line in self.process.stderr:
            if found := re.search(r"preview: (http://\S+)", line):
                self.address = found[1]
                break
        # what it says later must not block it
        self.rest = subprocess.Popen(["cat"], stdin=self.process.stderr, stdout=subprocess.DEVNULL)
        if not calibration:
            until("a first frame", lambda: self.state()["frame"] is not None)

    def read(self, path):
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        with urllib.request.urlopen(urllib.request.Request(self.address + path, headers=headers), timeout=LONG) as answer:
            return answer.read()

    def state(self):
        return json.loads(self.read("state"))

    def close(self):
        self.process.terminate()
        assert self.process.wait(LONG) == 0
        self.rest.wait()


def until(what, done):
    begin = time.monotonic()
    while True:
        try:
            value = done()
            if value:
                return value
        except (KeyError, OSError):
            pass
        assert time.monotonic() - begin < LONG, f"{what}, in vain"
        time.sleep(0.1)


def check(name, ok, found=""):
    assert ok, f"{name}: {found}"
    print(f"ok   {name}")


def pixels(browser, selector):
    """Mean colour and mean difference to the mean of what an image or canvas shows now."""
    return browser.run("""
      const source = document.querySelector(arguments[0]), c = document.createElement("canvas");
      [c.width, c.height] = [64, 64];
      const g = c.getContext("2d");
      g.drawImage(source, 0, 0, 64, 64);
      const d = g.getImageData(0, 0, 64, 64).data, mean = [0, 1, 2].map(k => { let s = 0; for (let i = k; i < d.length; i += 4) s += d[i]; return s / 4096; });
      let spread = 0;
      for (let i = 0; i < d.length; i += 4) for (let k = 0; k < 3; k++) spread += Math.abs(d[i + k] - mean[k]) / 12288;
      return { mean, spread, sum: d.reduce((a, b) => a + b, 0) };""", selector)


def drawn(browser, selector):
    until(f"{selector} is drawn", lambda: browser.run("return document.querySelector(arguments[0]).naturalWidth > 1", selector))
    return until(f"{selector} shows something", lambda: (p := pixels(browser, selector))["spread"] > 1 and p)


def text(browser, selector):
    return browser.run("return document.querySelector(arguments[0]).textContent", selector)


def slide(browser, selector, value):
    browser.run("""const e = document.querySelector(arguments[0]); e.value = arguments[1];
      for (const kind of ["input", "change"]) e.dispatchEvent(new Event(kind, { bubbles: true }));""", selector, value)


def choose(browser, service, name):
    """Chooses a view and waits until pictures of it come."""
    browser.click(f"#views button[data-view='{name}']")
    frame = service.state()["frame"]
    until("the next frames", lambda: service.state()["frame"] >= frame + 3)
    drawn(browser, "#live")


def place_of(browser, x, y):
    """Place of a pixel's middle in the window, by the sheet that the picture lies on."""
    return browser.run("""const r = document.querySelector('#sheet').getBoundingClientRect();
      return [r.left + (arguments[0] + .5) / size[0] * r.width, r.top + (arguments[1] + .5) / size[1] * r.height, r.width / size[0]]""", x, y)


def named(browser, x, y):
    """Points at a pixel and waits until it is the one that is read out."""
    left, top, side = place_of(browser, x, y)
    browser.pointer((left, top))
    until(f"the read-out of {x}, {y}", lambda: f"x, y{x}, {y}S0" in text(browser, "#readout"))
    return left, top, side


def zooms(browser, at):
    """Zooms to pixels by wheel, buttons and keys. The picture's own colours say that the read-out names the pixel that is seen there."""
    side = place_of(browser, 0, 0)[2]
    x, y = at(0.425, 0.25)
    wheel = {"type": "wheel", "id": "wheel", "actions": [{"type": "scroll", "x": int(x), "y": int(y), "deltaX": 0, "deltaY": -120, "duration": 0}]}
    for _ in range(4):
        browser.call("POST", "/actions", {"actions": [wheel]})
    until("the wheel zooms", lambda: abs(place_of(browser, 0, 0)[2] / side - 4) < 0.05)
    check("the place under the wheel stays", abs(place_of(browser, 106, 62)[0] - x) < 3 * side and abs(place_of(browser, 106, 62)[1] - y) < 3 * side)
    named(browser, 106, 62)
    for _ in range(3):
        browser.click("#zoom-in")
    left, top, large = named(browser, 108, 60)
    check("buttons zoom until pixels are large", large > 7 * side and large > 15, large)
    named(browser, 109, 60)
    check("each is where it is seen", abs(place_of(browser, 109, 60)[0] - left - large) < 1)
    browser.pointer((left, top), "down", (left + 60, top + 30), "up")
    check("a drag moves the picture", abs(place_of(browser, 108, 60)[0] - left - 60) < 2 and abs(place_of(browser, 108, 60)[1] - top - 30) < 2)
    browser.run("document.querySelector('#stage').focus()")
    for _ in range(40):
        browser.press("\ue014")
    inside = lambda: browser.run("""const c = document.querySelector('#cross').getBoundingClientRect(), s = document.querySelector('#stage').getBoundingClientRect();
      return c.left > s.left && c.right < s.right && c.top > s.top && c.bottom < s.bottom""")
    check("the picture follows the keys", inside())
    browser.press("0")
    until("0 shows the whole picture", lambda: abs(place_of(browser, 0, 0)[2] - side) < 0.01)
    browser.press("+")
    until("plus zooms", lambda: abs(place_of(browser, 0, 0)[2] / side - 2) < 0.01)
    check("a zoomed picture stays in its place", inside())
    check("the zoom is told", text(browser, "#zoom-whole") == "2×" and "whole" in browser.run("return document.querySelector('#zoom-whole').ariaLabel"))


def every_control(browser, service):
    browser.size(1280, 900)
    browser.open(service.address)
    views = until("view buttons", lambda: browser.run("return [...document.querySelectorAll('#views button')].map(b => b.dataset.view)"))
    check("a button for every view", views == [v["name"] for v in service.state()["views"]], views)

    shown = {}
    for name in views:
        browser.click(f"#views button[data-view='{name}']")
        shown[name] = drawn(browser, "#live")
        check(f"view {name}", f"view={name}" in browser.run("return document.querySelector('#live').src") and f"#{name}" in browser.run("return location.hash"))
    looks = {name: tuple(round(v) for v in p["mean"]) for name, p in shown.items()}
    distinct = len(set(looks[n] for n in ["intensity", "dolp", "aolp", "aolp-saturation", "composite", "raw", "difference"]))
    check("views look different", distinct == 7, looks)

    browser.click("#views button[data-view='aolp']")
    drawn(browser, "#live")
    check("the colour wheel is drawn", pixels(browser, "#legend canvas")["spread"] > 20)
    browser.click("#views button[data-view='aolp-saturation']")
    check("the wheel follows the false-colour mode", pixels(browser, "#legend canvas")["mean"][0] > 0 and "white" in text(browser, "#legend"))
    choose(browser, service, "aolp")
    box = browser.run("const r = document.querySelector('#stage').getBoundingClientRect(); return [r.x, r.y, r.width, r.height]")
    at = lambda u, v: (box[0] + u * box[2], box[1] + v * box[3])
    # in the middle of a wedge, whose angle is certain
    browser.pointer(at(0.425, 0.25))
    readout = until("a read-out", lambda: (t := text(browser, "#readout")) and "DoLP" in t and t)
    check("cursor read-out", re.search(r"x, y1\d\d, \d\dS0\d.\d+DoLP\d.\d+( ± \d.\d+)?AoLP\d+(.\d)?°", readout), readout)
    check("histograms are drawn", all(pixels(browser, f"#{c}")["sum"] > 0 for c in ["dolp-histogram", "aolp-histogram", "polar"]))
    whole = until("figures of the whole picture", lambda: (t := text(browser, "#of")) and "whole picture" in t and t)
    browser.picture("page")

    zooms(browser, at)
    browser.picture("page-zoomed")
    browser.click("#zoom-whole")

    browser.click("#region")
    browser.pointer(at(0.2, 0.25), "down", at(0.3, 0.3), at(0.45, 0.5), "up")
    part = until("figures of a region", lambda: (t := text(browser, "#of")) and "×" in t and t)
    check("a region has its own figures", part.split("·")[-1] != whole.split("·")[-1], part)
    check("the region is outlined", not browser.run("return document.querySelector('#box').hidden"))
    browser.picture("page-region")
    browser.click("#region")
    until("the region goes", lambda: "whole picture" in text(browser, "#of"))
    check("the region goes", browser.run("return document.querySelector('#box').hidden"))

    browser.click("#compare")
    drawn(browser, "#live2")
    slide(browser, "#split-at", 30)
    clip = browser.run("return document.querySelector('#live2').style.clipPath")
    check("the slider moves the divider", "30%" in clip and browser.run("return document.querySelector('#divider').style.left") == "30%", clip)
    slide(browser, "#second", "dolp")
    until("the second view changes", lambda: "view=dolp" in browser.run("return document.querySelector('#live2').src"))
    drawn(browser, "#live2")
    slide(browser, "#split-at", 50)
    browser.picture("page-compare")

    browser.click("#freeze")
    until("the frozen picture", lambda: not browser.run("return document.querySelector('#still').hidden"))
    still = pixels(browser, "#still")
    check("freezing keeps the picture", still["spread"] > 1)
    browser.pointer(at(0.25, 0.25))
    before = until("a frozen read-out", lambda: (t := text(browser, "#readout")) and "x, y6" in t and t)
    browser.pointer(at(0.425, 0.25))
    after = until("another frozen read-out", lambda: (t := text(browser, "#readout")) and t != before and t)
    for _ in range(3):
        browser.click("#zoom-in")
    check("a frozen picture zooms and is read out", named(browser, 107, 61)[2] > 8)
    browser.click("#zoom-whole")
    browser.pointer(at(0.425, 0.25))
    until("the read-out before", lambda: text(browser, "#readout") == after)
    check("a frozen picture can be read out", re.search(r"x, y1\d\d, \d\dS0\d.\d+DoLP\d.\d+( ± \d.\d+)?AoLP\d+(.\d)?°", after), after)
    browser.run("document.querySelector('#stage').focus()")
    browser.press("\ue014")
    until("the keyboard moves the read-out", lambda: text(browser, "#readout") not in (before, after))
    check("both pictures are frozen", pixels(browser, "#still2")["spread"] > 1)
    time.sleep(1.5)
    check("a frozen picture stays", pixels(browser, "#still") == still)
    check("a frozen page streams nothing", "stream" not in browser.run("return document.querySelector('#live').src"))
    check("a frozen picture can be saved", browser.run("return document.querySelector('#save-png').href").startswith("data:image/png"))
    browser.click("#freeze")
    drawn(browser, "#live")
    browser.click("#compare")
    saved = browser.run("const a = document.querySelector('#save-png'); return [a.href, a.download]")
    with urllib.request.urlopen(saved[0]) as answer:
        check("a live picture can be saved", answer.read(4) == b"\x89PNG" and saved[1].endswith(".png"), saved)

    slide(browser, "#iterations", 7)
    until("iterations reach the service", lambda: service.state()["controls"]["iterations"] == 7)
    until("and the solver", lambda: service.state()["report"]["iterations"] <= 7)
    check("the iterations slider works", True)
    slide(browser, "#quality", 40)
    until("quality reaches the service", lambda: service.state()["controls"]["jpeg_quality"] == 40)
    check("the quality slider works", True)

    fusion = service.state()["controls"]["fusion"]
    check("fusion can be chosen, or is off with a reason", browser.run("const b = document.querySelector('#fused'); return [b.disabled, b.title]")
          == [not fusion["available"], fusion["reason"]] and (fusion["available"] or fusion["reason"] in text(browser, "#fusion-note")), fusion)
    browser.click("#physics")
    check("the physics switch is on", browser.run("return document.querySelector('#physics').getAttribute('aria-pressed')") == "true")

    browser.click("#store")
    until("the background is stored", lambda: service.state()["controls"]["background"])
    browser.click("#views button[data-view='difference']")
    until("a difference is drawn", lambda: pixels(browser, "#live")["mean"] != shown["difference"]["mean"])
    time.sleep(1.5)
    browser.picture("page-difference")
    check("the note says so", "stored" in text(browser, "#background-note"))
    browser.click("#clear")
    until("the background is cleared", lambda: not service.state()["controls"]["background"])
    check("background and difference", True)

    check("stage timings", "recon" in text(browser, "#timings") and "frame to picture" in text(browser, "#timings"), text(browser, "#timings"))
    check("figures", "Delay" in text(browser, "#figures"))
    check("lamps", browser.run("return document.querySelector('#raw-lamp').className") == "lamp good")
    browser.axe("the page")
    check("the legend is beside the picture", browser.run("""const l = document.querySelector('#legend').getBoundingClientRect(),
      v = document.querySelector('#view').getBoundingClientRect(); return l.top >= v.top && l.bottom <= v.bottom"""))
    for name in ["state", "events", "log", "metrics"]:
        check(f"link to {name}", browser.run("return document.querySelector(arguments[0]).href", f"#{name}").endswith(f"/{name}"))

    browser.size(390, 844, mobile=True)
    choose(browser, service, "aolp")
    wide = browser.run("return document.documentElement.scrollWidth - innerWidth")
    check("a phone needs no scrolling sideways", wide <= 0, wide)
    small = browser.run("return [...document.querySelectorAll('button, a, input, select')].filter(e => e.offsetHeight && e.offsetHeight < 18).map(e => e.id)")
    check("nothing is too small for a finger", not small, small)
    legend = browser.run("scrollTo(0, 0); return document.querySelector('#legend').getBoundingClientRect().bottom")
    check("the legend is seen on a phone without scrolling", 0 < legend <= 844, legend)
    browser.axe("the page on a phone")
    browser.picture("page-phone", full=True)
    browser.picture("page-phone-first")


def warnings(browser, folder):
    sysfs = Path(folder, "sys/devices/platform/soc/soc:firmware")
    sysfs.mkdir(parents=True)
    sysfs.joinpath("get_throttled").write_text("5\n")
    service = Service(folder, "--sysfs", str(Path(folder, "sys")), size=64)
    try:
        browser.size(1280, 900)
        browser.open(service.address)
        banner = until("a banner", lambda: (t := text(browser, "#warnings")) and "Undervoltage" in t and t)
        check("undervoltage has a banner", "Throttled" in banner, banner)
        check("read-only by default, and says why", browser.run("return ['iterations', 'quality', 'store', 'clear', 'physics', 'fused'].every(i => document.getElementById(i).disabled)")
              and "--control" in text(browser, "#settings-note"))
        drawn(browser, "#live")
        browser.picture("page-warnings")
    finally:
        service.close()


def saturated(browser, folder):
    service = Service(folder, size=64, scene="film,light=3")
    try:
        browser.size(1280, 900)
        browser.open(service.address + "#raw")
        lamp = until("a lamp", lambda: (t := text(browser, "#exposure-lamp")) and "saturated" in t and t)
        check("saturated readings light a lamp", "bad" in browser.run("return document.querySelector('#exposure-lamp').className"), lamp)
        mean = drawn(browser, "#live")["mean"]
        check("and are red in the raw view", mean[0] > mean[1] + 5, mean)
        browser.picture("page-saturated")
    finally:
        service.close()


def record(browser, service, folder, size):
    """Records a session on the page, downloads it, opens its results, replays it and deletes it."""
    browser.run("document.querySelector('#record-name').value = 'oak leaf'; document.querySelector('#record-note').value = 'from below'")
    browser.click("#record")
    until("frames", lambda: service.state()["recording"]["frames"] >= 5)
    until("a list", lambda: "being recorded" in text(browser, "#sessions"))
    browser.picture("page-recording")
    browser.click("#record")
    until("an end", lambda: not service.state()["recording"]["on"])
    entry = until("an entry", lambda: (t := text(browser, "#sessions")) and "being recorded" not in t and re.search("[kM]B", t) and t)
    check("a session has a name, a note and a thumbnail", "oak leaf" in entry and "from below" in entry
          and until("a thumbnail", lambda: browser.run("return document.querySelector('#sessions img').naturalWidth")) > 32, entry)
    browser.axe("the page with a session")
    link = browser.run("return document.querySelector('#sessions a').getAttribute('href')")
    archive = zipfile.ZipFile(io.BytesIO(service.read(link)))
    stacks = [name for name in archive.namelist() if name.endswith(".ome.tif")]
    check("a session is downloaded whole", archive.testzip() is None and len(stacks) >= 5, archive.namelist())
    links = browser.run("return [...document.querySelectorAll('#sessions a')].map(a => [a.textContent, a.getAttribute('href')])")
    check("a session is offered as ZIP and as OME-TIFF", [name for name, _ in links] == ["ZIP", "OME-TIFF"], links)
    try:
        import tifffile
        shape = tifffile.imread(io.BytesIO(archive.read(stacks[0]))).shape
        check("tifffile opens its results", shape == (3, size, size), shape)
        with tifffile.TiffFile(io.BytesIO(service.read(links[1][1]))) as whole:
            series = whole.series[0]
            names = re.findall(r'<Channel [^>]*Name="([^"]*)"', whole.ome_metadata)
            check("a session is one OME-TIFF file of all frames", series.axes == "TCYX" and series.shape == (len(stacks), 5, size, size), series)
            check("its channels are named", names == ["S0", "S1", "S2", "DoLP", "AoLP (degrees)"], names)
            check("its values are the recorded ones", all((series.asarray()[t, :3] == tifffile.imread(io.BytesIO(archive.read(name)))).all()
                  for t, name in enumerate(sorted(stacks))))
    except ImportError:
        print("left out: tifffile is not installed")
    archive.extractall(Path(folder, "away"))
    replay = subprocess.run([BINARY, "replay", Path(folder, "away"), "--out", Path(folder, "again")], capture_output=True, text=True)
    check("a downloaded session is replayed", replay.returncode == 0, replay.stderr)
    pictures = zipfile.ZipFile(io.BytesIO(service.read("still")))
    check("a still has all views", pictures.testzip() is None and {"stokes.npy", "aolp.png", "report.json"} <= set(pictures.namelist()))
    for kind, size in {"phone": PHONE, "desk": DESK}.items():
        browser.size(*size)
        browser.picture(f"page-sessions-{kind}", full=True)
    delete = "#sessions li button:last-child"
    browser.click(delete)
    check("deleting asks first", "for good" in text(browser, delete))
    browser.click(delete)
    until("the session goes", lambda: text(browser, "#sessions") == "")
    check("a session is deleted", not list(Path(folder, "sessions").glob("session-*")))


def log_in(browser, service):
    browser.open(service.address)
    check("without the token there is a login page", browser.run("return document.querySelector('input[type=password]') !== null"))
    browser.axe("the login page")
    for word, done in [("wrong-token", lambda: "not the token" in text(browser, "body")),
                       ("secret-token", lambda: browser.run("return document.querySelector('#live') !== null"))]:
        for kind, size in {"phone": PHONE, "desk": DESK}.items():
            browser.size(*size)
            browser.picture(f"login-{kind}")
        browser.run("document.querySelector('#token').value = arguments[0]", word)
        browser.click("button")
        until(f"the answer to {word}", done)
    drawn(browser, "#live")


def token(browser, folder):
    os.environ["STOKESCOPE_TOKEN"] = "secret-token"
    service = Service(folder, size=64)
    try:
        log_in(browser, service)
        check("scripts cannot read the cookie", browser.run("return document.cookie") == "")
        slide(browser, "#iterations", 3)
        until("a change with a cookie", lambda: service.state()["controls"]["iterations"] == 3)
        check("a login opens the page and its settings", True)
        browser.call("DELETE", "/cookie")
        browser.open(service.address + "?token=secret-token#dolp")
        drawn(browser, "#live")
        where = browser.run("return location.href")
        check("no address with the token is kept", where == service.address + "#dolp", where)
    finally:
        service.close()


def no_complaints(browser, but="status of 401"):
    browser.open("about:blank")
    log = [entry["message"] for entry in browser.call("POST", "/se/log", {"type": "browser"})
           if not re.search(f"net::ERR_|{but}", entry["message"])]  # it was stopped
    check("the browser has nothing to complain about", not log, log)


def main():
    PICTURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in ["a", "b", "c", "d", "profile"]:
            Path(folder, name).mkdir()
        browser = Browser(Path(folder, "profile"))
        try:
            service = Service(Path(folder, "a"), "--control", "--fps", "off", frame_rate=5)
            try:
                every_control(browser, service)
            finally:
                service.close()
            warnings(browser, Path(folder, "b"))
            saturated(browser, Path(folder, "d"))
            token(browser, Path(folder, "c"))
            no_complaints(browser)
        finally:
            browser.close()
    print(f"pictures: {PICTURES}")


if __name__ == "__main__":
    main()
