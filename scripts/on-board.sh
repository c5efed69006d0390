#!/usr/bin/env bash
# For a person with a board: looks at it, captures, and prints a report in Markdown to paste into an issue.
#
#   scripts/on-board.sh [--board NAME|FILE] [--frames N] [--out DIR] [--binary FILE] >report.md
set -uo pipefail

board=x86-sim frames=50 out=$(mktemp -d) binary=
while [ $# -gt 0 ]; do
    case $1 in
        --board) board=$2 ;;
        --frames) frames=$2 ;;
        --out) out=$2 ;;
        --binary) binary=$2 ;;
        *) sed -n '2,4s/^# \{0,1\}//p' "$0" >&2; exit 2 ;;
    esac
    shift 2 || exit 2
done
here=$(cd "$(dirname "$0")/.." && pwd)
for candidate in "$binary" "$(command -v stokescope)" "$here"/target/{board,release,debug}/stokescope; do
    [ -n "$candidate" ] && [ -x "$candidate" ] && { binary=$candidate; break; }
done
[ -x "$binary" ] || { echo "no stokescope: build it with cargo build --profile board --features libcamera" >&2; exit 66; }
mkdir -p "$out"

code() { printf '```%s\n' "${1:-}"; cat; printf '```\n\n'; }
# what the firmware says of its health, where there is a Raspberry Pi's
health() {
    for zone in /sys/class/thermal/thermal_zone*; do
        [ -r "$zone/temp" ] && printf '%s %s °C\n' "$(cat "$zone/type")" "$(awk '{ printf "%.1f", $1 / 1000 }' "$zone/temp")"
    done
    if command -v vcgencmd >/dev/null; then
        throttled=$(vcgencmd get_throttled | cut -d= -f2)
        printf 'throttled %s' "$throttled"
        for bit in 0:undervoltage 1:frequency-capped 2:throttled 3:soft-temperature-limit; do
            [ $((throttled >> ${bit%%:*} & 1)) = 1 ] && printf ' %s-now' "${bit#*:}"
            [ $((throttled >> (${bit%%:*} + 16) & 1)) = 1 ] && printf ' %s-before' "${bit#*:}"
        done
        printf '\n'
    fi
    for cpu in /sys/devices/system/cpu/cpu[0-9]*/cpufreq/scaling_cur_freq; do
        [ -r "$cpu" ] && printf '%s MHz ' $(($(cat "$cpu") / 1000))
    done
    printf '\n'
}

echo "# stokescope on $(tr -d '\0' </proc/device-tree/model 2>/dev/null || uname -n)"
echo
{
    "$binary" --version
    uname -srm
    grep -h '^PRETTY_NAME' /etc/os-release
    printf 'cores %s, ' "$(nproc)"
    awk '/MemTotal|MemAvailable/ { printf "%s %d MiB  ", $1, $2 / 1024 } END { print "" }' /proc/meminfo
    printf 'CMA '
    awk '/Cma/ { printf "%s %d MiB  ", $1, $2 / 1024 } END { print "" }' /proc/meminfo
    command -v libcamera-hello rpicam-hello >/dev/null && { rpicam-hello --version 2>/dev/null || libcamera-hello --version; } | head -2
} | code
echo "## Doctor"
echo
"$binary" doctor --board "$board" --out "$out" >"$out/doctor.txt" 2>&1
code <"$out/doctor.txt"
echo "## Cameras"
echo
echo "Formats offered:"
echo
"$binary" cameras 2>&1 | code
echo "Asked for, and delivered:"
echo
grep -E '(raw|guide) camera' "$out/doctor.txt" | code
echo "## Before"
echo
health | code
echo "## $frames frames of board $board"
echo
started=$(date +%s%N)
"$binary" --json run --board "$board" --no-preview --frames "$frames" --out "$out" >"$out/summary.json" 2>"$out/log.txt" &
run=$!
(
    while kill -0 $run 2>/dev/null; do
        awk -v at=$((($(date +%s%N) - started) / 1000000000)) '/VmRSS|VmHWM|Threads/ { printf "%s %s %s  ", $1, $2, $3 }
            END { printf "at %d s\n", at }' "/proc/$run/status" 2>/dev/null
        health | head -3 | tr '\n' ' '
        echo
        sleep 5
    done
) >"$out/watch.txt"
wait $run
status=$?
echo "exit code $status"
echo
code json <"$out/summary.json"
[ -s "$out/log.txt" ] && tail -40 "$out/log.txt" | code
echo "Stages of the last frame (seconds), and how good it was:"
echo
[ -r "$out/report.json" ] && code json <"$out/report.json"
echo "For the board's file, where it takes the place of the estimate of \`stokescope plan\`:"
echo
# the last frame's times, in milliseconds
[ -r "$out/report.json" ] && tr -d ' \n' <"$out/report.json" | awk '
    function number(key,   at) { at = index($0, "\"" key "\":"); return at ? substr($0, at + length(key) + 3) + 0 : 0 }
    {
        match($0, /"size":\[[0-9]+,[0-9]+\]/); split(substr($0, RSTART + 8, RLENGTH - 9), size, ",")
        printf "[measured]\nwidth = %d\nheight = %d\niterations = %d\n", size[1], size[2], number("iterations")
        split("prepare register recon fusion", stage, " ")
        for (k = 1; k <= 4; k++) printf "%s_ms = %.3f\n", stage[k], 1e3 * number(stage[k])
    }' | code toml
echo "While it ran:"
echo
code <"$out/watch.txt"
echo "## After"
echo
health | code
exit $status
