#!/usr/bin/env bash
# Builds the Debian package of this machine's architecture, or of another one, and looks at what is in it.
#
#   scripts/deb.sh [amd64|arm64]
#
# The first line printed is the package's path. cargo-deb is installed to target/tools; arm64 is built by scripts/cross.sh on a PC.
# NO_BUILD=1 packs what is built already. Exit code 77: the tools cannot be had here, nothing was built.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/cargo-tool.sh
unable() { echo "deb: skipped, not passed: $*" >&2; exit 77; }
cargo_tool cargo-deb ^3 || unable "cargo cannot install cargo-deb"
command -v dpkg-deb >/dev/null || unable "dpkg-deb is not installed"
own=$(dpkg --print-architecture)
cargo=(cargo)
[ "${1:-$own}" = "$own" ] || cargo=(scripts/cross.sh cargo)
package=$("${cargo[@]}" deb --profile "${PROFILE:-board}" --locked ${NO_BUILD:+--no-build} | tail -1)
echo "$package"
files=$(dpkg-deb --contents "$package")
for file in ./usr/bin/stokescope ./usr/lib/systemd/system/stokescope.service ./usr/lib/sysusers.d/stokescope.conf \
    ./usr/lib/udev/rules.d/60-stokescope.rules ./etc/stokescope/environment ./usr/share/doc/stokescope/deploy.md; do
  grep -qF " $file" <<<"$files" || { echo "$file is missing:"; echo "$files"; exit 1; } >&2
done
dpkg-deb --info "$package" conffiles | grep -qx /etc/stokescope/environment || { echo "the configuration is no conffile" >&2; exit 1; }
dpkg-deb --info "$package" postinst | grep -q sysusers
dpkg-deb --field "$package" Package Version Architecture Depends Installed-Size
if command -v systemd-analyze >/dev/null; then
  unit=$(mktemp -d)/stokescope.service
  trap 'rm -r "$(dirname "$unit")"' EXIT
  cp deploy/stokescope.service "$unit"
  systemd-analyze security --offline=true --threshold=30 "$unit" | tail -1
fi
