#!/usr/bin/env bash
# Wheels of the Python package for x86-64 and aarch64 Linux (manylinux 2.28, Python 3.9 and newer), in target/wheels.
#
#   scripts/wheels.sh [x86_64|aarch64 ...]
#
# zig, a package of pip, links against the old C library for both. Each wheel is at most 15 MB, is imported, and solves a frame: that of
# aarch64 under qemu, see scripts/lib/try-wheel.sh. Exit code 77: a wheel was built and could not be tried here.
set -euo pipefail
cd "$(dirname "$0")/.."
most=$((15 << 20))
tools=target/wheels-tools
[ $# -gt 0 ] || set -- x86_64 aarch64
if [ ! -x "$tools/bin/maturin" ]; then
    python3 -m venv "$tools"
    "$tools/bin/pip" install --quiet --disable-pip-version-check "maturin>=1.9,<2" ziglang
fi
export PATH=$PWD/$tools/bin:$PATH
untried=0
for machine; do
    rustup target add "$machine-unknown-linux-gnu" >/dev/null 2>&1 || true
    rm -f target/wheels/stokescope-*"$machine".whl
    maturin build --release --locked --zig --compatibility manylinux_2_28 --target "$machine-unknown-linux-gnu" \
        --manifest-path crates/python/Cargo.toml --out target/wheels
    wheel=$(ls target/wheels/stokescope-*"$machine".whl)
    bytes=$(stat -c %s "$wheel")
    printf 'wheels: %s: %d bytes, allowed: %d\n' "$wheel" "$bytes" "$most"
    [ "$bytes" -le "$most" ]
    code=0
    scripts/lib/try-wheel.sh "$wheel" "$machine" || code=$?
    case $code in 0) ;; 77) untried=77 ;; *) exit $code ;; esac
done
exit $untried
