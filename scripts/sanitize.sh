#!/usr/bin/env bash
# The unsafe code under scrutiny: runs the tests of the rooms that contain any under valgrind's memcheck, and, where the toolchain
# has its runtime, under ThreadSanitizer. (Miri needs a nightly toolchain; where there is one: cargo miri test --lib parallel::)
#
#   scripts/sanitize.sh [TEST]    tests whose names contain TEST, default parallel::
#
# Exit code 77: neither tool is here, nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."

filter=${1:-parallel::}
ran=
if command -v valgrind >/dev/null; then
    binary=$(cargo test --lib --no-run --locked --message-format json |
        sed -n 's/.*"executable":"\([^"]*\)".*/\1/p' | tail -n 1)
    valgrind --quiet --error-exitcode=1 --leak-check=no "$binary" --test-threads 1 "$filter"
    ran=1
else
    echo "sanitize: memcheck skipped, not passed: no valgrind" >&2
fi
host=$(rustc -vV | sed -n 's/^host: //p')
if compgen -G "$(rustc --print sysroot)/lib/rustlib/$host/lib/librustc*tsan*" >/dev/null; then
    # the standard library is not instrumented; its own synchronization is known to the runtime all the same
    RUSTC_BOOTSTRAP=1 RUSTFLAGS="-Zsanitizer=thread -Cunsafe-allow-abi-mismatch=sanitizer" CARGO_TARGET_DIR=target/sanitize \
        cargo test --lib --locked --target "$host" -- "$filter"
    ran=1
else
    echo "sanitize: ThreadSanitizer skipped, not passed: the toolchain has no runtime of it" >&2
fi
[ -n "$ran" ] || exit 77
