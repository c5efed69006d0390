#!/usr/bin/env bash
# Captures through the real libcamera, without hardware: builds libcamera with its virtual pipeline from Debian's source
# package, makes two virtual cameras that replay a simulated capture, and checks that what `stokescope run` makes of
# their frames is close to the truth. Needs Debian 12 or newer; run as root it installs what it needs.
#
# STOKESCOPE_LIBCAMERA: folder of the libcamera that is built [default: target/libcamera-virtual/prefix].
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/build.sh
. scripts/lib/debian.sh
work=$PWD/target/libcamera-virtual
prefix=${STOKESCOPE_LIBCAMERA:-$work/prefix}
mkdir -p "$work"

say() { printf '== %s\n' "$*"; }
fail() { printf 'FAIL %s\n' "$*" >&2; exit 1; }
pass() { printf 'PASS %s\n' "$*"; }

packages="meson ninja-build g++ pkg-config libyuv-dev libyaml-dev libgnutls28-dev openssl libudev-dev libjpeg-dev
    python3-yaml python3-ply python3-jinja2 libclang-dev clang libjpeg-turbo-progs dpkg-dev"
# shellcheck disable=SC2086
debian_need "$work/install.log" $packages || fail "packages"

if [ ! -e "$prefix/lib/pkgconfig/libcamera.pc" ]; then
    say "libcamera from Debian's source package"
    mkdir -p "$work/source"
    debian_suite "$work/apt" deb-src sid || fail "package list"
    (cd "$work/source" && rm -rf ./* && apt-get "${suite[@]}" source libcamera >"$work/build.log" 2>&1) ||
        fail "source package; see $work/build.log"
    source=$(find "$work/source" -mindepth 1 -maxdepth 1 -type d | head -1)
    # Debian's Python has the modules that the build needs
    (cd "$source" && PATH=/usr/bin:/bin && meson setup build --prefix="$prefix" --libdir=lib --buildtype=release \
        -Dpipelines=virtual -Dipas= -Dtest=false -Dcam=disabled -Dqcam=disabled -Dgstreamer=disabled \
        -Dpycamera=disabled -Dlc-compliance=disabled -Ddocumentation=disabled -Dtracing=disabled -Dv4l2=disabled \
        -Dandroid=disabled -Dlibunwind=disabled -Dlibdw=disabled -Dsoftisp-gpu=disabled &&
        ninja -C build install) >>"$work/build.log" 2>&1 || fail "libcamera; see $work/build.log"
fi
export PKG_CONFIG_PATH=$prefix/lib/pkgconfig LD_LIBRARY_PATH=$prefix/lib
say "libcamera $(pkg-config --modversion libcamera)"

say "build"
build_with libcamera "$work/tests.log" || fail "build"

say "two cameras from a simulated capture"
rm -rf "$work"/{bundle,exact,frames,shown,session,out,out2,out3,out4}
"$bin" simulate --out "$work/exact" --scene plastic --size 256x250 --noise 0.001 --surround 0 --guide-margin 0 >/dev/null
cp -r "$work/exact" "$work/bundle"
mkdir -p "$work/frames/raw" "$work/frames/guide" "$work/shown"
# eight frames each: counts of 8 bits, rounded with a dither, so that no two frames are the same
/usr/bin/python3 - "$work" <<'PY'
import array, pathlib, random, re, sys
work = pathlib.Path(sys.argv[1])
def npy(path):
    data = path.read_bytes()
    head = data[10:10 + int.from_bytes(data[8:10], "little")].decode()
    shape = [int(n) for n in re.search(r"\(([^)]*)\)", head).group(1).replace(",", " ").split()]
    kind = {"<u2": "H", "|u1": "B", "<f4": "f"}[re.search(r"'descr': '([^']*)'", head).group(1)]
    return shape[-2:], array.array(kind, data[10 + len(head):])
text = (work / "bundle/calibration.toml").read_text()
key = lambda name: float(re.search(rf"^{name} = (.*)$", text, re.M).group(1))
black, full, dark = key("black_level"), key("saturation"), 4
dither = random.Random(1)
for role in ("raw", "guide"):
    (height, width), values = npy(work / f"bundle/{role}.npy")
    if role == "raw":
        values = [dark + (v - black) / (full - black) * (255 - dark) for v in values]
    else:
        top = 1.0 if values.typecode == "f" else 4095.0 if max(values) > 255 else 255.0
        values = [v / top * 255 for v in values]
    for n in range(8):
        pixels = bytes(min(255, max(0, int(v + dither.random()))) for v in values)
        (work / f"frames/{role}/{n}.pgm").write_bytes(b"P5 %d %d 255\n" % (width, height) + pixels)
for name, value in (("bit_depth", 8), ("black_level", dark), ("saturation", 255), ("read", 0.002)):
    text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.M)
(work / "bundle/calibration.toml").write_text(text)
PY
for pgm in "$work"/frames/*/*.pgm; do
    cjpeg -quality 100 -grayscale -outfile "${pgm%.pgm}.jpg" "$pgm"
    # what any decoder makes of it; beside the pictures there may be no other file
    djpeg -pnm -outfile "$work/shown/$(basename "$(dirname "$pgm")")-$(basename "$pgm")" "${pgm%.pgm}.jpg"
    rm "$pgm"
done
export LIBCAMERA_LOG_LEVELS=${LIBCAMERA_LOG_LEVELS:-*:FATAL}
config=$prefix/share/libcamera/pipeline/virtual
mkdir -p "$config"
{
    echo '%YAML 1.1'
    echo '---'
    for role in raw guide; do
        printf '"stokescope-%s":\n  supported_formats:\n  - width: 256\n    height: 250\n    frame_rates:\n    - 10\n' $role
        printf '  frames:\n    path: "%s/"\n  location: "CameraLocationFront"\n  model: "replayed %s camera"\n' \
            "$work/frames/$role" $role
    done
    # a camera larger than any picture of results
    printf '"stokescope-large":\n  supported_formats:\n'
    for size in '1280 720' '1920 1080'; do
        printf '  - width: %s\n    height: %s\n    frame_rates:\n    - 10\n' ${size% *} ${size#* }
    done
    printf '  test_pattern: "lines"\n  location: "CameraLocationBack"\n  model: "large camera"\n'
} >"$config/virtual.yaml"

say "tests with virtual cameras"
STOKESCOPE_VIRTUAL_CAMERAS=1 "$tests" camera::libcamera --test-threads 1 >"$work/tests.log" 2>&1 || { cat "$work/tests.log"; fail "tests of the backend"; }
grep -q SKIPPED "$work/tests.log" && fail "tests were skipped"
pass "tests of the backend: $(grep -oE '[0-9]+ passed' "$work/tests.log")"

"$bin" cameras --json >"$work/cameras.json"
for role in raw guide; do
    grep -q "\"source\":\"stokescope-$role\"" "$work/cameras.json" || fail "stokescope cameras lists no stokescope-$role"
done
"$bin" cameras >"$work/cameras.txt"
for role in raw guide; do
    grep -A3 "stokescope-$role" "$work/cameras.txt" | grep -q 256×250 || fail "stokescope cameras shows no mode of stokescope-$role"
done
pass "stokescope cameras lists both with their modes, as text and as JSON"

frames=20
"$bin" --json run --board x86-libcamera-virtual --fusion off --frames $frames --no-preview --out "$work/out" >"$work/run.json" \
    2>"$work/run.log" || { cat "$work/run.log"; fail "stokescope run"; }
number() { /usr/bin/python3 -c 'import json, sys; v = json.load(open(sys.argv[1]))
for key in sys.argv[2:]: v = v[key]
print(v)' "$@"; }
[ "$(number "$work/run.json" frames)" = $frames ] || fail "not all frames: $(cat "$work/run.json")"
pass "$frames pairs captured: $(cat "$work/run.json")"

"$bin" capture --board x86-libcamera-virtual --frames 4 --out "$work/session" >/dev/null 2>"$work/capture.log" ||
    { cat "$work/capture.log"; fail "stokescope capture"; }
/usr/bin/python3 - "$work" <<'PY' || fail "captured frames are not those of the cameras"
import pathlib, sys
work = pathlib.Path(sys.argv[1])
for role in ("raw", "guide"):
    shown = [path.read_bytes()[-250 * 256:] for path in sorted((work / "shown").glob(f"{role}-*.pgm"))]
    for path in sorted((work / f"session/{role}").glob("*.npy")):
        counts = path.read_bytes()[-2 * 250 * 256:]
        # libcamera decodes with a faster, coarser transform than djpeg
        near = min(sum(abs(a - b) for a, b in zip(counts[::2], frame)) / len(frame) for frame in shown)
        if any(counts[1::2]) or near > 1.5:
            sys.exit(f"{path}: {near:.2f} counts from the nearest of the frames shown")
PY
pass "captured frames are those of the cameras, to 1.5 counts of 255 on average"

figure() { "$bin" --json evaluate "$1" "$work/exact/truth.npy" >"$work/figure.json" && number "$work/figure.json" psnr; }
"$bin" reconstruct --calibration "$work/exact" --raw "$work/exact/raw.npy" --guide "$work/exact/guide.npy" --fusion off \
    --iterations 20 --out "$work/out4" >/dev/null
exact=$(figure "$work/out4/angles.npy")
live=$(figure "$work/out/angles.npy")
# 8 bits and another draw of the noise may cost this much
awk -v live="$live" -v exact="$exact" 'BEGIN { exit !(live > 25 && live > exact - 1) }' ||
    fail "far from the truth: PSNR $live dB, from files of 16 bits $exact dB"
say "PSNR $live dB through the cameras with 8 bits, $exact dB from files with 16"
pass "polarization images are close to the truth"

# parts of large frames, in blocks of 2 × 2 and of 4 × 4: 256 × 256
for mode in '1280 720 384,104,512,512 2' '1920 1080 448,28,1024,1024 4'; do
    read -r width height crop blocks <<<"$mode"
    rm -rf "$work/large" "$work/out6"
    "$bin" simulate --out "$work/large" --size 256x256 --surround 0 --guide-margin 0 >/dev/null
    sed -i "s/^width = .*/width = $width/; s/^height = .*/height = $height\ncrop = [$crop]\nbin = $blocks/
        s/^bit_depth = .*/bit_depth = 8/; s/^black_level = .*/black_level = 0/; s/^saturation = .*/saturation = 255/" "$work/large/calibration.toml"
    sed "s#../target/libcamera-virtual/bundle#large#; s/stokescope-raw/stokescope-large/; s/^width = .*/width = $width/; s/^height = .*/height = $height/
        s/^\[cameras\]/[cameras]\nguided = false/; s/^inherit = .*/inherit = \"x86-sim\"/" boards/x86-libcamera-virtual.toml |
        awk '/^\[cameras.guide\]/ { exit } 1' >"$work/large.toml"
    "$bin" --json run --board "$work/large.toml" --fusion off --frames 3 --no-preview --out "$work/out6" >"$work/large.json" \
        2>"$work/large.log" || { cat "$work/large.log"; fail "frames of $width×$height"; }
    [ "$(number "$work/large.json" frames)" = 3 ] || fail "not all frames of $width×$height"
    [ "$(number "$work/out6/report.json" size)" = "[256, 256]" ] || fail "frames of $width×$height do not become 256×256"
    pass "frames of $width×$height are cropped and binned to 256×256"
done

# waits for a file: without full optimization the first result takes its time
appears() { for _ in $(seq 600); do [ -e "$1" ] && return; sleep 0.1; done; return 1; }

# a second program cannot have a camera that is in use, and says so; after a kill the next one has it again
"$bin" run --board x86-libcamera-virtual --fusion off --no-preview --out "$work/out2" >/dev/null 2>"$work/first.log" &
first=$!
appears "$work/out2/report.json" || fail "no result in a minute: $(cat "$work/first.log")"
kill -9 $first
wait $first 2>/dev/null || true
"$bin" run --board x86-libcamera-virtual --fusion off --no-preview --frames 3 --out "$work/out2" >/dev/null 2>&1 ||
    fail "after a kill, the cameras cannot be had"
pass "killed in the middle of a capture; the next run has the cameras again"

"$bin" run --board x86-libcamera-virtual --fusion off --no-preview --out "$work/out3" >/dev/null 2>"$work/term.log" &
first=$!
appears "$work/out3/report.json" || fail "no result in a minute: $(cat "$work/term.log")"
begin=$(date +%s)
kill -TERM $first
wait $first || fail "SIGTERM is no clean end: $(cat "$work/term.log")"
[ $(($(date +%s) - begin)) -le 5 ] || fail "SIGTERM takes more than 5 s"
pass "ends cleanly on SIGTERM"

# a camera that hangs: libcamera's thread of the first is halted for six seconds, in which it neither delivers nor can be closed
"$bin" --json run --board x86-libcamera-virtual --fusion off --no-preview --out "$work/out5" >"$work/hung.json" 2>"$work/hung.log" &
first=$!
appears "$work/out5/report.json" || fail "no result in a minute: $(cat "$work/hung.log")"
/usr/bin/python3 - $first <<'PY' || fail "the camera's thread cannot be halted"
import ctypes, os, pathlib, sys, time
SEIZE, INTERRUPT, DETACH, WALL = 0x4206, 0x4207, 17, 0x40000000
libc = ctypes.CDLL(None, use_errno=True)
def ptrace(request, thread):
    if libc.ptrace(request, thread, None, None):
        sys.exit(os.strerror(ctypes.get_errno()))
tasks = sorted(pathlib.Path(f"/proc/{sys.argv[1]}/task").iterdir(), key=lambda task: int(task.name))
thread = next(int(task.name) for task in tasks if (task / "comm").read_text().strip() == "VirtualCamera")
ptrace(SEIZE, thread)
ptrace(INTERRUPT, thread)
os.waitpid(thread, WALL)
time.sleep(6)
ptrace(DETACH, thread)
PY
for _ in $(seq 150); do grep -q 'frames again' "$work/hung.log" && break; sleep 0.1; done
touch "$work/again"
for _ in $(seq 100); do [ "$work/out5/report.json" -nt "$work/again" ] && break; sleep 0.1; done
kill -TERM $first
wait $first || fail "SIGTERM after a hung camera is no clean end: $(cat "$work/hung.log")"
grep -q 'camera offline: .*no frame within' "$work/hung.log" || fail "a hung camera is not told: $(cat "$work/hung.log")"
grep -q 'frames again' "$work/hung.log" || fail "a hung camera is not opened again: $(cat "$work/hung.log")"
[ "$work/out5/report.json" -nt "$work/again" ] || fail "no frame after the camera hung: $(cat "$work/hung.log")"
pass "a camera that hangs is offline, and there again: $(cat "$work/hung.json")"

sed 's/stokescope-guide/no-such-camera/' boards/x86-libcamera-virtual.toml >"$work/missing.toml"
sed -i "s#../target/libcamera-virtual/bundle#bundle#" "$work/missing.toml"
status=0
"$bin" run --board "$work/missing.toml" --no-preview --frames 1 --out "$work/out4" 2>"$work/missing.log" >/dev/null || status=$?
[ $status = 69 ] || fail "exit code $status for a missing camera, 69 expected: $(cat "$work/missing.log")"
grep -q 'no such camera, allowed: ' "$work/missing.log" || fail "a missing camera is not named: $(cat "$work/missing.log")"
pass "a missing camera: exit code 69 and the names of those there are"
say "all passed"
