#!/usr/bin/env bash
# The Python package from nothing: a fresh virtual environment, `pip install crates/python`, and its tests.
#
#   scripts/python.sh [PYTEST OPTION ...]
#
# The tests compare with the program's release build, which is made first. Exit code 77: there is no Python 3.9 or newer, or pip
# cannot reach what it needs; nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."
unable() { printf 'python: skipped, not passed: %s\n' "$*" >&2; exit 77; }
python3 -c 'import sys; sys.exit(sys.version_info < (3, 9))' 2>/dev/null || unable "no Python 3.9 or newer"
venv=target/python
rm -rf "$venv"
python3 -m venv "$venv" 2>/dev/null || unable "python3 has no venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check "numpy>=1.22" "pytest>=8" "tifffile" "maturin>=1.9,<2" || unable "pip cannot install numpy, pytest, tifffile and maturin"
cargo build --release --locked --bin stokescope
"$venv/bin/pip" install --quiet --disable-pip-version-check ./crates/python
STOKESCOPE=$PWD/target/release/stokescope "$venv/bin/python" -m pytest -q crates/python/tests "$@"
