#!/usr/bin/env bash
# Proves that a change leaves results bit for bit the same: same-results.sh [--quick] OLD NEW DIR
#
# OLD and NEW are two stokescope programs. DIR holds bundles, each a folder with calibration.toml, raw.npy and perhaps guide.npy, and
# recorded sessions of up to 100 frames, which are replayed as videos. Both programs reconstruct each of them with every method, with
# and without a fusion model, and all .npy files that they write are compared. A line for each case says `same`, `same refusal` where
# both end with the same exit code, or `DIFFERENT`. The exit code is 1 if any case differs or none gives a result.
#
# OLD may also be the saved output of an earlier run, which holds a checksum for each case; then only NEW runs. Checksums hold for
# the kind of processor on which they were made.
#   same-results.sh old old bundles >reference.txt     # also proves that results repeat
#   same-results.sh reference.txt new bundles          # after a change
#   same-results.sh --quick reference.txt new bundles  # after each step: two methods on every ninth bundle, and one session
set -euo pipefail
export LC_ALL=C
quick=
[ "${1:-}" = --quick ] && { quick=yes; shift; }
[ $# = 3 ] && [ -f "$1" ] && [ -x "$2" ] && [ -d "$3" ] || { sed -n 2p "$0" >&2; exit 2; }
old=$(realpath "$1") new=$(realpath "$2") dir=$(realpath "$3")
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

# cases of bundles; `unguided` leaves the guide out
cases=("--method guided --iterations 10 --threads 1" "unguided --method stokes --iterations 10 --threads 2")
[ $quick ] || cases+=(
  "--method guided --iterations 10 --threads 2" "unguided --method stokes --iterations 10 --threads 1"
  "--method guided --iterations 5 --threads 1 --register off --refit-psf off" "--method guided --iterations 5 --threads 1 --fft microfft"
  "--method "{stokes,fista,fista-published,admm,admm-published}" --iterations 5 --threads 1"
  "--method guided --iterations 10 --threads 1 --fusion "{default,preview}" --precision "{f32,int8}
  "unguided --method stokes --iterations 5 --threads 2 --fusion default --precision int8")
# cases of sessions: boards that differ in their fusion model
models=(off) && [ $quick ] || models+=(default preview)
for model in "${models[@]}"; do sed "s/^model = .*/model = \"$model\"/" boards/x86-sim.toml >"$work/$model.toml"; done

digest() { # PROGRAM SOURCE CASE…: one checksum of names and content of all arrays written, or the exit code
  local program=$1 source=$2 code=0 guide=(--guide "$2/guide.npy")
  shift 2
  if [ -e "$source/session.json" ]; then
    set -- replay "$source" --board "$work/$1.toml"
  else
    [ -e "$source/guide.npy" ] && [ "$1" != unguided ] || guide=()
    [ "$1" != unguided ] || shift
    [[ "$*" = *--fusion* ]] || set -- "$@" --fusion off
    set -- reconstruct --calibration "$source" --raw "$source/raw.npy" "${guide[@]}" "$@"
  fi
  rm -rf "$work/out"
  timeout 300 "$program" "$@" --out "$work/out" >"$work/log" 2>&1 || code=$?
  if [ $code != 0 ]; then echo "exit-$code"; return; fi
  (cd "$work/out" && find . -name '*.npy' | sort | xargs -r sha256sum | sha256sum | cut -c 1-32)
}

declare -A known
[ -x "$old" ] || while read -r sum name; do known[$name]=$sum; done < <(sed -nE 's/^same( refusal)? +//p' "$old")
total=0 different=0 arrays=0 bundles=0 sessions=0
for source in "$dir"/*/; do
  name=$(basename "$source")
  if [ -e "$source/session.json" ]; then
    [ $quick ] && [ $((sessions++)) != 0 ] && continue
    list=("${models[@]}")
  elif [ -e "$source/calibration.toml" ]; then
    [ $quick ] && [ $((bundles++ % 9)) != 0 ] && continue
    list=("${cases[@]}")
  else continue; fi
  # each program derives the norms of the bundle itself and keeps them in a copy of its own
  for side in old new; do mkdir -p "$work/$side" && cp -r "$source" "$work/$side/$name" && rm -f "$work/$side/$name/norms.json"; done
  for options in "${list[@]}"; do
    before=${known["$name $options"]:-none} verdict=same total=$((total + 1))
    read -ra words <<<"$options"
    [ ! -x "$old" ] || before=$(digest "$old" "$work/old/$name" "${words[@]}")
    after=$(digest "$new" "$work/new/$name" "${words[@]}")
    [[ $after = exit-* ]] && verdict="same refusal" || arrays=$((arrays + 1))
    [ "$before" = "$after" ] || { verdict=DIFFERENT different=$((different + 1)) after="$before $after"; }
    printf '%-12s  %s  %s\n' "$verdict" "$after" "$name $options"
    [[ $verdict = DIFFERENT && $after = *" exit-"* ]] && tail -n 3 "$work/log" >&2
  done
  rm -rf "$work"/{old,new}
done
echo "$different of $total cases differ, $arrays gave results"
[ $different = 0 ] && [ $arrays -gt 0 ]
