#!/usr/bin/env bash
# What a frame costs on ARM: counts aarch64 instructions of every stage under qemu and turns them into milliseconds.
#
#   scripts/arm-cost.sh [--binary FILE] [SIZE ...]     sizes in pixels, default 64 128
#
# The program (scripts/cross.sh cargo build --release) reconstructs one simulated frame with one thread and with two numbers of
# iterations. qemu names every block of code it translates and every one it executes; blocks are weighed by their
# instructions and go to the stage their function belongs to, and what an iteration costs is the difference of the two runs.
# Instructions are exact; milliseconds are a model: instructions / (clock x instructions per cycle), the latter as a range for
# each kind of core. The memory bus and JPEG are not counted. Measurements from a real board (scripts/on-board.sh) beat it.
# Exit code 77: the tools are not here, nothing was counted.
set -euo pipefail
cd "$(dirname "$0")/.."

binary=target/cross/target/aarch64-unknown-linux-gnu/release/stokescope
sizes=()
while [ $# -gt 0 ]; do
    case $1 in
        --binary) binary=$2 && shift ;;
        [0-9]*) sizes+=("$1") ;;
        *) sed -n '2,/^set/s/^# \{0,1\}//p' "$0" | head -n -1 && exit 2 ;;
    esac
    shift
done
[ ${#sizes[@]} -gt 0 ] || sizes=(64 128)
command -v qemu-aarch64-static >/dev/null || { echo "arm-cost: skipped, not passed: no qemu-aarch64-static" >&2; exit 77; }
[ -x "$binary" ] || { echo "arm-cost: skipped, not passed: no $binary (scripts/cross.sh cargo build --release)" >&2; exit 77; }
work=$(mktemp -d) && trap 'rm -rf "$work"' EXIT
qemu=(qemu-aarch64-static -L /usr/aarch64-linux-gnu)

# Instructions of each stage in one run: "stage count" lines.
count() {
    local pipe=$work/pipe
    rm -f "$pipe" && mkfifo "$pipe"
    awk '
        function stage(name) {
            if (name ~ /register|9prepare3fit/) return "register"
            if (name ~ /7prepare/) return "prepare"
            if (name ~ /5recon/) return "recon"
            if (name ~ /5polar/) return "polar"
            if (name ~ /6coarse/) return "coarse"
            if (name ~ /rustfft|3fft|8convolve|6optics|5lanes|fearless/) return "optics"
            if (name ~ /6output|png|deflate|fdeflate|5array/) return "files"
            return "rest"
        }
        /^IN:/ { fresh = 1; next }
        /^0x/ {
            pc = tolower(substr($1, 3)); sub(/:$/, "", pc); sub(/^0+/, "", pc)
            if (fresh) { block = pc; size[block] = 0; fresh = 0 }
            size[block]++
            next
        }
        /^Trace/ {
            split($0, part, "/"); pc = part[2]; sub(/^0+/, "", pc)
            if (!(pc in of)) { name = $0; sub(/.*\] ?/, "", name); of[pc] = stage(name) }
            sum[of[pc]] += size[pc]
        }
        END { for (s in sum) printf "%s %.0f\n", s, sum[s] }' "$pipe" &
    local counter=$!
    "${qemu[@]}" -d in_asm,exec,nochain -D "$pipe" "$binary" "$@" >/dev/null 2>&1
    wait "$counter"
}

for size in "${sizes[@]}"; do
    "${qemu[@]}" "$binary" simulate --scene plastic --size "$size" --out "$work/$size" >/dev/null 2>&1
    once() {
        count reconstruct --calibration "$work/$size" --raw "$work/$size/raw.npy" --guide "$work/$size/guide.npy" \
            --threads 1 --iterations "$1" --register "$2" --out "$work/out"
    }
    once 2 off >"$work/few" && once 6 off >"$work/many" && once 2 on >"$work/aligned"
    awk -v size="$size" -v few="$work/few" -v many="$work/many" -v aligned="$work/aligned" '
        function read(file, into,   line, part) { while ((getline line < file) > 0) { split(line, part, " "); into[part[1]] = part[2]; total[file] += part[2] } }
        BEGIN {
            read(few, a); read(many, b); read(aligned, c)
            iteration = (total[many] - total[few]) / 4; register = total[aligned] - total[few]
            n = size * size
            printf "size %d: instructions per pixel: iteration %.0f, register %.0f, prepare %.0f, polar %.0f; a run of 2 iterations %.0f, of which coarse %.0f, files %.0f\n",
                size, iteration / n, register / n, a["prepare"] / n, a["polar"] / n, total[few] / n, a["coarse"] / n, a["files"] / n
            cores = split("cortex-a53 1000 0.5 0.9 1.3,cortex-a72 1800 0.9 1.6 2.5,cortex-a76 2400 1.5 2.7 6.0", core, ",")
            for (k = 1; k <= cores; k++) {
                split(core[k], f, " ")
                slow = 1e3 * iteration / (f[2] * 1e6 * f[3]); fast = 1e3 * iteration / (f[2] * 1e6 * f[4])
                printf "  %-11s %4d MHz, IPC %s to %s: iteration %.2f to %.2f ms, register %.2f to %.2f ms, prepare %.2f to %.2f ms (one core)\n",
                    f[1], f[2], f[3], f[4], fast, slow, register * fast / iteration, register * slow / iteration,
                    a["prepare"] * fast / iteration, a["prepare"] * slow / iteration
            }
        }'
done
