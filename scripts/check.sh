#!/usr/bin/env bash
# Everything a change must pass: format, lints, tests, the Python package, documentation. CI runs this and nothing else.
set -euo pipefail
cd "$(dirname "$0")/.."

step() { printf '\n== %s\n' "$*"; "$@"; }
# A step that this machine may lack the tools for; its exit code is 77 then.
step_or_skip() { step "$@" || { local code=$?; [ $code = 77 ] && printf '\n== SKIPPED, NOT PASSED: %s\n' "$*" || exit $code; }; }

step cargo fmt --all --check
step cargo clippy --workspace --all-targets --locked -- -D warnings
# The packages without what is optional, in one build for all three; then the program without the engine of stage II.
step cargo clippy -p stokescope-core -p stokescope-simulator -p stokescope --no-default-features --all-targets --locked -- -D warnings
step cargo clippy --package stokescope --no-default-features --features program --locked -- -D warnings
# Cameras of GenICam are tested with Aravis' fake one, where it is installed (scripts/genicam.sh installs and tests more).
genicam=()
if pkg-config --exists aravis-0.8 2>/dev/null && command -v arv-fake-gv-camera-0.8 >/dev/null; then
    genicam=(--features genicam)
else
    printf '\n== SKIPPED: tests of GenICam cameras, because libaravis-dev and aravis-tools are not installed\n'
fi
step cargo test --workspace --locked "${genicam[@]}"
# Against the program that the tests have just built.
STOKESCOPE=target/debug/stokescope step_or_skip scripts/python.sh --quick
RUSTDOCFLAGS="-D warnings" step cargo doc --workspace --no-deps --locked
