#!/usr/bin/env bash
# Fuzzes every parser for so many seconds each (default 60), guided by coverage: scripts/fuzz.sh [SECONDS] [TARGET…]
# Needs cargo-fuzz; RUSTC_BOOTSTRAP lets a stable compiler take the sanitizer's flags.
set -euo pipefail
cd "$(dirname "$0")/.."
command -v cargo-fuzz >/dev/null || { echo "skipped: cargo-fuzz is not installed (cargo install cargo-fuzz)" >&2; exit 77; }
seconds=${1:-60}
shift || true
targets=("$@")
[ ${#targets[@]} -gt 0 ] || targets=(board bundle manifest npy image request session model)
host=$(rustc -vV | sed -n 's/^host: //p')
# networks are opened by the program, in a process of its own
if [[ " ${targets[*]} " == *" model "* ]] && [ -z "${STOKESCOPE:-}" ]; then
  cargo build --release --locked
  export STOKESCOPE=$PWD/target/release/stokescope
fi
for target in "${targets[@]}"; do
  # what it finds goes to a corpus of its own: the one in the repository stays small
  found=target/fuzz-corpus/$target
  mkdir -p "$found"
  RUSTC_BOOTSTRAP=1 cargo fuzz run --target "$host" "$target" "$found" "fuzz/corpus/$target" -- \
    -max_total_time="$seconds" -max_len=32768 -rss_limit_mb=512 -timeout=20
done
