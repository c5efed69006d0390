#!/usr/bin/env bash
# A whole machine, without hardware: boots Debian with our package in qemu and checks it from inside and outside.
#
#   scripts/machine.sh [--arch amd64|arm64] [--deb FILE] [--short] [--cuts N]
#
# First boot: the service starts, feeds the watchdog and is restarted by it, survives any number of failures, keeps within memory and processor
# limits, answers on the network to the token alone, logs, uses two cameras of the driver vivid that come late, keeps its configuration through
# an upgrade, and leaves its recordings when it is removed. Second boot: it runs on a read-only root below a file system in memory, without a
# network, and serves an address that comes late. --short does the first boot without vivid, and no second one.
# --cuts cuts the power N times at random moments of recording and pruning (qemu is killed), and N/10 times each of an upgrade, of
# calibrations, and of recording with the clock a year back. Each time the file system must be clean, every visible frame whole, the program
# whole and the bundle old or new. After the last cut of each kind the machine must boot and record again.
#
# One line for each check, one at the end. Needs root, and installs what it needs. target/machine keeps the root file system. --deb: a package
# [default: scripts/deb.sh builds it]. Exit code 77: nothing was tested.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/lib/debian.sh
. scripts/machine/boot.sh
arch=amd64 cuts=0 deb='' short=
while [ $# -gt 0 ]; do
    case $1 in
        --arch) arch=$2 && shift ;;
        --cuts) cuts=$2 && shift ;;
        --deb) deb=$(realpath "$2") && shift ;;
        --short) short=1 ;;
        *) sed -n '2,/^set/s/^# \{0,1\}//p' "$0" && exit 2 ;;
    esac
    shift
done
kept=$PWD/target/machine/$arch
mkdir -p "$kept"
failed=0 checks=0 begin=$SECONDS
unable() { printf 'machine: skipped, not passed: %s\n' "$*" >&2; exit 77; }
# verdict ok|no TEXT
verdict() {
    checks=$((checks + 1))
    if [ "$1" = ok ]; then echo "ok   $2"; else failed=$((failed + 1)) && echo "FAIL $2"; fi
}
# judge TEXT COMMAND…
judge() {
    local text=$1
    shift
    if "$@"; then verdict ok "$text"; else verdict no "$text"; fi
}
[ "$(id -u)" = 0 ] || unable "only root can make a root file system"
packages=(mmdebstrap e2fsprogs qemu-utils curl python3)
case $arch in
    amd64) packages+=(qemu-system-x86) qemu=(qemu-system-x86_64 -cpu max) console=ttyS0 ;;
    arm64) packages+=(qemu-system-arm qemu-user-static arch-test) qemu=(qemu-system-aarch64 -M virt -cpu cortex-a72) console=ttyAMA0 ;;
    *) unable "no such architecture: $arch" ;;
esac
debian_need "$kept/apt.log" "${packages[@]}" || unable "apt cannot install what is needed"
[ "$arch" = "$(dpkg --print-architecture)" ] || debian_foreign qemu-aarch64 || unable "the kernel starts no programs of $arch"

# the disks lie in memory where there is room: a flush of a disk that others use, too, takes long
work=$(mktemp -d "$([ -d /dev/shm ] && echo /dev/shm || echo "$kept")/stokescope-machine-XXXXXX")
trap 'kill -9 "${machine:-}" 2>/dev/null || true; mkdir -p "$kept/logs" && cp "$work"/*.log "$kept/logs/" || true; rm -rf "$work"' EXIT
make_root
make_disk

# Lines "CHECK ok|no TEXT" that the machine has said.
said() { while read -r _ outcome what; do verdict "$outcome" "$what"; done < <(tr -d '\r' <"$1" | grep -a '^CHECK ' || true); }
# ask PATH CODE [OPTION…]: whether the service answers so
ask() {
    local path=$1 code=$2
    shift 2
    for _ in $(seq 20); do
        [ "$(curl -s -o "$work/answer" -w '%{http_code}' --max-time 30 "$@" "http://127.0.0.1:$port$path")" != "$code" ] || return 0
        sleep 1
    done
    return 1
}
bearer=(-H 'Authorization: Bearer machine-token')

# Checks of the first boot: those from outside while the machine waits for them, and those from inside.
first_boot() {
    boot "$work/disk.qcow2" "$work/main.log" "stokescope.checks=main${short:+,short}"
    if until_said 900 "$work/main.log" 'MACHINE serving'; then
        verdict ok "boots and serves after $((SECONDS - begin)) s"
        judge "refused without the token" ask /state 401
        for path in / /state /healthz '/snapshot?view=aolp'; do
            judge "$path through the network" ask "$path" 200 "${bearer[@]}"
        done
    else
        verdict no "boots and serves"
    fi
    judge "all checks inside end" until_said 1800 "$work/main.log" 'MACHINE end'
    said "$work/main.log"
    leave
}

# Checks with a read-only root below a file system in memory, and with a network that comes late.
second_boot() {
    local log=$work/overlay.log
    boot "$work/fresh.qcow2" "$log" 'stokescope.checks=overlay ro init=/root/overlay systemd.mask=systemd-networkd.service' readonly
    until_said 900 "$log" 'MACHINE address' && judge "serves an address that came late" ask /state 200 "${bearer[@]}"
    judge "all checks with a read-only root end" until_said 900 "$log" 'MACHINE end'
    said "$log"
    leave
}

# power_cuts KIND COUNT LONGEST [OPTION…]: cuts the power within LONGEST seconds after a moment of KIND; the last disk is left in cut.qcow2.
power_cuts() {
    local kind=$1 count=$2 longest=$3 whole=0 frames=0 found n
    : >"$work/states"
    shift 3
    boot "$work/warm.qcow2" "$work/$kind.log" "stokescope.checks=$kind" "$@"
    until_said 900 "$work/$kind.log" 'MACHINE busy' || { verdict no "the machine is ready for power cuts of $kind" && leave && return; }
    python3 scripts/machine/cut.py save "$work/monitor" "$work/state"
    wait "$machine" || true
    for n in $(seq "$count"); do
        qemu-img create -q -f qcow2 -b "$work/warm.qcow2" -F qcow2 "$work/cut.qcow2"
        boot "$work/cut.qcow2" "$work/cut.log" "stokescope.checks=$kind" "$@" -incoming "exec:cat $work/state"
        python3 scripts/machine/cut.py resume "$work/monitor" || true
        sleep "$(awk -v n="$n" -v longest="$longest" 'BEGIN { srand(n); print longest * rand() }')"
        leave
        found=$(damage "$kind") || { echo "     $kind, cut $n: $found"; continue; }
        whole=$((whole + 1)) frames=$((frames + ${found% *}))
        echo "$found" >>"$work/states"
    done
    judge "$count power cuts, $kind: $whole without damage, $frames visible frames, $(sort -u "$work/states" | wc -l) different folders" \
        [ "$whole" = "$count" ]
    qemu-img convert -O qcow2 "$work/cut.qcow2" "$work/warm.new"
    mv "$work/warm.new" "$work/warm.qcow2"
    boot "$work/warm.qcow2" "$work/again.log" stokescope.checks=again
    judge "after the last of them it boots and records" until_said 900 "$work/again.log" 'MACHINE busy'
    leave
}

# damage KIND: what the disk holds after a cut, as cut.py says it, or the damage and 1
damage() {
    qemu-img convert -O raw "$work/cut.qcow2" "$work/cut.raw"
    e2fsck -p "$work/cut.raw" >"$work/fsck.log" 2>&1 || [ $? -le 1 ] || { echo "fsck" && return 1; }
    e2fsck -fn "$work/cut.raw" >>"$work/fsck.log" 2>&1 || { echo "not clean" && return 1; }
    rm -rf "$work/found" && mkdir "$work/found"
    printf '%s\n' "rdump /var/lib/stokescope $work/found" "dump /etc/stokescope/environment $work/found/environment" \
        "dump /usr/bin/stokescope $work/found/program" | debugfs -f - "$work/cut.raw" >/dev/null 2>&1
    python3 scripts/machine/cut.py check "$1" "$work/found" "$work/expected"
}

first_boot
[ -n "$short" ] || second_boot
if [ "$cuts" -gt 0 ]; then
    tenth=$(((cuts + 9) / 10))
    mkdir "$work/expected"
    cp "$root/etc/stokescope/environment" "$work/expected/"
    cp "$root/usr/bin/stokescope" "$work/expected/program"
    cp "$work/fresh.qcow2" "$work/warm.qcow2"
    power_cuts record "$cuts" 5
    power_cuts past "$tenth" 5 -rtc "base=$(date -u -d '1 year ago' +%Y-%m-%dT%H:%M:%S)"
    power_cuts calibrate "$tenth" 5
    power_cuts upgrade "$tenth" 30
fi
echo "machine: $checks checks, $failed failed, $((SECONDS - begin)) s ($arch, $(basename "$deb"))"
[ "$failed" = 0 ] && [ "$checks" -gt 10 ]
