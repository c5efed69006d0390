"""Power cuts of a virtual machine: saves its state through the monitor of qemu, and checks what a cut left on its disk.

cut.py save MONITOR STATE            saves the running machine and ends it
cut.py resume MONITOR                waits until a saved machine runs again
cut.py check KIND FOUND EXPECTED     prints the number of visible frames and a digest of all names; the first damage and exit code 1 otherwise
"""
import hashlib
import json
import pathlib
import socket
import sys
import time
import tomllib


class Monitor:
    """Commands to qemu and its answers."""

    def __init__(self, path):
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.settimeout(600)
        self.socket.connect(path)
        self.answer()

    def answer(self):
        text = b""
        while not text.endswith(b"(qemu) "):
            more = self.socket.recv(4096)
            if not more:
                break
            text += more
        return text.decode(errors="replace")

    def ask(self, command):
        self.socket.sendall(command.encode() + b"\n")
        return self.answer()


def wait_for(text, ask):
    for _ in range(6000):
        if text in ask():
            return
        time.sleep(0.1)
    raise OSError(f"qemu does not say {text}")


def save(path, state):
    monitor = Monitor(path)
    monitor.ask("migrate_set_parameter max-bandwidth 10G")
    monitor.ask(f'migrate -d "exec:cat >{state}"')
    wait_for("status: completed", lambda: monitor.ask("info migrate"))
    monitor.ask("quit")


def resume(path):
    def status():
        try:
            return Monitor(path).ask("info status")
        except OSError:
            return ""

    wait_for("status: running", status)


def need(condition, text):
    if not condition:
        raise ValueError(text)


def is_whole(file):
    """Whether an NPY file is as long as its header says."""
    data = file.read_bytes()
    if data[:6] != b"\x93NUMPY":
        return False
    end = 10 + int.from_bytes(data[8:10], "little")
    header = eval(data[10:end].decode(), {"__builtins__": {}})
    count = int(header["descr"][-1])
    for axis in header["shape"]:
        count *= axis
    return len(data) == end + count


def session(folder):
    """Checks a session; its number and its visible frames."""
    number = json.loads((folder / "session.json").read_text())["number"]
    bundle = tomllib.loads((folder / "calibration" / "calibration.toml").read_text())
    need((folder / "calibration" / bundle["psf"]["file"]).is_file(), f"{folder.name}: a bundle without its PSF")
    frames = 0
    visible = (file for part in folder.iterdir() if part.is_dir() for file in part.iterdir() if not file.name.startswith("."))
    for file in visible:
        need(file.suffix != ".npy" or is_whole(file), f"{file} is not whole")
        if file.parent.name == "frames":
            missing = [name for name in json.loads(file.read_text())["files"] if not (folder / name).is_file()]
            need(not missing, f"{file} without {missing}")
            frames += 1
    return number, frames


def calibrated(dir):
    """A bundle is that of one calibration or of the other, with all its files."""

    def description(file):
        return {key: value for key, value in tomllib.loads(file.read_text()).items() if key != "revision"}

    bundle = description(dir / "bundle" / "calibration.toml")
    need(bundle in [description(dir / name) for name in ("one.toml", "other.toml")], "the bundle is neither old nor new")
    files = [dir / "bundle" / table["file"] for table in bundle.values() if isinstance(table, dict) and "file" in table]
    need(all(file.is_file() and is_whole(file) for file in files), "the bundle lacks a file")


def check(kind, found, expected):
    sessions = [path for path in sorted((found / "stokescope/sessions").iterdir()) if path.name.startswith("session-")]
    numbers = [session(path) for path in sessions]
    need(len({number for number, _ in numbers}) == len(numbers), f"two sessions have one number: {numbers}")
    if kind == "past":
        # what the clock says is long ago is kept as the newest
        (_, frames), newest = max(zip(numbers, sessions))
        today = time.strftime("session-%Y%m%d", time.gmtime())
        need(newest.name < today and frames > 0, f"{newest.name} with {frames} frames is the newest, recorded before the clock was set back")
    if kind == "calibrate":
        calibrated(found / "stokescope/calibrated")
    for name in ("program", "environment"):
        need((found / name).read_bytes() == (expected / name).read_bytes(), f"{name} has changed")
    names = sorted(str(path) for path in (found / "stokescope").rglob("*"))
    return sum(frames for _, frames in numbers), hashlib.sha256("\n".join(names).encode()).hexdigest()


if sys.argv[1] == "save":
    save(*sys.argv[2:])
elif sys.argv[1] == "resume":
    resume(sys.argv[2])
else:
    try:
        print(*check(sys.argv[2], *map(pathlib.Path, sys.argv[3:])))
    except (OSError, ValueError, KeyError) as e:
        print(e)
        sys.exit(1)
