#!/usr/bin/env bash
# Captures through the real Aravis, without hardware: Debian's fake GigE Vision camera on the loopback interface, the tests of the backend
# with it, `stokescope cameras`, `doctor` and `capture`, and a camera that is lost. Run as root it installs what it needs.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/debian.sh
work=$PWD/target/genicam
mkdir -p "$work"

say() { printf '== %s\n' "$*"; }
fail() { printf 'FAIL %s\n' "$*" >&2; exit 1; }
pass() { printf 'PASS %s\n' "$*"; }

debian_need "$work/install.log" libaravis-dev libusb-1.0-0-dev aravis-tools pkg-config || fail "packages"
say "aravis $(pkg-config --modversion aravis-0.8)"

say "build"
cargo build --features genicam ${CARGO_FLAGS:-}
cargo test --profile dev --features genicam ${CARGO_FLAGS:-} --lib --no-run 2>"$work/tests.log" || { cat "$work/tests.log"; fail "build of the tests"; }
tests=$(grep -oE 'target/[^ )]*/deps/stokescope-[0-9a-f]+' "$work/tests.log" | tail -1)
bin=target/debug/stokescope

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

STOKESCOPE_GENICAM=$id "$tests" camera::genicam --test-threads 1 >"$work/tests.log" 2>&1 || { cat "$work/tests.log"; fail "tests of the backend"; }
grep -q SKIPPED "$work/tests.log" && fail "tests were skipped"
pass "tests of the backend: $(grep -oE '[0-9]+ passed' "$work/tests.log")"

printf 'inherit = "x86-sim"\ndescription = "a GenICam camera"\n[cameras]\nguided = false\n[cameras.raw]\nbackend = "genicam"\nsource = "%s"
width = 640\nheight = 480\nformat = "mono8"\nframe_rate = 10.0\nexposure_us = 8000.0\n' "$id" >"$work/board.toml"
"$bin" doctor --board "$work/board.toml" --listen 127.0.0.1:0 --out "$work/out" >"$work/doctor.log" 2>&1 || true
grep -qE 'fine +raw camera .*mono 8-bit of 640×480' "$work/doctor.log" || { cat "$work/doctor.log"; fail "doctor"; }
pass "doctor opens it: $(grep 'raw camera' "$work/doctor.log")"

rm -rf "$work/session"
"$bin" capture --board "$work/board.toml" --frames 5 --out "$work/session" >/dev/null 2>"$work/capture.log" || { cat "$work/capture.log"; fail "capture"; }
[ "$(find "$work/session/raw" -name '*.npy' | wc -l)" = 5 ] || fail "not all frames"
pass "5 frames captured"

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
