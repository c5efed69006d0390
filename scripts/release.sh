#!/usr/bin/env bash
# Makes what a user downloads, in target/release-VERSION: a Debian package and a wheel of the Python package for each processor, bills of
# materials (CycloneDX) of the program and of the Python package, and SHA256SUMS.
#
#   scripts/release.sh [amd64] [arm64]   everything, from a clean clone of HEAD [default: both processors]
#   scripts/release.sh check             only whether version, changelog, tag and tree agree
#
# cargo-deb and cargo-cyclonedx are installed to target/tools; compilers for arm64 and qemu are installed by scripts/cross.sh. Exit code 77: a
# tool cannot be had here.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/cargo-tool.sh
wrong() { echo "release: $*" >&2; exit 1; }
for argument; do
    case $argument in
        amd64 | arm64 | check) ;;
        *) sed -n '2,/^set/s/^# \{0,1\}//p' "$0" && exit 2 ;;
    esac
done
version=$(cargo metadata --no-deps --format-version 1 --locked | python3 -c '
import json, sys
versions = {package["version"] for package in json.load(sys.stdin)["packages"]}
sys.exit(f"release: the packages have versions {sorted(versions)}, allowed: one") if len(versions) > 1 else print(*versions)')
[ -z "$(git status --porcelain)" ] || wrong "the tree has changes that are not committed"
grep -q "^## \[$version\] - [0-9-]*$" CHANGELOG.md || wrong "CHANGELOG.md: no line '## [$version] - YYYY-MM-DD'"
! sed -n '/^## \[Unreleased\]/,/^## \[[0-9]/p' CHANGELOG.md | grep -q '^- ' || wrong "CHANGELOG.md: changes stand under Unreleased"
[ -z "$(git tag --list "v$version")" ] || [ -n "$(git tag --points-at HEAD --list "v$version")" ] || wrong "the tag v$version names another commit"
echo "release: version $version; changelog, tag and tree agree"
[ "${1:-}" != check ] || exit 0
[ $# -gt 0 ] || set -- amd64 arm64

cargo_tool cargo-deb ^3 || exit 77
cargo_tool cargo-cyclonedx ^0.5 || exit 77
out=$PWD/target/release-$version
clone=$PWD/target/release-clone
rm -rf "$out" "$clone"
mkdir -p "$out"
git clone --quiet . "$clone"
# what is built of dependencies is kept
ln -s "$PWD/target" "$clone/target"
untried=0
for architecture; do
    (cd "$clone" && scripts/deb.sh "$architecture") | tee "$out/deb.log"
    cp "$(head -1 "$out/deb.log")" "$out/"
    rm "$out/deb.log"
    [ "$architecture" = amd64 ] && machine=x86_64 || machine=aarch64
    (cd "$clone" && scripts/wheels.sh $machine) || { code=$? && [ $code = 77 ] && untried=77 || exit $code; }
    cp "$clone"/target/wheels/*"$machine".whl "$out/"
done
# the package has cameras of Video4Linux
bill() { (cd "$clone" && cargo cyclonedx --format json --spec-version 1.5 --quiet "$@"); }
bill --features v4l2 && cp "$clone/stokescope.cdx.json" "$out/stokescope-$version.cdx.json"
bill && cp "$clone/crates/python/stokescope-python.cdx.json" "$out/stokescope-python-$version.cdx.json"
(cd "$out" && sha256sum -- * >SHA256SUMS && cat SHA256SUMS)
rm -rf "$clone"
exit $untried
