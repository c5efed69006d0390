#!/usr/bin/env bash
# So many small frames (default 100000) through the whole service: memory, open files and threads must stay what they were.
set -euo pipefail
cd "$(dirname "$0")/.."
STOKESCOPE_SOAK=${1:-100000} exec cargo test --locked --test faults fault_24 -- --nocapture
