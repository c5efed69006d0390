#!/usr/bin/env bash
# Captures through the real Aravis, without hardware: Debian's fake GigE Vision camera on the loopback interface, the tests of the backend
# with it, `stokescope cameras`, `doctor` and `capture`, and a camera that is lost. Run as root it installs what it needs; exit code 77 says
# that this machine has no packages of Aravis. STOKESCOPE, STOKESCOPE_TESTS: see scripts/lib/build.sh.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/build.sh
. scripts/lib/debian.sh
work=$PWD/target/genicam
mkdir -p "$work"

say() { printf '== %s\n' "$*"; }
fail() { printf 'FAIL %s\n' "$*" >&2; exit 1; }
pass() { printf 'PASS %s\n' "$*"; }

debian_need "$work/install.log" libaravis-dev libusb-1.0-0-dev aravis-tools pkg-config || {
    say "SKIPPED: no Aravis"
    exit 77
}
say "aravis $(pkg-config --modversion aravis-0.8)"

say "build"
build_with genicam "$work/tests.log" || fail "build"

"$tests" camera::genicam >"$work/tests.log" 2>&1 || { cat "$work/tests.log"; fail "tests of the backend"; }
grep -q SKIPPED "$work/tests.log" && fail "tests were skipped"
pass "tests of the backend: $(grep -oE '[0-9]+ passed' "$work/tests.log")"

serial=STOKESCOPE
arv-fake-gv-camera-0.8 -i 127.0.0.1 -s $serial >"$work/fake.log" 2>&1 &
fake=$!
trap 'kill $fake 2>/dev/null || true' EXIT
for _ in $(seq 50); do
    "$bin" cameras --json >"$work/cameras.json"
    id=$(grep -oE "\"source\":\"[^\"]*$serial\"" "$work/cameras.json" | head -1 | cut -d'"' -f4) && [ -n "$id" ] && break
    sleep 0.2
done
[ -n "${id:-}" ] || { cat "$work/fake.log" "$work/cameras.json"; fail "the fake camera is not listed"; }
pass "stokescope cameras lists $id"

printf 'inherit = "x86-sim"\ndescription = "a GenICam camera"\n[cameras]\nguided = false\n[cameras.raw]\nbackend = "genicam"\nsource = "%s"
width = 640\nheight = 480\nformat = "mono8"\nframe_rate = 10.0\nexposure_us = 8000.0\n' "$id" >"$work/board.toml"
"$bin" doctor --board "$work/board.toml" --listen 127.0.0.1:0 --out "$work/out" >"$work/doctor.log" 2>&1 || true
grep -qE 'fine +raw camera .*mono 8-bit of 640×480' "$work/doctor.log" || { cat "$work/doctor.log"; fail "doctor"; }
pass "doctor opens it: $(grep 'raw camera' "$work/doctor.log")"

rm -rf "$work/session"
"$bin" capture --board "$work/board.toml" --frames 5 --out "$work/session" >/dev/null 2>"$work/capture.log" || { cat "$work/capture.log"; fail "capture"; }
[ "$(find "$work/session/raw" -name '*.npy' | wc -l)" = 5 ] || fail "not all frames"
pass "5 frames captured"

# a part of its frames in blocks of 2 × 2 becomes pictures
rm -rf "$work/bundle" "$work/pictures"
"$bin" simulate --out "$work/bundle" --size 128x128 --surround 0 --guide-margin 0 >/dev/null
sed -i 's/^width = .*/width = 640/; s/^height = .*/height = 480\ncrop = [192, 112, 256, 256]\nbin = 2/
    s/^bit_depth = .*/bit_depth = 8/; s/^black_level = .*/black_level = 0/; s/^saturation = .*/saturation = 255/' "$work/bundle/calibration.toml"
sed 's/^\[cameras\]/[cameras]\ncalibration = "bundle"/' "$work/board.toml" >"$work/run.toml"
"$bin" --json run --board "$work/run.toml" --fusion off --no-preview --frames 3 --out "$work/pictures" >"$work/run.json" 2>"$work/run.log" ||
    { cat "$work/run.log"; fail "run"; }
grep -q '"frames":3' "$work/run.json" || { cat "$work/run.json"; fail "not all frames"; }
tr -d ' \n' <"$work/pictures/report.json" | grep -q '"size":\[128,128\]' || { cat "$work/pictures/report.json"; fail "frames are not 128×128"; }
pass "frames of 640×480 are cropped and binned to 128×128: $(cat "$work/run.json")"

# with an external trigger silence is no fault
sed 's/^source = .*/source = "'"$id"',trigger=Software"/; s/^frame_rate = .*/&\ntrigger = "external"/' "$work/run.toml" >"$work/trigger.toml"
"$bin" run --board "$work/trigger.toml" --fusion off --listen 127.0.0.1:0 --out "$work/pictures" >"$work/trigger.log" 2>&1 &
run=$!
for _ in $(seq 100); do
    page=$(grep -oE 'http://127[^ ]*' "$work/trigger.log" | head -1) || true
    waits=$(curl -sf "${page}state" | tr -d ' \n' | grep -oE '"waiting":"[^"]*"') && break
    sleep 0.2
done
[ -n "${waits:-}" ] || { cat "$work/trigger.log"; fail "the camera does not wait for its trigger"; }
curl -sf "${page}healthz" >/dev/null || fail "the service is not well while it waits"
kill $run && wait $run || true
pass "waits for its trigger, and the service is well: $waits"

# the camera is switched off in the middle of a capture
rm -rf "$work/lost"
status=0
"$bin" capture --board "$work/board.toml" --frames 500 --out "$work/lost" >/dev/null 2>"$work/lost.log" &
capture=$!
sleep 3
kill -9 $fake
wait $capture || status=$?
[ $status = 69 ] || { cat "$work/lost.log"; fail "exit code $status for a lost camera, 69 expected"; }
pass "a lost camera ends the capture: $(tail -1 "$work/lost.log")"
say "all passed"
