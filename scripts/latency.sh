#!/usr/bin/env bash
# How fast the live view is: seconds from the program's start to the first picture, milliseconds from a frame's arrival to its
# JPEG (median, 95 % of the latest frames), frames per second. The cameras are recorded ones, since rendering a scene costs
# more than solving it; the best of some tries counts, since whatever else the machine does is in the figures too.
#
#   scripts/latency.sh [OPTION of run…]     default: --iterations 10
#
# SIZE [250]: side of the frames. RATE [10]: frames per second of the cameras. TRIES [3]. SECONDS_EACH [20].
set -euo pipefail
cd "$(dirname "$0")/.."
binary=${STOKESCOPE:-}
if [ -z "$binary" ]; then
  cargo build --release --locked
  binary=target/release/stokescope
fi
[ $# -gt 0 ] || set -- --iterations 10
work=$(mktemp -d)
trap 'rm -r "$work"' EXIT
cameras() { printf '[cameras.%s]\nbackend = "%s"\nsource = "%s"\nframe_rate = %s.0\n' raw "$1" "$2" "$3" guide "$1" "$2" "$3"; }
printf 'inherit = "x86-sim"\ndescription = "recorded frames"\n[cameras]\ncalibration = "bundle"\n' >"$work/head.toml"
{ cat "$work/head.toml" && cameras sim "plastic,size=${SIZE:-250}" 10; } >"$work/simulated.toml"
{ cat "$work/head.toml" && cameras replay "$work/session" "${RATE:-10}"; } >"$work/recorded.toml"
"$binary" simulate --out "$work/bundle" --scene plastic --size "${SIZE:-250}" >/dev/null
"$binary" capture --board "$work/simulated.toml" --frames 24 --out "$work/session" >/dev/null
python3 - "$binary" "$work" "${TRIES:-3}" "${SECONDS_EACH:-20}" "$@" <<'PY'
import http.client, json, os, re, subprocess, sys, threading, time, urllib.request

binary, work, tries, seconds, options = sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), sys.argv[5:]

def measure():
    begin = time.monotonic()
    command = [binary, "run", "--board", f"{work}/recorded.toml", "--listen", "127.0.0.1:0", "--out", f"{work}/out", "--fps", "off"]
    service = subprocess.Popen(command + options, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        base = next(found[1] for line in service.stderr if (found := re.search(r"preview: (http://[^/\s]+)", line)))
        threading.Thread(target=service.stderr.read, daemon=True).start()
        while state(base)["frames"] == 0:
            time.sleep(0.01)
        urllib.request.urlopen(base + "/snapshot?view=aolp", timeout=30).read()
        first = time.monotonic() - begin
        watcher = urllib.request.urlopen(base + "/stream?view=aolp", timeout=30)
        threading.Thread(target=drain, args=[watcher], daemon=True).start()
        time.sleep(seconds)
        return first, state(base)
    finally:
        service.terminate()
        service.wait(10)

def state(base):
    return json.load(urllib.request.urlopen(base + "/state", timeout=30))

def drain(stream):
    try:
        while stream.read(65536):
            pass
    except (OSError, http.client.HTTPException):
        pass

found = []
for _ in range(tries):
    first, now = measure()
    report, preview = now["report"], now["stages_ms"]["preview"]
    stages = ", ".join(f"{name} {stage['p50']:.1f}" for name, stage in now["stages_ms"].items() if name != "preview")
    print(f"{now['size'][0]}×{now['size'][1]}, {report['iterations']} iterations, model {report['model']}: first picture after {first:.2f} s, "
          f"then {preview['p50']:.1f} ms (95 %: {preview['p95']:.1f} ms; {stages}), {now['fps']:.1f} frames per second; "
          f"load {os.getloadavg()[0]:.1f}", flush=True)
    found.append((first, preview["p95"], -now["fps"]))
first, worst, fps = map(min, zip(*found))
print(f"best of {tries}: first picture {first:.2f} s, 95 % of pictures within {worst:.1f} ms, {-fps:.1f} frames per second on {os.cpu_count()} cores")
PY
