#!/usr/bin/env bash
# The page in a real browser: every control of it, and the setup of a device, with assertions, and pictures of both in the folder given
# (default target/page). Needs Chromium and ChromeDriver (Debian: chromium, chromium-driver) and Python 3; says so and ends with 77 where
# they are missing.
set -euo pipefail
cd "$(dirname "$0")/.."
for program in chromium chromedriver python3; do
  command -v "$program" >/dev/null || { echo "skipped: $program is not installed" >&2; exit 77; }
done
binary=${STOKESCOPE:-}
if [ -z "$binary" ]; then
  cargo build --release --locked
  binary=target/release/stokescope
fi
# axe-core checks accessibility and tifffile opens results; both stay in target/
python=target/page-python
[ -x $python/bin/python ] || python3 -m venv $python
$python/bin/pip install --quiet tifffile axe-core-python || echo "left out: what needs tifffile and axe-core" >&2
axe=$(echo $python/lib/python3*/site-packages/axe_core_python/axe.min.js)
[ -f "${AXE:-$axe}" ] && export AXE="${AXE:-$axe}" || unset AXE
pictures=${1:-target/page}
$python/bin/python tests/page/page_test.py "$binary" "$pictures"
exec $python/bin/python tests/page/setup_test.py "$binary" "$pictures"
