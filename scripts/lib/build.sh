# shellcheck shell=bash
# The program and its tests with a camera backend, for scripts to source.

# build_with FEATURE LOG: the program with a backend in `bin`, the unit tests of its package in `tests`. STOKESCOPE and STOKESCOPE_TESTS
# name ones that are built already; CARGO_FLAGS are flags of cargo for the others.
build_with() {
    local feature=$1 log=$2
    bin=${STOKESCOPE:-} tests=${STOKESCOPE_TESTS:-}
    if [ -z "$bin" ]; then
        cargo build --features "$feature" ${CARGO_FLAGS:-} || return 1
        bin=$PWD/target/debug/stokescope
    fi
    if [ -z "$tests" ]; then
        cargo test --profile dev --features "$feature" ${CARGO_FLAGS:-} --lib --no-run 2>"$log" || { cat "$log" >&2; return 1; }
        tests=$PWD/$(grep -oE 'target/[^ )]*/deps/stokescope-[0-9a-f]+' "$log" | tail -1)
    fi
    if "$bin" cameras 2>&1 | grep -q -- "--features $feature\$"; then
        echo "$bin was built without the feature $feature" >&2
        return 1
    fi
}
