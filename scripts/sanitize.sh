#!/usr/bin/env bash
# The unsafe code under scrutiny: runs the tests of the modules that contain any under Miri, under valgrind's memcheck and under
# ThreadSanitizer.
#
#   scripts/sanitize.sh [TEST ...]    tests whose names contain TEST, default: threads and the integer convolution
#
# Miri needs a nightly toolchain (rustup toolchain install nightly --component miri), knows no AVX-512 and so takes the portable loop
# of the convolution; the others take what the processor has. Exit code 77: none of the tools is here, nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# -gt 0 ] || set -- parallel:: int8::
ran=
if cargo +nightly miri --version >/dev/null 2>&1; then
    MIRIFLAGS="-Zmiri-disable-isolation" CARGO_TARGET_DIR=target/miri cargo +nightly miri test -p stokescope-core --lib --locked -- "$@"
    ran=1
else
    echo "sanitize: Miri skipped, not passed: no nightly toolchain with it" >&2
fi
if command -v valgrind >/dev/null; then
    binary=$(cargo test -p stokescope-core --lib --no-run --locked --message-format json |
        sed -n 's/.*"executable":"\([^"]*\)".*/\1/p' | tail -n 1)
    valgrind --quiet --error-exitcode=1 --leak-check=no "$binary" --test-threads 1 "$@"
    ran=1
else
    echo "sanitize: memcheck skipped, not passed: no valgrind" >&2
fi
host=$(rustc -vV | sed -n 's/^host: //p')
if compgen -G "$(rustc --print sysroot)/lib/rustlib/$host/lib/librustc*tsan*" >/dev/null; then
    # the standard library is not instrumented; its own synchronization is known to the runtime all the same
    RUSTC_BOOTSTRAP=1 RUSTFLAGS="-Zsanitizer=thread -Cunsafe-allow-abi-mismatch=sanitizer" CARGO_TARGET_DIR=target/sanitize \
        cargo test -p stokescope-core --lib --locked --target "$host" -- "$@"
    ran=1
else
    echo "sanitize: ThreadSanitizer skipped, not passed: the toolchain has no runtime of it" >&2
fi
[ -n "$ran" ] || exit 77
