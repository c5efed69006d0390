# shellcheck shell=bash
# Programs that cargo brings, for scripts to source.

# cargo_tool NAME REQUIREMENT: puts a program into the path, installed to target/tools where it is missing.
cargo_tool() {
    export PATH=$PWD/target/tools/bin:$PATH
    command -v "$1" >/dev/null || cargo install --quiet --locked --root target/tools --version "$2" "$1" >&2 ||
        { echo "cargo cannot install $1" >&2; return 1; }
}
