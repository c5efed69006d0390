#!/usr/bin/env bash
# Checks that the feature `libcamera` builds against the libcamera of Debian stable and of its backports: unpacks their
# packages beside the system and compiles against them (C++ interface and all), on Debian 12 or newer, amd64.
#
#   scripts/libcamera-versions.sh [SUITE…]     default: trixie trixie-backports
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/debian.sh
work=$PWD/target/libcamera-versions
mkdir -p "$work"
debian_need "$work/install.log" g++ pkg-config libclang-dev dpkg-dev
[ $# -gt 0 ] || set -- trixie trixie-backports
for name; do
    root=$work/$name
    if [ ! -e "$root/usr/include/libcamera" ]; then
        rm -rf "$root" && mkdir -p "$root"
        debian_suite "$work/apt-$name" deb "$name" arch=amd64
        suite+=(-o APT::Architecture=amd64)
        # the development package names its libraries, of the same version
        version=$(apt-cache "${suite[@]}" madison libcamera-dev | awk '{ print $3; exit }')
        libraries=$(apt-cache "${suite[@]}" depends "libcamera-dev=$version" | grep -oE 'libcamera(-base)?[0-9][^ ]*' | sort -u)
        (cd "$root" && apt-get "${suite[@]}" download "libcamera-dev=$version" $libraries >"$work/$name.log" 2>&1 &&
            for package in *.deb; do dpkg -x "$package" . && rm "$package"; done)
    fi
    export PKG_CONFIG_SYSROOT_DIR=$root PKG_CONFIG_PATH=$root/usr/lib/x86_64-linux-gnu/pkgconfig
    version=$(pkg-config --modversion libcamera)
    cargo check --locked --features libcamera 2>"$work/$name.log" || { tail -40 "$work/$name.log"; echo "FAIL $name: libcamera $version"; exit 1; }
    echo "PASS $name: builds against libcamera $version"
done
