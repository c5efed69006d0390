#!/usr/bin/env bash
# Kills a recording service so many times (default 5000) at random moments and looks at every visible file.
set -euo pipefail
cd "$(dirname "$0")/.."
STOKESCOPE_KILLS=${1:-5000} exec cargo test --locked --test faults fault_14 -- --nocapture
