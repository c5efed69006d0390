#!/usr/bin/env bash
# Everything a change must pass: format, lints, tests, documentation. CI runs this and nothing else.
set -euo pipefail
cd "$(dirname "$0")/.."

step() { printf '\n== %s\n' "$*"; "$@"; }

step cargo fmt --check
step cargo clippy --all-targets --locked -- -D warnings
step cargo test --locked
RUSTDOCFLAGS="-D warnings" step cargo doc --no-deps --locked
