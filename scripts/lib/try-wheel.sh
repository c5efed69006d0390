#!/usr/bin/env bash
# Imports a wheel of the Python package and solves a frame with it.
#
#   scripts/lib/try-wheel.sh WHEEL x86_64|aarch64
#
# For aarch64 it takes Python from Debian and NumPy from pip, unpacks both below target/wheels-aarch64 and runs them under qemu; the machine's
# own packages stay as they are, but for qemu-user-static. Exit code 77: what is needed cannot be had here, nothing was tried.
set -euo pipefail
wheel=$(realpath "$1") machine=$2
cd "$(dirname "$0")/../.."
. scripts/lib/debian.sh
unable() { printf 'try-wheel: skipped, not passed: %s\n' "$*" >&2; exit 77; }
kept=$PWD/target/wheels-$machine
mkdir -p "$kept"
rm -rf "$kept/site"
python3 -m zipfile -e "$wheel" "$kept/site"

# numpy_into FOLDER [PIP OPTION ...]
numpy_into() {
    [ -d "$1/numpy" ] || PIP_ROOT_USER_ACTION=ignore python3 -m pip install --quiet --disable-pip-version-check --no-deps --target "$@" \
        "numpy<2.3" || unable "pip cannot install numpy"
}

# Python 3.11 of Debian 12 for aarch64, unpacked.
foreign_python() {
    [ -x "$kept/root/usr/bin/python3.11" ] && return
    local packages=(libc6 libgcc-s1 libstdc++6 zlib1g libexpat1 libffi8 libssl3 libbz2-1.0 liblzma5 libuuid1 libpython3.11-minimal
        libpython3.11-stdlib python3.11-minimal)
    debian_suite "$kept/apt" deb bookworm arch=arm64 || unable "no package lists of Debian for aarch64"
    mkdir -p "$kept/debs"
    (cd "$kept/debs" && apt-get "${suite[@]}" -o APT::Architecture=arm64 -o APT::Architectures::=arm64 download "${packages[@]/%/:arm64}") \
        >"$kept/apt.log" 2>&1 || unable "apt cannot download Python for aarch64 (see $kept/apt.log)"
    local package
    for package in "$kept"/debs/*.deb; do dpkg -x "$package" "$kept/root"; done
}

case $machine in
    x86_64)
        python=(python3)
        numpy_into "$kept/numpy"
        ;;
    aarch64)
        debian_need "$kept/apt.log" qemu-user-static || unable "qemu-user-static is missing"
        foreign_python
        python=(qemu-aarch64-static -L "$kept/root" "$kept/root/usr/bin/python3.11")
        numpy_into "$kept/numpy" --platform manylinux2014_aarch64 --python-version 3.11 --only-binary :all:
        ;;
    *) echo "try-wheel: $machine, allowed: x86_64, aarch64" >&2; exit 2 ;;
esac
"${python[@]}" -c '
import platform, sys
sys.path[:0] = sys.argv[1:]
import numpy as np, stokescope as ss
capture = ss.simulate("wedges", size=64, noise=0.001, surround=0, guide_margin=0)
result = ss.Pipeline(capture.device, iterations=8, threads=1)(capture.raw, capture.guide)
psnr = ss.evaluate(result, capture.truth)["psnr"]
assert np.isfinite(result.stokes).all() and psnr > 25, psnr
print(f"try-wheel: {platform.machine()}, {ss.__file__}: a frame is solved, {psnr:.1f} dB")
' "$kept/site" "$kept/numpy"
