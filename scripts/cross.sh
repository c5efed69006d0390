#!/usr/bin/env bash
# The program and its tests on ARM from any Debian PC: builds for aarch64 (and armv7), runs the whole test suite under qemu.
#
#   scripts/cross.sh            build and test for aarch64, build for armv7, print sizes
#   scripts/cross.sh build      build only; the binaries' paths are printed
#   scripts/cross.sh test ...   `cargo test ...` for aarch64 under qemu
#   scripts/cross.sh cargo ...  any cargo command for aarch64
#
# What is missing is installed: cross compilers and qemu from Debian, the target's standard library through rustup, or, where
# rustup has none to offer, built from Debian's package of the same Rust version's source. Everything else is kept in
# target/cross. Exit code 77: the tools cannot be had here, nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/debian.sh

A64=aarch64-unknown-linux-gnu
V7=armv7-unknown-linux-gnueabihf
kept=$PWD/target/cross
version=$(rustc --version | cut -d' ' -f2)
host=$(rustc -vV | sed -n 's/^host: //p')
root=$(rustc --print sysroot)
mkdir -p "$kept"

unable() { printf 'cross: skipped, not passed: %s\n' "$*" >&2; exit 77; }
need() { debian_need "$kept/apt.log" "$@" || unable "apt cannot install what is needed"; }
foreign() { debian_foreign qemu-aarch64 || unable "the kernel starts no programs of the target"; }
has_std() { compgen -G "$1/lib/rustlib/$2/lib/libstd-*.rlib" >/dev/null; }

# The standard library's source of this very Rust version, from a newer Debian suite with lists and cache of its own.
rust_source() {
    local sources=$kept/rust-src apt=$kept/apt name
    local found=$sources/usr/src/rustc-$version/library
    [ -d "$found" ] && { echo "$found"; return; }
    for name in trixie-backports bookworm-backports forky sid; do
        debian_suite "$apt" deb "$name" || continue
        local have
        have=$(apt-cache "${suite[@]}" madison rust-src | awk -v v="$version" -F' *[|] *' 'index($2, v) == 1 { print $2; exit }')
        [ -n "$have" ] || continue
        (cd "$apt" && apt-get "${suite[@]}" download "rust-src=$have") >>"$kept/apt.log" 2>&1 || continue
        mkdir -p "$sources" && dpkg -x "$apt"/rust-src_*.deb "$sources" && { echo "$found"; return; }
    done
    unable "no Debian suite has the source of Rust $version, and rustup has no standard library for the target"
}

# A sysroot with the target's standard library: the toolchain's own, or one made here.
sysroot() {
    local target=$1 made=$kept/sysroot-$version
    has_std "$root" "$target" && { echo "$root"; return; }
    has_std "$made" "$target" && { echo "$made"; return; }
    if command -v rustup >/dev/null && rustup target add "$target" >"$kept/rustup.log" 2>&1 && has_std "$root" "$target"; then
        echo "$root"
        return
    fi
    local library stub=$kept/stub
    library=$(rust_source)
    mkdir -p "$stub/src"
    printf '[package]\nname = "stub"\nversion = "0.0.0"\nedition = "2024"\n[workspace]\n' >"$stub/Cargo.toml"
    : >"$stub/src/lib.rs"
    (cd "$stub" && RUSTC_BOOTSTRAP=1 __CARGO_TESTS_ONLY_SRC_ROOT=$library \
        cargo build --release -Zbuild-std=std,panic_unwind,test --target "$target") >"$kept/std-$target.log" 2>&1 ||
        unable "the standard library does not build (see $kept/std-$target.log)"
    mkdir -p "$made/lib/rustlib/$target/lib"
    ln -sfn "$root/lib/rustlib/$host" "$made/lib/rustlib/$host"
    cp "$stub/target/$target/release/deps/"*.{rlib,rmeta} "$made/lib/rustlib/$target/lib/"
    echo "$made"
}

# Sets what cargo needs for a target: linker, compiler, standard library, and qemu to run what was built.
prepare() {
    local target=$1 tools=$2 qemu=$3 made upper
    case $target in
        "$A64") need gcc-aarch64-linux-gnu g++-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static ;;
        "$V7") need gcc-arm-linux-gnueabihf libc6-dev-armhf-cross ;;
    esac
    made=$(sysroot "$target")
    if [ "$made" != "$root" ]; then
        for tool in rustc rustdoc; do
            printf '#!/bin/sh\nexec %q --sysroot %q "$@"\n' "$root/bin/$tool" "$made" >"$kept/$tool"
            chmod +x "$kept/$tool"
        done
        export RUSTC=$kept/rustc RUSTDOC=$kept/rustdoc
    fi
    upper=${target^^} && upper=${upper//-/_}
    export CARGO_BUILD_TARGET=$target CARGO_TARGET_DIR=$kept/target
    export "CARGO_TARGET_${upper}_LINKER=$tools-gcc" "CC_${target//-/_}=$tools-gcc" "CXX_${target//-/_}=$tools-g++"
    export "CARGO_TARGET_${upper}_RUNNER=$qemu -L /usr/$tools"
    # Rust's own linker, where the toolchain brings it, packs relocations and folds functions that are the same: a tenth of the file.
    local lld=$root/lib/rustlib/$host/bin/gcc-ld
    if [ -d "$lld" ]; then
        export "CARGO_TARGET_${upper}_RUSTFLAGS=-Clink-arg=-B$lld -Clink-arg=-fuse-ld=lld -Clink-arg=-Wl,--icf=safe"
    fi
}

a64() { prepare "$A64" aarch64-linux-gnu qemu-aarch64-static && export QEMU_LD_PREFIX=/usr/aarch64-linux-gnu; }
v7() { prepare "$V7" arm-linux-gnueabihf qemu-arm-static; }

size_of() {
    local binary=$kept/target/$1/board/stokescope
    printf '%-30s %5.1f MB  %s\n' "$1" "$(stat -c %s "$binary" | awk '{ print $1 / 1e6 }')" "$binary"
}

build() {
    (a64 && cargo build --profile board --locked)
    (v7 && cargo build --profile board --locked)
    printf '\nboard builds, stripped (%s dependencies):\n' \
        "$(cargo tree --locked --edges normal --prefix none | sort -u | grep -vc '^stokescope ')"
    size_of "$A64"
    size_of "$V7"
}

case ${1:-all} in
    all) (a64 && foreign && cargo test --workspace --locked) && build && echo "cross: the test suite passes under qemu-aarch64" ;;
    build) build ;;
    test) shift && a64 && foreign && cargo test --locked "$@" ;;
    cargo) shift && a64 && cargo "$@" ;;
    *) sed -n '2,/^set/s/^# \{0,1\}//p' "$0" && exit 2 ;;
esac
