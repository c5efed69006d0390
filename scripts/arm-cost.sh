#!/usr/bin/env bash
# What a frame costs on ARM: counts the aarch64 instructions of every stage under qemu. `stokescope plan` turns them into milliseconds.
#
#   scripts/arm-cost.sh [--binary FILE] [--physics] [SIZE ...]     sizes in pixels, default 64; --physics leaves fusion out
#
# The program (CARGO_PROFILE_BOARD_STRIP=none scripts/cross.sh cargo build --profile board) replays a session of a moving scene, which
# this machine's own has recorded ($STOKESCOPE names it, or it is built), with one thread. qemu names every block of code it
# translates and every one it executes; blocks are weighed by their instructions and go to the room their function belongs to. What
# a frame and an iteration cost are differences of runs that differ in that alone, so planning and reading files cancel. Transforms
# of the alignment count as the start's. What fusion costs is the difference of everything with the shipped default model and
# without; what asking the readings adds to it is how much larger that difference is where guides are not aligned. Instructions are
# exact but for inlining across rooms; how many a core does in a cycle, and the memory bus, are the model's part, in
# src/board/cost.rs, where the printed table belongs. Exit code 77: the tools are not here, nothing was counted.
set -euo pipefail
cd "$(dirname "$0")/.."

binary=target/cross/target/aarch64-unknown-linux-gnu/board/stokescope
qemu=(qemu-aarch64-static -cpu cortex-a76 -L /usr/aarch64-linux-gnu)
sizes=() precisions=(int8 f32)
while [ $# -gt 0 ]; do
    case $1 in
        --binary) binary=$2 && shift ;;
        --physics) precisions=() ;;
        [0-9]*) sizes+=("$1") ;;
        *) sed -n '2,/^set/s/^# \{0,1\}//p' "$0" | head -n -1 && exit 2 ;;
    esac
    shift
done
[ ${#sizes[@]} -gt 0 ] || sizes=(64)
host=${STOKESCOPE:-target/release/stokescope}
[ -n "${STOKESCOPE:-}" ] || cargo build --release --quiet --locked
command -v "${qemu[0]}" >/dev/null || { echo "arm-cost: skipped, not passed: no ${qemu[0]}" >&2; exit 77; }
[ -x "$binary" ] || { echo "arm-cost: skipped, not passed: no $binary" >&2; exit 77; }
work=$(mktemp -d) && trap 'rm -rf "$work"' EXIT

# Instructions of each room in one run, into a file of "room count" lines: count FILE ARGS...
count() {
    local file=$1 pipe=$work/pipe log=$work/log
    shift
    rm -f "$pipe" && mkfifo "$pipe"
    awk '
        # names as rustc mangles them: of functions, and of implementations of traits; those of libc are not in the file
        function room(name) {
            if (name ~ /stokescope(.*6refine.*4int8|.*\.\.refine\.\..*int8)|[0-9$]tract_/) return "network"
            if (name ~ /stokescope(.*(5guide|8readings)|.*\.\.(guide|readings)\.\.)/) return "prepare"
            if (name ~ /stokescope(.*(5solve|6optics|8parallel)|.*\.\.(solve|optics|parallel)\.\.)|fearless/ || name == "") return "recon"
            if (name ~ /stokescope(.*(8pipeline|12polarization|4live)|.*\.\.(pipeline|polarization|live)\.\.)/) return "finish"
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
            split($0, part, "/"); pc = part[2]
            if (!(pc in at)) {
                short = pc; sub(/^0+/, "", short); at[pc] = short
                name = $0; sub(/.*\] ?/, "", name); of[pc] = room(name)
            }
            times[pc]++
        }
        END {
            for (pc in times) { n = times[pc] * size[at[pc]]; sum[of[pc]] += n; total += n }
            for (r in sum) printf "%s %.0f\n", r, sum[r]
            printf "total %.0f\n", total
        }' "$pipe" >"$file" &
    local counter=$!
    "${qemu[@]}" -d in_asm,exec,nochain -D "$pipe" "$binary" "$@" >/dev/null 2>"$log" || { cat "$log" >&2; exit 1; }
    wait "$counter"
}

for size in "${sizes[@]}"; do
    {
        printf 'inherit = "x86-sim"\n[solver]\nthreads = 1\n[fusion]\nmodel = "off"\n'
        for camera in raw guide; do
            printf '[cameras.%s]\nsource = "tissue,size=%s,clip=0,surround=0,guide_margin=0"\nframe_rate = 5.0\n' "$camera" "$size"
        done
    } >"$work/board.toml"
    here() { "$host" "$@" --out "$work/out" >"$work/log" 2>&1 || { cat "$work/log" >&2; exit 1; }; }
    sed 's/"off"/"default"/' "$work/board.toml" >"$work/fused.toml"
    # cameras are late on a busy machine, and a model is not run on a frame like the one before
    for try in 1 2 3 4 5; do
        rm -rf "$work"/sessions "$work"/frames-{1,3} "$work/out"
        here run --board "$work/board.toml" --no-preview --frames 3 --iterations 1 --record "$work/sessions" --record-reserve-bytes 0
        cp -r "$work"/sessions/session-* "$work/frames-3"
        here replay "$work/frames-3" --board "$work/fused.toml" --iterations 2
        grep -q '"run": 0,' "$work"/out/frame-*/report.json || break
        [ $try -lt 5 ] || { echo "arm-cost: frames like the one before five times over; is the machine busy?" >&2; exit 1; }
    done
    cp -r "$work/frames-3" "$work/frames-1"
    rm "$work/frames-1"/*/0000000[12].*
    measure() { count "$work/$1" replay "$work/$2" --board "$work/board.toml" --iterations "$3" --out "$work/out"; }
    measure one frames-1 2 && measure three frames-3 2 && measure longer frames-3 6
    for precision in "${precisions[@]}"; do
        sed -i "s/^model = .*/model = \"default\"\nprecision = \"$precision\"/;/^precision/d" "$work/board.toml"
        measure "one-$precision" frames-1 2 && measure "three-$precision" frames-3 2
    done
    sed -i 's/"register": true/"register": false/' "$work"/frames-{1,3}/session.json
    for model in ${precisions:+default off}; do
        sed -i "s/^model = .*/model = \"$model\"/" "$work/board.toml"
        measure "one-placed-$model" frames-1 2 && measure "three-placed-$model" frames-3 2
    done
    macs=$(awk '$1 == "macs" { macs = $3 } $1 == "tile" { tile = $3 } END { print macs / tile / tile }' models/default/manifest.toml)
    awk -v pixels=$((size * size)) -v size="$size" -v folder="$work" -v macs="$macs" '
        function read(name,   line, part, file) {
            file = folder "/" name
            while ((getline line < file) > 0) { split(line, part, " "); found[name, part[1]] = part[2] }
        }
        function frames(room) { return (found["three", room] - found["one", room]) / 2 / pixels }
        function every(fusion) { return (found["three" fusion, "total"] - found["one" fusion, "total"]) / 2 / pixels }
        function row(name, instructions) { printf "    %-12s %8.2f\n", name, instructions }
        BEGIN {
            count = split("one three longer one-int8 three-int8 one-f32 three-f32 " \
                "one-placed-default three-placed-default one-placed-off three-placed-off", names, " ")
            for (k = 1; k <= count; k++) read(names[k])
            iteration = (found["longer", "recon"] - found["three", "recon"]) / 12 / pixels
            printf "%d×%d, a frame of a moving scene, instructions per pixel:\n", size, size
            row("prepare", frames("prepare"))
            row("start", frames("recon") - 2 * iteration)
            row("iteration", iteration)
            row("finish", frames("finish"))
            printf "    (a whole run of one frame, planning and files included: %.0f million instructions)\n", found["one", "total"] / 1e6
            if (!(("three-int8", "total") in found)) exit
            network = (found["three-int8", "network"] - found["one-int8", "network"]) / 2 / pixels
            beside = every("-int8") - every("") - network
            row("fusion", beside)
            # guides that are not aligned were met in floating point, the last precision above
            row("asking", every("-placed-default") - every("-placed-off") - (every("-f32") - every("")))
            printf "    and a multiply-add of the network: %.3f in bytes with dot products, %.3f in floating point\n", network / macs,
                (every("-f32") - every("") - beside) / macs
        }'
done
