#!/usr/bin/env bash
# Measures rounding, conditioning and scale, and writes the figures into docs/stability.md. Takes minutes.
set -euo pipefail
cd "$(dirname "$0")/.."

measured() { # TEST: what its tests print, without the test runner's words
  cargo test --quiet --test "$1" -- --format pretty --nocapture --include-ignored --test-threads 1
}

tables=$(measured stability | grep -E '^(###|\||$)' | cat -s)
cases=$(measured hard_cases | sed -nE 's/^test (.*) \.\.\. ?/\1\n  /; t split; /^(running|test result|ok$|$)/d; s/^/  /; :split; p' |
  sed -E '/^ *(ok)?$/d')
document=docs/stability.md
{
  sed '/^<!-- figures -->$/q' $document
  printf '\n%s\n\n### Hard cases\n\n```text\n%s\n```\n\n' "$tables" "$cases"
  sed -n '/^<!-- end -->$/,$p' $document
} > $document.new
mv $document.new $document
