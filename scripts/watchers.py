#!/usr/bin/env python3
"""Live rate and memory of the service beside clients: eight watchers, a download of 1 GB, a step of calibration, and floods of connections.

    scripts/watchers.py [BINARY]        default: target/release/stokescope

Two services, one after the other, since the setup takes steps before there is a live service: the live service with eight watchers and the
download, and the setup with eight pages and steps under way. Each is measured in turn alone and with all of that, so that whatever else
the machine does is in both; where it leaves too little for the frame rate of the cameras, every picture that is encoded lowers it.
A third service meets, one kind at a time, 200 connections that say nothing, 100 whose headers never end, 8 clients that take snapshot after
snapshot, and 28 that follow the events. The first two have no token. Clients that the service turns away come again.
Needs curl. SECONDS_EACH [10], TURNS [2]; VIEWS [1]: views that the watchers look at. Exit code 1 above 10 % or 16 MiB beside watchers, above 1 %
or 1 MiB in a flood.
"""

import json
import os
import re
import socket
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
FLOOD_DROP, FLOOD_GROWTH = 0.01, 1 << 20
# the clients of an instrument run on other machines
POLITE = ["nice", "-n", "19"]
TOKEN = "watcher-token"
BOARD = Path(__file__).parents[1] / "boards/x86-sim.toml"


class Service:
    def __init__(self, folder, calibration, *arguments):
        board = Path(folder, f"{calibration}.toml")
        board.write_text(BOARD.read_text().replace('calibration = "simulated"', f'calibration = "{calibration}"'))
        command = [BINARY, "run", "--board", board, "--out", Path(folder, "out"), "--listen", "127.0.0.1:0", "--token", TOKEN, *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        self.address = next(found[1] for line in self.process.stderr if (found := re.search(r"preview: (http://[^/\s]+/)", line)))
        threading.Thread(target=lambda: [None for _ in self.process.stderr], daemon=True).start()

    def ask(self, path, body=None):
        headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"}
        request = urllib.request.Request(self.address + path, None if body is None else json.dumps(body).encode(), headers)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)

    def curl(self, path, *options):
        return subprocess.Popen([*POLITE, "curl", "-sf", "-H", f"Authorization: Bearer {TOKEN}", "-o", "/dev/null", *options, self.address + path])

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


class Silent:
    """Connections that send `head` and, for each of `drops`, a byte a second; those that are closed are opened again."""

    def __init__(self, service, count, head=b"", drop=b""):
        host, port = re.search(r"//(.+):(\d+)/", service.address).groups()
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.keep, args=((host, int(port)), count, head, drop))
        self.thread.start()

    def keep(self, address, count, head, drop):
        sockets = [None] * count
        while not self.ended.wait(1):
            for k, connection in enumerate(sockets):
                try:
                    if connection is None:
                        sockets[k] = connection = socket.create_connection(address, timeout=1)
                        connection.setblocking(False)
                        connection.send(head)
                    connection.send(drop)
                    if not connection.recv(4096):
                        connection.close()
                        sockets[k] = None
                except BlockingIOError:
                    pass
                except OSError:
                    sockets[k] = None

    def terminate(self):
        self.ended.set()

    def wait(self):
        self.thread.join()


def compare(name, service, count, load, meanwhile=lambda: None, drop=DROP, most_growth=GROWTH):
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
    return rates[1] >= (1 - drop) * rates[0] and growth <= most_growth


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
            again = f'while curl -sf -H "Authorization: Bearer {TOKEN}" -o /dev/null {service.address}sessions/{session}/zip; do echo; done'
            shell = [*POLITE, "sh", "-c", f"trap 'kill 0' TERM; {again} & wait"]
            return [*watchers, subprocess.Popen(shell, stdout=subprocess.DEVNULL, start_new_session=True)]

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


def floods(folder):
    service = Service(folder, "simulated")
    again = ["--retry", "1000", "--retry-all-errors", "--retry-delay", "1"]
    kinds = {
        "200 silent connections": lambda: [Silent(service, 200)],
        "100 endless headers": lambda: [Silent(service, 100, b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: ", b"x")],
        "8 clients of snapshots": lambda: [service.curl("snapshot?view=aolp&n=[1-100000]") for _ in range(8)],
        "28 followers of events": lambda: [service.curl("events", "-N", *again) for _ in range(28)],
    }
    try:
        wait(lambda: (service.ask("state")["frames"] or 0) > 5)
        return all([compare(f"flood of {kind}", service, lambda state: state["frames"], load, drop=FLOOD_DROP, most_growth=FLOOD_GROWTH)
                    for kind, load in kinds.items()])
    finally:
        service.end()


def main():
    with tempfile.TemporaryDirectory() as folder:
        held = [live(folder), setup(folder), floods(folder)]
    sys.exit(0 if all(held) else 1)


main()
