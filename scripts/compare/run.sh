#!/usr/bin/env bash
# Time to equal error: the program beside NumPy versions of the published solvers and beside LenslessPiCam.
#
#   scripts/compare/run.sh WORK [--bundles DIR] [--diffusercam DIR]
#
# WORK        folder for Python environments, bundles and results; made if need be
# --bundles   folder of gray striped bundles with raw.npy, guide.npy and truth.npy; without it four are simulated
# --diffusercam  folder with psf_sample.tif and rawdata_hand_sample.tif of the DiffuserCam tutorial, for the second comparison
#
# STOKESCOPE names the program; without it target/release/stokescope is built. Everything runs on one thread.
# What cannot be installed or read is skipped with its reason.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)

usage() { sed -n '2,12s/^# \{0,1\}//p' "$0"; exit 2; }
[ $# -ge 1 ] || usage
work=$1; shift
bundles=; diffusercam=
while [ $# -gt 0 ]; do
  case $1 in
    --bundles) bundles=$(cd "$2" && pwd); shift 2 ;;
    --diffusercam) diffusercam=$(cd "$2" && pwd); shift 2 ;;
    *) usage ;;
  esac
done
mkdir -p "$work"; work=$(cd "$work" && pwd)
export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 STOKESCOPE_LOG=error

if [ -z "${STOKESCOPE:-}" ]; then
  (cd "$root" && cargo build --release --quiet)
  STOKESCOPE=$root/target/release/stokescope
fi
export STOKESCOPE
echo "machine: $(sed -n 's/^model name[^:]*: //p;s/^Model[^:]*: //p' /proc/cpuinfo | head -1), $(nproc --all) cores"
skip() { echo "skipped: $*"; }

# A Python environment of its own for each comparison: their NumPy versions differ.
environment() { # NAME PACKAGE...
  local name=$1; shift
  local marker="$work/$name/ready"
  [ -e "$marker" ] && return 0
  python3 -m venv "$work/$name" > "$work/$name.log" 2>&1 &&
    "$work/$name/bin/pip" install --quiet "$@" >> "$work/$name.log" 2>&1 && touch "$marker"
}

if environment numpy numpy scipy pillow tifffile; then
  if [ -z "$bundles" ]; then
    bundles=$work/bundles
    for scene in plastic spheres wedges tissue; do
      "$STOKESCOPE" simulate --scene "$scene" --out "$bundles/$scene" > /dev/null
    done
  fi
  "$work/numpy/bin/python" "$here/polarization.py" "$bundles" "$work/polarization"
else
  skip "NumPy comparison: numpy, scipy, pillow and tifffile could not be installed, see $work/numpy.log"
  exit 0
fi

if [ -z "$diffusercam" ]; then
  skip "LenslessPiCam comparison: no --diffusercam DIR"
elif ! environment lensless lensless; then
  skip "LenslessPiCam comparison: the package lensless could not be installed, see $work/lensless.log"
else
  "$work/numpy/bin/python" "$root/scripts/real_bundles.py" diffusercam "$diffusercam" "$work/diffusercam" --size 400x300
  "$work/lensless/bin/python" "$here/intensity.py" "$work/diffusercam" "$work/intensity"
fi
