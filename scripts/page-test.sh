#!/usr/bin/env bash
# The page in a real browser: every control of it, with assertions, and pictures of it in the folder given (default target/page).
# Needs Chromium and ChromeDriver (Debian: chromium, chromium-driver) and Python 3; says so and ends with 77 where they are missing.
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
# axe-core checks accessibility; it stays in target/
if [ -z "${AXE:-}" ] && command -v npm >/dev/null; then
  npm install --silent --no-save --prefix target/axe axe-core@4 >/dev/null 2>&1 || true
  AXE=target/axe/node_modules/axe-core/axe.min.js
fi
[ -f "${AXE:-}" ] && export AXE || unset AXE
exec python3 tests/page/page_test.py "$binary" "${1:-target/page}"
