#!/usr/bin/env bash
# Measures rounding, conditioning and scale, and writes the figures into docs/stability.md. Takes minutes.
set -euo pipefail
cd "$(dirname "$0")/.."

measured() { # TEST [OPTION…]: what its tests print, without the test runner's words
  local test=$1
  shift
  cargo test --quiet --test "$test" -- --format pretty --nocapture --include-ignored --test-threads 1 "$@"
}

# the drift over 100 iterations is part of that over 10 000
tables=$(measured stability --exact --skip rounding_stays_small | grep -E '^(###|\||$)' | cat -s)
# printed TEST: the names of its tests, each followed by what it prints
printed() {
  measured "$1" | sed -nE 's/^test (.*) \.\.\. ?/\1\n  /; t split; /^(running|test result|ok$|$)/d; s/^/  /; :split; p' |
    sed -E '/^ *(ok)?$/d'
}
cases=$(printed hard_cases; printed beyond)
document=docs/stability.md
{
  sed '/^<!-- figures -->$/q' $document
  printf '\n%s\n\n### Hard cases\n\n```text\n%s\n```\n\n' "$tables" "$cases"
  sed -n '/^<!-- end -->$/,$p' $document
} > $document.new
mv $document.new $document
