#!/usr/bin/env python3
"""What eight watchers, a download of 1 GB and a step of calibration take from the live rate, and the memory that they add.

    scripts/watchers.py [BINARY]        default: target/release/stokescope

Two services, one after the other, since the setup takes steps before there is a live service: the live service with eight watchers and the
download, and the setup with eight pages and steps under way. Each is measured in turn alone and with all of that, so that whatever else
the machine does is in both; where it leaves too little for the frame rate of the cameras, every picture that is encoded lowers it.
Needs curl. SECONDS_EACH [10], TURNS [2]; VIEWS [1]: views that the watchers look at. Exit code 1 above 10 % or 16 MiB.
"""

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

BINARY = Path(sys.argv[1] if len(sys.argv) > 1 else "target/release/stokescope").resolve()
SECONDS, TURNS, VIEWS = (int(os.environ.get(name, default)) for name, default in [("SECONDS_EACH", 10), ("TURNS", 2), ("VIEWS", 1)])
WATCHERS, DOWNLOAD, DROP, GROWTH = 8, 1 << 30, 0.10, 16 << 20
# the clients of an instrument run on other machines
POLITE = ["nice", "-n", "19"]
BOARD = Path(__file__).parents[1] / "boards/x86-sim.toml"


class Service:
    def __init__(self, folder, calibration, *arguments):
        board = Path(folder, f"{calibration}.toml")
        board.write_text(BOARD.read_text().replace('calibration = "simulated"', f'calibration = "{calibration}"'))
        command = [BINARY, "run", "--board", board, "--out", Path(folder, "out"), "--listen", "127.0.0.1:0", "--control", *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        self.address = next(found[1] for line in self.process.stderr if (found := re.search(r"preview: (http://\S+)", line)))
        threading.Thread(target=lambda: [None for _ in self.process.stderr], daemon=True).start()

    def ask(self, path, body=None):
        headers = {"Origin": "http://localhost", "Content-Type": "application/json"}
        request = urllib.request.Request(self.address + path, None if body is None else json.dumps(body).encode(), headers)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)

    def curl(self, path, *options):
        return subprocess.Popen([*POLITE, "curl", "-sf", "-o", "/dev/null", *options, self.address + path])

    def end(self):
        self.process.terminate()
        self.process.wait(60)


def wait(done):
    begin = time.monotonic()
    while not done():
        assert time.monotonic() - begin < 60
        time.sleep(0.1)


def window(service, count, meanwhile=lambda: None):
    """Frames per second, and the largest memory seen."""
    begin, first, most = time.monotonic(), count(service.ask("state")), 0
    while time.monotonic() - begin < SECONDS:
        meanwhile()
        most = max(most, service.ask("state")["rss_bytes"])
        time.sleep(0.25)
    return (count(service.ask("state")) - first) / (time.monotonic() - begin), most


def compare(name, service, count, load, meanwhile=lambda: None):
    """Alone and under load in turn; gives whether both limits hold."""
    alone, loaded = [], []
    for _ in range(TURNS):
        alone.append(window(service, count))
        clients = load()
        loaded.append(window(service, count, meanwhile))
        for client in clients:
            client.terminate()
            client.wait()
        time.sleep(1)
    rates = [statistics.mean(rate for rate, _ in windows) for windows in (alone, loaded)]
    growth = max(most for _, most in loaded) - alone[0][1]
    print(f"{name}: {rates[0]:.2f} frames per second alone, {rates[1]:.2f} under load ({100 * (rates[1] / rates[0] - 1):+.1f} %), "
          f"memory {growth / 2**20:+.1f} MiB")
    return rates[1] >= (1 - DROP) * rates[0] and growth <= GROWTH


def live(folder):
    service = Service(folder, "simulated", "--sessions", str(Path(folder, "sessions")))
    try:
        wait(lambda: (service.ask("state")["frames"] or 0) > 5)
        service.ask("recording", {"on": True, "name": "large"})
        wait(lambda: service.ask("state")["recording"]["frames"] > 3)
        service.ask("recording", {"on": False})
        wait(lambda: not service.ask("state")["recording"]["on"])
        session = service.ask("sessions")["sessions"][0]["id"]
        # a hole in the file takes no room on the disk, and is read as zeros
        with open(Path(folder, "sessions", session, "raw", "zeros.npy"), "wb") as file:
            file.truncate(DOWNLOAD)
        views = [view["name"] for view in service.ask("state")["views"]][:VIEWS]

        def load():
            watchers = [service.curl(f"stream?view={views[k % len(views)]}", "-N") for k in range(WATCHERS)]
            # again and again, so that it lasts as long as the window
            again = f'while curl -sf -o /dev/null {service.address}sessions/{session}/zip; do echo; done'
            return [*watchers, subprocess.Popen([*POLITE, "sh", "-c", f"trap 'kill 0' TERM; {again} & wait"], stdout=subprocess.DEVNULL, start_new_session=True)]

        return compare("live service, eight watchers, a download of 1 GB", service, lambda state: state["frames"], load)
    finally:
        service.end()


def setup(folder):
    service = Service(folder, "bundle")
    try:
        service.ask("control", {camera: {"source": "dark,size=250"} for camera in ["raw", "guide"]})
        wait(lambda: (service.ask("state")["cameras"]["raw"]["frames"] or 0) > 30)

        def load():
            urls = [f"snapshot?view={'raw' if k % 2 else 'guide'}&n=[1-100000]" for k in range(WATCHERS)]
            return [service.curl(url, "--rate", "5/s") for url in urls]

        def step():
            if service.ask("calibrate/dark")["state"] not in ("taking", "measuring"):
                service.ask("calibrate/dark", {"frames": 16})

        return compare("setup, eight pages, a step under way", service, lambda state: state["cameras"]["raw"]["frames"], load, step)
    finally:
        service.end()


def main():
    with tempfile.TemporaryDirectory() as folder:
        held = [live(folder), setup(folder)]
    sys.exit(0 if all(held) else 1)


main()
