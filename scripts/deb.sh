#!/usr/bin/env bash
# Builds the Debian package and looks at what is in it. For another machine: scripts/deb.sh aarch64-unknown-linux-gnu
# (its linker and standard library must be there). Needs cargo-deb and dpkg-deb; says so and ends with 77 where they are missing.
set -euo pipefail
cd "$(dirname "$0")/.."
for program in cargo-deb dpkg-deb; do
  command -v "$program" >/dev/null || { echo "skipped: $program is not installed (cargo install cargo-deb)" >&2; exit 77; }
done
package=$(cargo deb --profile "${PROFILE:-board}" --locked ${1:+--target "$1"} ${NO_BUILD:+--no-build})
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
