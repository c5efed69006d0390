#!/usr/bin/env bash
# The Python package from nothing: a fresh virtual environment, `pip install crates/python`, and its tests.
#
#   scripts/python.sh [PYTEST OPTION ...]
#
# The tests compare with the program, which is built first. Both are release builds; with STOKESCOPE_PROFILE=test they share what
# `cargo test` has built, which takes minutes less. Tests of napari need its window library, which pip brings; without it they are skipped,
# and the last lines say so. Exit code 77: there is no Python 3.9 or newer, or pip cannot reach what it needs; nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."
unable() { printf 'python: skipped, not passed: %s\n' "$*" >&2; exit 77; }
python3 -c 'import sys; sys.exit(sys.version_info < (3, 9))' 2>/dev/null || unable "no Python 3.9 or newer"
profile=${STOKESCOPE_PROFILE:-release}
built=target/$profile
[ "$profile" = test ] && built=target/debug
venv=target/python
rm -rf "$venv"
python3 -m venv "$venv" 2>/dev/null || unable "python3 has no venv"
pip() { "$venv/bin/pip" install --quiet --disable-pip-version-check "$@"; }
pip "numpy>=1.22" "pytest>=8" "maturin>=1.9,<2" || unable "pip cannot install numpy, pytest and maturin"
cargo build --profile "$profile" --locked --bin stokescope
MATURIN_PEP517_ARGS="--profile $profile" pip "./crates/python[test]"
pip "napari[pyqt6]" || echo "python: pip cannot install napari: its tests are skipped, not passed" >&2
STOKESCOPE=$PWD/$built/stokescope "$venv/bin/python" -m pytest -q -rs crates/python/tests "$@"
