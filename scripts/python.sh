#!/usr/bin/env bash
# The Python package from nothing: a fresh virtual environment, `pip install crates/python`, and its tests.
#
#   scripts/python.sh [--quick] [PYTEST OPTION ...]
#
# The tests compare with the program. STOKESCOPE names one that is built from this source; without it, a release build is made first.
# --quick, as scripts/check.sh runs it: the module is built like `cargo test` builds, in minutes less. Tests of napari need its window
# library, which pip brings; without it they are skipped, and the last lines say so. Exit code 77: there is no Python 3.9 or newer, or pip
# cannot reach what it needs; nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."
unable() { printf 'python: skipped, not passed: %s\n' "$*" >&2; exit 77; }
python3 -c 'import sys; sys.exit(sys.version_info < (3, 9))' 2>/dev/null || unable "no Python 3.9 or newer"
quick=
[ "${1:-}" = --quick ] && { quick=yes; shift; }
venv=target/python
rm -rf "$venv"
python3 -m venv "$venv" 2>/dev/null || unable "python3 has no venv"
pip() { "$venv/bin/pip" install --quiet --disable-pip-version-check "$@"; }
pip "numpy>=1.22" "pytest>=8" "maturin>=1.9,<2" || unable "pip cannot install numpy, pytest and maturin"
if [ -z "${STOKESCOPE:-}" ]; then
    cargo build --release --locked --bin stokescope
    STOKESCOPE=target/release/stokescope
fi
STOKESCOPE=$(realpath "$STOKESCOPE")
export STOKESCOPE
if [ -n "$quick" ]; then
    # The profile `test` means "build the tests" to `cargo rustc`, which maturin calls: its settings come to `dev` here, so that what is built
    # without features of tests alone is shared.
    export CARGO_PROFILE_DEV_CODEGEN_UNITS=16 CARGO_PROFILE_DEV_DEBUG=false CARGO_PROFILE_DEV_INCREMENTAL=false
    optimised='--config profile.dev.package.stokescope-core.opt-level=3 --config profile.dev.package.stokescope-simulator.opt-level=3'
    export MATURIN_PEP517_ARGS="--profile dev $optimised"
fi
pip "./crates/python[test]"
pip "napari[pyqt6]" || echo "python: pip cannot install napari: its tests are skipped, not passed" >&2
"$venv/bin/python" -m pytest -q -rs --disable-warnings crates/python/tests "$@"
